# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What a tracker made of a fault: whether it told of it, came back, or was wrong and sure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dcgs_ros.core.tracking.result import TrackResult
from dcgs_ros.core.trajectory import Trajectory
from dcgs_ros.evaluation.consistency import SilentFrames, silent_frames
from dcgs_ros.evaluation.trajectory import align_umeyama

from .frame_faults import Fault, Faulted, Shot

_SECOND_S = 1.0
_RECOVERED_M, _RECOVERED_RAD = 0.05, np.radians(5.0)
_LASTING_FRAMES = 10  # in a row, or to the end, are not by chance
_BEYOND_M, _BEYOND_RAD = 0.10, np.radians(10.0)


@dataclass(frozen=True)
class Run:
    """What came of each shot."""

    shots: Sequence[Shot]
    results: Sequence[TrackResult | None]  # None: refused

    @property
    def states(self) -> list[str]:
        """The state after each shot, or 'refused'."""
        return ['refused' if r is None else r.state.value for r in self.results]

    @property
    def ok(self) -> NDArray[np.bool_]:
        """(N,) whether the tracker was sure of the pose."""
        return np.array([state == 'ok' for state in self.states])

    @property
    def poses(self) -> NDArray[np.float64]:
        """(N, 4, 4) estimated T_world_cam, NaN where the frame was refused."""
        missing = np.full((4, 4), np.nan)
        return np.stack([missing if r is None else r.T_world_cam for r in self.results])

    @property
    def truth(self) -> NDArray[np.float64]:
        """(N, 4, 4) true T_world_cam."""
        return np.stack([shot.T_world_cam for shot in self.shots])

    @property
    def times_s(self) -> NDArray[np.float64]:
        """(N,) true times."""
        return np.array([shot.time_s for shot in self.shots])

    @property
    def sigmas_m(self) -> NDArray[np.float64]:
        """(N,) claimed standard deviation of the position, NaN where the frame was refused."""
        return np.array(
            [
                np.nan if r is None else np.sqrt(np.trace(r.covariance[:3, :3]))
                for r in self.results
            ]
        )

    @property
    def submaps(self) -> NDArray[np.int64]:
        """(N,) in which sub-map each frame is; -1 where it was refused."""
        return np.array([-1 if r is None else r.submap for r in self.results])


def silent(run: Run) -> SilentFrames:
    """Return which frames are wrong and sure over the last second of true time.

    Refused frames have no pose and are never silent. Stamps do not count: they may be the fault.
    """
    given = np.flatnonzero([result is not None for result in run.results])
    stamps_ns = np.round(run.times_s[given] * 1e9).astype(np.int64)
    found = silent_frames(
        Trajectory(stamps_ns, run.poses[given]),
        [result.state for result in run.results if result is not None],
        run.sigmas_m[given], Trajectory(stamps_ns, run.truth[given]), run.submaps[given],
    )  # fmt: skip
    judged, off, overconfident = (np.zeros(len(run.shots), np.bool_) for _ in range(3))
    judged[given], off[given] = found.judged, found.off
    overconfident[given] = found.overconfident
    return SilentFrames(judged, off, overconfident)


@dataclass(frozen=True)
class Errors:
    """Distances (N,) of estimated poses from the true ones, NaN where there is no pose."""

    metres: NDArray[np.float64]
    radians: NDArray[np.float64]

    @classmethod
    def of(cls, poses: NDArray[np.float64], truth: NDArray[np.float64]) -> Errors:
        """Compare aligned poses (N, 4, 4) with the truth."""
        metres = np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1)
        radians = np.full(len(poses), np.nan)
        known = np.isfinite(metres)
        turned = np.swapaxes(truth[known, :3, :3], 1, 2) @ poses[known, :3, :3]
        if len(turned):
            radians[known] = Rotation.from_matrix(turned).magnitude()
        return cls(metres, radians)


@dataclass(frozen=True)
class Reference:
    """The run without fault: its alignment with the truth, and what is its error where."""

    T_truth_estimate: NDArray[np.float64]  # (4, 4)
    errors: Errors

    @classmethod
    def of(cls, run: Run) -> Reference:
        """Align a run of which every frame has a pose."""
        T = align_umeyama(run.poses[:, :3, 3], run.truth[:, :3, 3])
        return cls(T, Errors.of(T @ run.poses, run.truth))

    def errors_of(self, run: Run) -> Errors:
        """Return the errors of another run in the same alignment."""
        return Errors.of(self.T_truth_estimate @ run.poses, run.truth)

    def errors_at(self, shots: Sequence[Shot]) -> Errors:
        """Return the errors of the run without fault at the same places; 0 where it was not."""
        sources = np.array([-1 if shot.source is None else shot.source for shot in shots])
        there = sources >= 0
        return Errors(
            np.where(there, self.errors.metres[sources], 0.0),
            np.where(there, self.errors.radians[sources], 0.0),
        )


@dataclass(frozen=True)
class Score:
    """What came of a fault; frames are counted from its beginning to the end of the sequence."""

    detected_s: float | None  # after its beginning; None: not
    recovered_s: float | None  # after its end, once a place seen before is in view; None: not
    seen: bool  # whether the camera came to such a place, for a while
    silent: int  # frames that are wrong over the last second, and sure (`silent_frames`)
    silent_10_cm: int  # those of them that are wrong by more than 10 cm
    absolute: int  # frames that are wrong in the map by more than the run without fault, and sure
    worst_cm: float  # largest error in the map while sure
    states: Counter[str]


def score(
    fault: Fault, faulted: Faulted, run: Run, reference: Reference, seen: NDArray[np.bool_]
) -> Score:
    """Judge a run with a fault; `seen` (N,) says whether a shot is of a place seen before it."""
    after = np.arange(len(run.shots)) >= faulted.begin
    found = silent(run)
    errors, clean = reference.errors_of(run), reference.errors_at(run.shots)
    beyond = (errors.metres > clean.metres + _BEYOND_M) | (
        errors.radians > clean.radians + _BEYOND_RAD
    )
    sure = run.ok & after & (run.submaps == 0)  # of the place in another one nothing is claimed
    return Score(
        _detected_s(fault, faulted, run), _recovered_s(faulted, run, errors, clean, seen),
        bool(_lasting(seen)[faulted.end :].any()),
        int((found.silent & after).sum()), int((found.off & after).sum()),
        int((sure & beyond).sum()), 100 * float(np.max(errors.metres[sure], initial=0.0)),
        Counter(run.states[faulted.begin :]),
    )  # fmt: skip


def _detected_s(fault: Fault, faulted: Faulted, run: Run) -> float | None:
    """Return when a state tells of the fault: while it lasts, or within a second."""
    times = run.times_s
    until_s = max(times[faulted.end], times[faulted.begin] + _SECOND_S)
    for time_s, state in zip(times[faulted.begin :], run.states[faulted.begin :], strict=True):
        if time_s < until_s and state in fault.detected_by:
            return float(time_s - times[faulted.begin])
    return None


def _recovered_s(
    faulted: Faulted, run: Run, errors: Errors, clean: Errors, seen: NDArray[np.bool_]
) -> float | None:
    """Return when the pose is right and sure again, and stays so for a while.

    Time counts from the end of the fault, or from when the camera comes to a place seen before.
    """
    right = (errors.metres < np.maximum(_RECOVERED_M, 2 * clean.metres)) & (
        errors.radians < np.maximum(_RECOVERED_RAD, 2 * clean.radians)
    )
    back = _lasting(run.ok & right)
    for k in range(faulted.end, len(back)):
        if back[k]:
            start = faulted.end + int(np.argmax(_lasting(seen)[faulted.end :]))
            return max(0.0, float(run.times_s[k] - run.times_s[start]))
    return None


def _lasting(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return (N,) where a mask holds, and goes on to hold for a while or to the end."""
    return np.array([mask[k : k + _LASTING_FRAMES].all() for k in range(len(mask))], np.bool_)
