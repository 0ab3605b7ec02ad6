# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Whether a tracker's claims agree with its errors: NEES of 1 s motion, and silent frames.

A frame's claims are its state and its covariance (6, 6) of xi in T_world_cam exp(xi). Both
measures look at motion over a second, so neither the choice of worlds nor old drift matters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from ..core import se3
from ..core.tracking.result import TrackingState, TrackResult
from ..core.tracking.visited import origin
from ..core.trajectory import Trajectory
from .trajectory import MAX_GAP_NS, EvaluationError, nearest

INTERVAL_NS = 1_000_000_000
SILENT_ERROR_M = 0.10
SILENT_SIGMAS = 15.0  # five times the claimed 3 sigma
_TWO_SIGMA = 0.9545  # share of a Gaussian within 2 sigma of its mean


@dataclass(frozen=True)
class Claims:
    """What a tracker says of each of N frames, lost ones included."""

    poses: Trajectory  # (N,); that of a lost frame is no estimate
    states: tuple[TrackingState, ...]
    covariances: NDArray[np.float64]  # (N, 6, 6) in the map around the camera
    world_covariances: NDArray[np.float64]  # (N, 6, 6)
    submaps: NDArray[np.int32]  # (N,)
    uncorrected: Trajectory  # (N,) the poses without the steps that corrections of the map make

    @classmethod
    def of(cls, results: Sequence[TrackResult]) -> Claims:
        """Collect the results of a tracker in the order of their stamps.

        A clock that was set back gives some stamps twice: the first result of a stamp counts.
        """
        by_stamp = {result.stamp_ns: result for result in reversed(results)}
        results = [by_stamp[stamp_ns] for stamp_ns in sorted(by_stamp)]
        stamps = np.array([result.stamp_ns for result in results], np.int64)
        poses, covariances, world = (
            np.array([getattr(result, name) for result in results], np.float64).reshape(-1, n, n)
            for name, n in (('T_world_cam', 4), ('covariance', 6), ('covariance_world', 6))
        )
        states = tuple(result.state for result in results)
        references = [result.reference for result in results]
        submaps = np.array([result.submap for result in results], np.int32)
        before = [np.eye(4) if r is None else r.T_uncorrected_world for r in references]
        uncorrected = Trajectory(stamps, np.array(before).reshape(-1, 4, 4) @ poses)
        return cls(Trajectory(stamps, poses), states, covariances, world, submaps, uncorrected)

    @property
    def estimated(self) -> NDArray[np.bool_]:
        """(N,) which frames have an estimated pose: all but lost ones."""
        return np.array([state is not TrackingState.LOST for state in self.states], np.bool_)

    @property
    def main_submap(self) -> int:
        """The sub-map with the most estimated frames, the first of equals."""
        return int(np.bincount(self.submaps[self.estimated], minlength=1).argmax())

    @property
    def in_map(self) -> NDArray[np.bool_]:
        """(N,) which frames have an estimated pose in the main sub-map."""
        return self.estimated & (self.submaps == self.main_submap)

    @property
    def sigmas_m(self) -> NDArray[np.float64]:
        """(N,) square roots of the traces of the position's covariances."""
        return _position_sigmas_m(self.covariances)

    @property
    def world_sigmas_m(self) -> NDArray[np.float64]:
        """(N,) the same, in the world."""
        return _position_sigmas_m(self.world_covariances)

    def trajectory(self, submap: int | None = None) -> Trajectory:
        """Return the estimated poses in a sub-map, by default the main one."""
        submap = self.main_submap if submap is None else submap
        kept = self.estimated & (self.submaps == submap)
        poses = self.poses.T_world_cam[kept]
        poses[:, :3, 3] -= origin(submap)
        return Trajectory(self.poses.stamps_ns[kept], poses)


@dataclass(frozen=True)
class MotionNees:
    """Normalised estimation error squared of M motions over 1 s: e^T P^-1 e.

    e = log(inv(dT_true) dT_estimated), and P is the covariance that both ends claim. Of a
    consistent tracker the values are chi-square distributed: with 6 degrees of freedom (mean 6,
    median 5.35), translation and rotation with 3 (mean 3, median 2.37).
    """

    frames: NDArray[np.int64]  # (M,) index of the frame at the end of the motion
    values: NDArray[np.float64]  # (M,) of all six components
    translation: NDArray[np.float64]  # (M,) of the translation alone, with its block of P
    rotation: NDArray[np.float64]  # (M,) the same of the rotation
    independent: int  # most motions that share no frame: the others overlap with one of them

    def mean_bounds(self) -> tuple[float, float]:
        """Return the bounds of a consistent tracker's mean NEES, 95 %."""
        return mean_nees_bounds(self.independent)


@dataclass(frozen=True)
class SilentFrames:
    """Which of N frames are wrong without saying so.

    A frame is silent if its state is `ok` while the translation error of the motion over the last
    second is above 10 cm, or above five times the 3 sigma that the frame claims.
    """

    judged: NDArray[np.bool_]  # (N,) not lost, with truth now and a second before
    off: NDArray[np.bool_]  # (N,) `ok` and wrong by more than 10 cm
    overconfident: NDArray[np.bool_]  # (N,) `ok` and wrong by more than 15 sigma

    @property
    def silent(self) -> NDArray[np.bool_]:
        """(N,) which frames are silent, for either reason."""
        return self.off | self.overconfident

    @property
    def count(self) -> int:
        """Number of silent frames."""
        return int(self.silent.sum())


@dataclass(frozen=True)
class _Motions:
    """Motions of M pairs of frames that are not lost and have truth."""

    start: NDArray[np.int64]  # (M,) indices of frames
    end: NDArray[np.int64]  # (M,)
    T_start_end: NDArray[np.float64]  # (M, 4, 4) as estimated
    error: NDArray[np.float64]  # (M, 4, 4) inv(T_start_end as it truly is) T_start_end


def motion_nees(
    estimate: Trajectory,
    states: Sequence[TrackingState],
    covariances: NDArray[np.floating],
    truth: Trajectory,
    worlds: NDArray[np.integer] | None = None,
) -> MotionNees:
    """Return the NEES of the motions over 1 s, one for each frame that ends one.

    `estimate` and `states` are of all N frames, `covariances` (N, 6, 6) in m and rad, and `worlds`
    (N,) tell in which world each pose is, by default the same. Motions with a lost frame at an end
    or between are left out, as are those between worlds, and those without truth within 20 ms of
    either end. Raises `EvaluationError` if none is left.
    """
    motions, stamps = _motions(estimate, states, truth, worlds), estimate.stamps_ns
    lost = np.cumsum([state is TrackingState.LOST for state in states])
    interval = stamps[motions.end] - stamps[motions.start]
    kept = np.abs(interval - INTERVAL_NS) <= MAX_GAP_NS
    kept &= lost[motions.end] == lost[motions.start]
    if not kept.any():
        raise EvaluationError('no two frames 1 s apart have truth and are tracked all the time')
    start, end = motions.start[kept], motions.end[kept]
    errors = np.stack([se3.log(T) for T in motions.error[kept]])
    back = np.stack([se3.adjoint(T) for T in se3.inverse(motions.T_start_end[kept])])
    claimed = covariances[end] + back @ covariances[start] @ back.transpose(0, 2, 1)
    return MotionNees(
        frames=end,
        values=_nees(errors, claimed),
        translation=_nees(errors[:, :3], claimed[:, :3, :3]),
        rotation=_nees(errors[:, 3:], claimed[:, 3:, 3:]),
        independent=_disjoint(stamps[start], stamps[end]),
    )


def silent_frames(
    estimate: Trajectory,
    states: Sequence[TrackingState],
    sigmas_m: NDArray[np.floating],
    truth: Trajectory,
    worlds: NDArray[np.integer] | None = None,
) -> SilentFrames:
    """Return which frames are silent.

    `estimate` and `states` are of all N frames; `sigmas_m` (N,) are square roots of the trace of
    the claimed covariance of the translation. Where the frame of a second before is lost or
    missing, the motion since the last tracked one before it counts: a camera that is found in the
    wrong place would otherwise never be noticed. Frames of the first second, those whose motion is
    between two of the `worlds` (N,), by default one, and those without truth within 20 ms of
    either end, are not judged.
    """
    motions = _motions(estimate, states, truth, worlds)
    errors_m = np.full(len(estimate), np.nan)
    errors_m[motions.end] = np.linalg.norm(motions.error[:, :3, 3], axis=1)
    sure = np.array([state is TrackingState.OK for state in states], np.bool_)
    return SilentFrames(
        judged=np.isfinite(errors_m),
        off=sure & (errors_m > SILENT_ERROR_M),
        overconfident=sure & (errors_m > SILENT_SIGMAS * sigmas_m),
    )


def mean_nees_bounds(samples: int, dof: int = 6, confidence: float = 0.95) -> tuple[float, float]:
    """Return the interval that holds the mean NEES of `samples` independent errors.

    Their sum is chi-square distributed with samples * dof degrees of freedom. Motions over a
    second that begin with every frame overlap: `samples` is then the number of those that share no
    frame. The mean over all varies less than the mean over these, so the interval is on the safe
    side.
    """
    tail = 0.5 * (1.0 - confidence)
    low, high = (_chi2_quantile(share, samples * dof) / samples for share in (tail, 1.0 - tail))
    return low, high


def coverage_2sigma(nees: NDArray[np.floating], dof: int = 3) -> float:
    """Return the share of errors within the ellipsoid that holds 95.45 % of a Gaussian.

    An ellipsoid, since its ideal share is the same for every shape of the covariance and every
    choice of axes; a sphere of radius 2 sqrt(trace) holds between 95.45 and 99.3 %.
    """
    return float(np.mean(nees <= _chi2_quantile(_TWO_SIGMA, dof)))


def _position_sigmas_m(covariances: NDArray[np.float64]) -> NDArray[np.float64]:
    variances: NDArray[np.float64] = np.trace(covariances[:, :3, :3], axis1=1, axis2=2)
    return np.sqrt(variances)


def _motions(
    estimate: Trajectory,
    states: Sequence[TrackingState],
    truth: Trajectory,
    worlds: NDArray[np.integer] | None,
) -> _Motions:
    """Pair each frame that is not lost with the one of a second before; both have truth.

    That is the tracked frame nearest to a second before, within 20 ms, else the last before it.
    """
    frames = np.flatnonzero([state is not TrackingState.LOST for state in states])
    stamps = estimate.stamps_ns[frames]
    if not len(frames) or not len(truth):
        none = np.zeros(0, np.int64)
        return _Motions(none, none, np.zeros((0, 4, 4)), np.zeros((0, 4, 4)))
    wanted = stamps - INTERVAL_NS
    close, gap = nearest(wanted, stamps)
    start = np.where(gap <= MAX_GAP_NS, close, np.searchsorted(stamps, wanted, 'right') - 1)
    j, gap = nearest(stamps, truth.stamps_ns)
    known = gap <= MAX_GAP_NS
    within = np.ones(len(frames), np.bool_)
    if worlds is not None:
        within = worlds[frames] == worlds[frames][start]
    end = np.flatnonzero((start >= 0) & known & known[start] & within)
    start = start[end]
    moved, moved_truly = (
        se3.inverse(poses[start]) @ poses[end]
        for poses in (estimate.T_world_cam[frames], truth.T_world_cam[j])
    )
    return _Motions(frames[start], frames[end], moved, se3.inverse(moved_truly) @ moved)


def _nees(errors: NDArray[np.float64], covariances: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return e^T P^-1 e (M,); infinite for an error that P says is impossible."""
    variances, axes = np.linalg.eigh(covariances)
    squares = np.einsum('mik,mi->mk', axes, errors) ** 2
    with np.errstate(divide='ignore', invalid='ignore'):
        terms = squares / np.maximum(variances, 0.0)
    return np.where(squares == 0.0, 0.0, terms).sum(axis=1)


def _disjoint(start_ns: NDArray[np.int64], end_ns: NDArray[np.int64]) -> int:
    """Return the largest number of the intervals (M,), sorted by their ends, that do not touch."""
    count, last_ns = 0, np.iinfo(np.int64).min
    for first, last in zip(start_ns.tolist(), end_ns.tolist(), strict=True):
        if first > last_ns:
            count, last_ns = count + 1, last
    return count


def _chi2_quantile(share: float, dof: int) -> float:
    """Return the quantile of the chi-square distribution; scipy.stats takes long to import."""
    return 2.0 * float(gammaincinv(0.5 * dof, share))
