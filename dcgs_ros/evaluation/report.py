# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The record of a run, and the report made from it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.tracking.result import TrackingState, TrackResult
from ..core.tracking.visited import origin
from ..core.trajectory import Trajectory
from .consistency import (
    Claims,
    MotionNees,
    SilentFrames,
    coverage_2sigma,
    motion_nees,
    silent_frames,
)
from .depth_range import DepthSurvey
from .rendering import ViewScores, rendering_report
from .states import states_report
from .trajectory import (
    AteResult,
    EvaluationError,
    RpeResult,
    absolute_trajectory_error,
    coverage,
    relative_pose_error,
)


@dataclass(frozen=True)
class TrackedFrame:
    """A frame that the tracker accepted; it may be lost."""

    index: int  # in the source, from 0
    result: TrackResult
    seconds: float  # inside `track` and in the exchange with the mapper, decoding excluded
    gaussians: int  # in the tracker's map afterwards


@dataclass(frozen=True)
class SkippedFrame:
    """A frame that could not be read, was refused by the tracker, or was dropped."""

    index: int
    stamp_ns: int | None  # None: unknown, as the frame could not be read
    name: str
    reason: str
    dropped: bool = False  # a newer frame arrived before the tracker was free


@dataclass(frozen=True)
class FinalMap:
    """What the back end made of the first K of a run's keyframes, by its end."""

    T_world_cam: NDArray[np.float64]  # (K, 4, 4)
    T_mapped: NDArray[np.float64]  # (K, 4, 4) with which the map was made
    submaps: NDArray[np.int32]  # (K,) those that were joined have one number
    loops: list[tuple[int, int]]  # pairs of keyframes between which a loop was closed


@dataclass
class RunRecord:
    """What happened in a run, frame by frame."""

    source: str
    ablation: str
    address: str = ''  # of the source, as the user gave it
    camera: str | None = None  # as the user gave it
    depth_per_metre: float | None = None  # value of a depth pixel; None: depth is made in metres
    depth: DepthSurvey = field(default_factory=DepthSurvey)
    depth_in_range: float | None = None  # share of the depth surveyed, in the sensor's range
    depth_summary: str | None = None  # where the depth surveyed lies, for the user
    warnings: list[str] = field(default_factory=list)
    tracked: list[TrackedFrame] = field(default_factory=list)
    skipped: list[SkippedFrame] = field(default_factory=list)
    wall_s: float = 0.0  # all that the user waited for: start, frames, refining, files, scores
    frames_s: float = 0.0  # from asking for the first frame to the end of the last, with decoding
    interrupted: bool = True  # False once the last frame is done; True again if refining is cut
    gaussians: int | None = None  # in the mapper's map at the end; None: the run only tracked
    iterations: int = 0  # optimisation steps of the mapper
    mapping_s: float = 0.0  # time of the mapper alone
    closing_s: float = 0.0  # time of the back end, where it has no thread
    final: FinalMap | None = None  # None: there was no back end

    def trajectory(self) -> Trajectory:
        """Return the poses as they were known live, in the sub-map with the most frames.

        Lost frames, whose pose is no estimate, are left out.
        """
        return self.claims().trajectory()

    def optimized(self) -> Trajectory | None:
        """Return the poses by what the run knew at its end, in the sub-map with the most frames.

        Each frame stays where it was relative to its keyframe, which may have moved. None where
        there was no back end.
        """
        return None if self.final is None else self._placed(self.final, self.final.T_world_cam)

    def mapped(self) -> Trajectory:
        """Return the poses in the map as it was made, corrections included."""
        if self.final is None:
            return self.trajectory()
        return self._placed(self.final, self.final.T_mapped)

    def _placed(self, final: FinalMap, T_world_keyframe: NDArray[np.float64]) -> Trajectory:
        frames = [f.result for f in self.tracked if f.result.state is not TrackingState.LOST]
        placed = [(r.stamp_ns, r.reference) for r in frames if r.reference is not None]
        submaps = final.submaps[np.array([r.keyframe for _, r in placed], np.int64)]
        main = int(np.bincount(submaps, minlength=1).argmax())
        poses = {
            stamp_ns: T_world_keyframe[reference.keyframe] @ reference.T_keyframe_cam
            for (stamp_ns, reference), submap in zip(placed, submaps, strict=True)
            if submap == main
        }
        stamps = sorted(poses)
        T_world_cam = np.array([poses[stamp_ns] for stamp_ns in stamps]).reshape(-1, 4, 4)
        T_world_cam[:, :3, 3] -= origin(main)
        return Trajectory(np.array(stamps, np.int64), T_world_cam)

    def loop_ends(self) -> NDArray[np.float64]:
        """Return both ends (L, 2, 3) of the loops, where the keyframes are at the end, metres."""
        if self.final is None:
            return np.empty((0, 2, 3))
        pairs = np.array(self.final.loops, np.int64).reshape(-1, 2)
        return self.final.T_world_cam[pairs][:, :, :3, 3]

    def claims(self) -> Claims:
        """Return what the tracker says of each frame."""
        return Claims.of([frame.result for frame in self.tracked])

    def stamps_ns(self) -> NDArray[np.int64]:
        """Return the stamps (N,) of all frames that have one, skipped ones included."""
        stamps = [frame.result.stamp_ns for frame in self.tracked]
        stamps += [frame.stamp_ns for frame in self.skipped if frame.stamp_ns is not None]
        return np.array(sorted(stamps), dtype=np.int64)

    def keyframes(self) -> Trajectory:
        """Return the poses of the same sub-map's keyframes as they were tracked."""
        keyframes = [frame.result for frame in self.tracked if frame.result.keyframe]
        return Claims.of(keyframes).trajectory(self.claims().main_submap)


_NO_TRUTH = 'there is no ground truth'


@dataclass(frozen=True)
class Accuracy:
    """Errors of a trajectory and of what is claimed of it, each None if it was not computed."""

    ate: AteResult | None = None
    rpe_1s: RpeResult | None = None
    coverage: float | None = None  # share of the frames with truth that the ATE is over
    nees: MotionNees | None = None
    silent: SilentFrames | None = None
    optimized: Accuracy | None = None  # ATE and RPE of the trajectory as known at the end
    why_no_ate: str = _NO_TRUTH
    why_no_rpe: str = _NO_TRUTH
    why_no_nees: str = _NO_TRUTH


def assess(estimate: Trajectory, truth: Trajectory | None) -> Accuracy:
    """Return ATE and RPE over 1 s, each if the trajectories allow it."""
    if truth is None:
        return Accuracy()
    try:
        ate = absolute_trajectory_error(estimate, truth)
    except EvaluationError as error:
        return Accuracy(why_no_ate=str(error), why_no_rpe=str(error))
    try:
        return Accuracy(ate, relative_pose_error(estimate, truth))
    except EvaluationError as error:
        return Accuracy(ate, why_no_rpe=str(error))


def assess_run(record: RunRecord, truth: Trajectory | None) -> Accuracy:
    """Return the errors of a run, and how far they agree with what the tracker claims."""
    accuracy, claims = assess(record.trajectory(), truth), record.claims()
    if truth is None:
        return accuracy
    poses, states, submaps = claims.uncorrected, claims.states, claims.submaps
    silent = silent_frames(poses, states, claims.sigmas_m, truth, submaps)
    optimized = record.optimized()
    accuracy = replace(
        accuracy,
        optimized=None if optimized is None else assess(optimized, truth),
        coverage=coverage(record.trajectory().stamps_ns, record.stamps_ns(), truth),
        silent=silent if silent.judged.any() else None,
    )
    try:
        nees = motion_nees(poses, states, claims.covariances, truth, submaps)
    except EvaluationError as error:
        return replace(accuracy, why_no_nees=str(error))
    return replace(accuracy, nees=nees)


def build_report(
    record: RunRecord, accuracy: Accuracy, machine: str, peak_rss_mb: float | None, version: str
) -> dict[str, Any]:
    """Return report.json of a run with at least one tracked frame; non-finite values are None.

    `frames` = `tracked` + `lost` + `skipped`; `tracked` includes `degenerate` and `relocalised`,
    `skipped` includes `dropped`. `ate` is over the tracked frames with truth, `coverage` is their
    share of all frames with truth. `tracking` covers only the time inside `track` and the exchange
    with the mapper; `frames_s` also covers decoding and the mapper's steps between frames, and
    `realtime_factor` is the duration of the sequence over it. `wall_s` covers all from the command
    to the last file: the start, the steps after the last frame, writing and scoring too.
    `iterations_per_s` is over the mapper's own time. `rendering` is None until `with_rendering`.
    `optimized` has the errors of the trajectory as it was known at the end, `ate` and the other
    errors are of what was known live; both are None without a back end, as `loops` is.
    `warnings` are lines for the user: what was repaired or left out of the sequence, and what
    speaks against the unit of its depth.
    """
    last = record.tracked[-1]
    results = sorted((frame.result for frame in record.tracked), key=lambda r: r.stamp_ns)
    stamps = np.array([result.stamp_ns for result in results], np.int64)
    states = states_report(stamps, [result.state for result in results])
    report = {
        'source': record.source,
        'address': record.address,
        'camera': record.camera,
        'depth_per_metre': record.depth_per_metre,
        'depth_in_range': record.depth_in_range,
        'warnings': record.warnings,
        'ablation': record.ablation,
        'frames': len(record.tracked) + len(record.skipped),
        'tracked': len(results) - states['lost']['frames'],
        'degenerate': states['degenerate']['frames'],
        'lost': states['lost']['frames'],
        'skipped': len(record.skipped),
        'dropped': sum(frame.dropped for frame in record.skipped),
        'keyframes': sum(frame.result.keyframe for frame in record.tracked),
        'interrupted': record.interrupted,
        'states': states,
        'tracking': _speed(record),
        **accuracy_report(accuracy),
        'loops': _loops(record),
        'optimized': None if accuracy.optimized is None else _errors(accuracy.optimized),
        'mapping': _mapping(record),
        'rendering': None,
        'timing': {'colour_depth_offset_ms': last.result.colour_depth_offset_ms},
        'observability': _observability(record),
        'wall_s': record.wall_s,
        'frames_s': record.frames_s,
        'realtime_factor': float(stamps[-1] - stamps[0]) * 1e-9 / max(record.frames_s, 1e-9),
        'peak_rss_mb': peak_rss_mb,
        'machine': machine,
        'version': version,
    }
    finite = _finite(report)
    assert isinstance(finite, dict)
    return finite


def with_rendering(report: dict[str, Any], scores: Sequence[ViewScores]) -> dict[str, Any]:
    """Return a copy of a report with its part `rendering`, None if no view was scored."""
    rendering = rendering_report(scores) if scores else None
    return {**report, 'rendering': _finite(rendering)}


def accuracy_report(accuracy: Accuracy) -> dict[str, Any]:
    """Return the parts `ate`, `rpe_1s`, `nees` and `silent_frames` of a report."""
    errors = _errors(accuracy)
    if errors['ate'] is not None:
        errors['ate']['coverage'] = accuracy.coverage
    return {
        **errors,
        'nees': None if accuracy.nees is None else _nees(accuracy.nees),
        'silent_frames': None if accuracy.silent is None else accuracy.silent.count,
    }


def _errors(accuracy: Accuracy) -> dict[str, Any]:
    """Return `ate` and `rpe_1s`."""
    ate, rpe = accuracy.ate, accuracy.rpe_1s
    keys = ('rmse_cm', 'mean_cm', 'median_cm', 'max_cm')
    return {
        'ate': None if ate is None else {key: getattr(ate, key) for key in keys},
        'rpe_1s': None
        if rpe is None
        else {'trans_rmse_cm': rpe.trans_rmse_cm, 'rot_rmse_deg': rpe.rot_rmse_deg},
    }


def _loops(record: RunRecord) -> dict[str, Any] | None:
    """Return how many loops were closed, how often the map was corrected, and its sub-maps."""
    if record.final is None:
        return None
    references = [frame.result.reference for frame in record.tracked]
    return {
        'closed': len(record.final.loops),
        'corrections': len({r.revision for r in references if r is not None and r.revision}),
        'submaps': len(np.unique(record.final.submaps)),
        'seconds': record.closing_s,
    }


def _nees(nees: MotionNees) -> dict[str, Any]:
    return {
        'median': float(np.median(nees.values)),
        'mean': float(np.mean(nees.values)),
        'mean_bounds_95': list(nees.mean_bounds()),
        'translation_median': float(np.median(nees.translation)),
        'rotation_median': float(np.median(nees.rotation)),
        'coverage_2sigma_translation': coverage_2sigma(nees.translation),
        'coverage_2sigma_rotation': coverage_2sigma(nees.rotation),
        'motions': len(nees.values),
        'independent_motions': nees.independent,
    }


def _speed(record: RunRecord) -> dict[str, float]:
    seconds = np.array([frame.seconds for frame in record.tracked])
    median, p95, p99 = np.percentile(1e3 * seconds, [50, 95, 99]).tolist()
    mean = float(len(seconds) / seconds.sum())
    return {'fps_mean': mean, 'ms_median': median, 'ms_p95': p95, 'ms_p99': p99}


def _mapping(record: RunRecord) -> dict[str, float]:
    tracked = record.tracked[-1].gaussians
    return {
        'gaussians': tracked if record.gaussians is None else record.gaussians,
        'iterations': record.iterations,
        'iterations_per_s': record.iterations / max(record.mapping_s, 1e-9),
    }


def _observability(record: RunRecord) -> dict[str, float | None]:
    """Return medians over the frames with a Hessian: neither the first nor lost ones."""
    known = [frame.result.observability for frame in record.tracked]
    report: dict[str, float | None] = {}
    for name in ('kappa', 'kappa_without_radius', 'kappa_rotation', 'kappa_translation'):
        values = [getattr(o, name) for o in known if o is not None]
        report[f'{name}_median'] = float(np.median(values)) if values else None
    return report


def _finite(value: Any) -> Any:
    """Replace non-finite numbers, which JSON cannot hold, by None."""
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
