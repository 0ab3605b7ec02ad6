# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Errors of an estimated trajectory against ground truth: ATE and RPE."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..core import se3
from ..core.errors import DcgsError
from ..core.trajectory import Trajectory

MAX_GAP_NS = 20_000_000  # poses farther apart in time are not compared
MIN_MATCHES = 3  # fewer points do not determine the alignment


class EvaluationError(DcgsError):
    """The two trajectories cannot be compared."""


@dataclass(frozen=True)
class AteResult:
    """Absolute trajectory error: distances between positions after rigid alignment."""

    rmse_cm: float
    mean_cm: float  # what some publications print as RMSE
    median_cm: float
    max_cm: float
    matched: int  # poses compared
    poses: int  # poses estimated
    stamps_ns: NDArray[np.int64]  # (matched,) of the estimate
    errors_m: NDArray[np.float64]  # (matched,)
    T_truth_estimate: NDArray[np.float64]  # (4, 4) the alignment: estimate's world to truth's
    scale: float  # of the estimate's motion that fits the truth best
    scaled_rmse_cm: float  # what would then be left


@dataclass(frozen=True)
class RpeResult:
    """Relative pose error: the drift over a fixed time interval."""

    trans_rmse_cm: float
    rot_rmse_deg: float
    pairs: int


def associate(
    estimate: Trajectory, truth: Trajectory, max_gap_ns: int = MAX_GAP_NS
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Match poses by their stamps; return indices into `estimate` and into `truth`, (M,) each.

    Each pose of the trajectory with fewer poses is matched to the nearest of the other, the
    earlier of two equally near, if it is within `max_gap_ns`; a pose of the other may be matched
    more than once. This is evo's rule. Raises `EvaluationError` for fewer than three matches.
    """
    if not len(estimate) or not len(truth):
        raise EvaluationError(f'{len(estimate)} estimated and {len(truth)} true poses')
    # As in evo: of two equally long trajectories the estimate counts as the shorter one.
    estimate_is_shorter = len(estimate) <= len(truth)
    short, long = (estimate, truth) if estimate_is_shorter else (truth, estimate)
    matches, gaps = nearest(short.stamps_ns, long.stamps_ns)
    kept = np.flatnonzero(gaps <= max_gap_ns)
    if len(kept) < MIN_MATCHES:
        raise EvaluationError(
            f'found {len(kept)} of {len(short)} poses within {max_gap_ns / 1e6:g} ms, need '
            f'{MIN_MATCHES}: smallest gap {gaps.min() / 1e6:.0f} ms, '
            f'largest {gaps.max() / 1e6:.0f} ms'
        )
    return (kept, matches[kept]) if estimate_is_shorter else (matches[kept], kept)


def nearest(
    stamps_ns: NDArray[np.int64], others_ns: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return for each of `stamps_ns` (N,) the index of the nearest of `others_ns`, and the gap.

    Of two equally near the earlier one. `others_ns` (M,) increase, and are not empty.
    """
    right = np.clip(np.searchsorted(others_ns, stamps_ns), 1, max(len(others_ns) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(others_ns) - 1)
    gap_left = np.abs(stamps_ns - others_ns[left])
    gap_right = np.abs(others_ns[right] - stamps_ns)
    return np.where(gap_left <= gap_right, left, right), np.minimum(gap_left, gap_right)


def coverage(
    estimated_ns: NDArray[np.int64], stamps_ns: NDArray[np.int64], truth: Trajectory
) -> float | None:
    """Return how many of the frames with truth have an estimate, as a share; None without any.

    `stamps_ns` (N,) are of all frames, `estimated_ns` (M,) of those with an estimate.
    """
    if not len(truth):
        return None
    estimated, frames = (
        int((nearest(stamps, truth.stamps_ns)[1] <= MAX_GAP_NS).sum())
        for stamps in (estimated_ns, stamps_ns)
    )
    return estimated / frames if frames else None


def align_umeyama(
    points: NDArray[np.float64], targets: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return T_target_point (4, 4), the rigid transform with the least squared distances.

    `points` and `targets` are (N, 3), metres; there is no scale (Umeyama 1991). If all points lie
    on a line, the rotation about it is arbitrary, and the distances are still the least.
    """
    points, targets = np.asarray(points, np.float64), np.asarray(targets, np.float64)
    mean_point, mean_target = points.mean(axis=0), targets.mean(axis=0)
    covariance = (targets - mean_target).T @ (points - mean_point)
    u, _, vt = np.linalg.svd(covariance)
    proper = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    T_target_point = np.eye(4)
    T_target_point[:3, :3] = (u * proper) @ vt
    T_target_point[:3, 3] = mean_target - T_target_point[:3, :3] @ mean_point
    return T_target_point


def absolute_trajectory_error(
    estimate: Trajectory, truth: Trajectory, max_gap_ns: int = MAX_GAP_NS
) -> AteResult:
    """Return the ATE over all matched poses after `align_umeyama`; raises as `associate` does."""
    i, j = associate(estimate, truth, max_gap_ns)
    points = estimate.T_world_cam[i, :3, 3]
    targets = truth.T_world_cam[j, :3, 3]
    T_truth_estimate = align_umeyama(points, targets)
    aligned = se3.transform(T_truth_estimate, points)
    errors = np.linalg.norm(targets - aligned, axis=1)
    scale, scaled_errors = _scaled(aligned, targets)
    return AteResult(
        rmse_cm=100 * _rms(errors),
        mean_cm=100 * float(errors.mean()),
        median_cm=100 * float(np.median(errors)),
        max_cm=100 * float(errors.max()),
        matched=len(i),
        poses=len(estimate),
        stamps_ns=estimate.stamps_ns[i],
        errors_m=errors,
        T_truth_estimate=T_truth_estimate,
        scale=scale,
        scaled_rmse_cm=100 * _rms(scaled_errors),
    )


def _scaled(
    aligned: NDArray[np.floating], targets: NDArray[np.floating]
) -> tuple[float, NDArray[np.float64]]:
    """Return the scale of aligned points (N, 3) that fits best, and the distances then, (N,)."""
    points, targets = aligned - aligned.mean(axis=0), targets - targets.mean(axis=0)
    spread = float(np.sum(points**2))
    scale = float(np.sum(points * targets)) / spread if spread > 0 else 1.0
    return scale, np.linalg.norm(targets - scale * points, axis=1)


def relative_pose_error(
    estimate: Trajectory,
    truth: Trajectory,
    delta_ns: int = 1_000_000_000,
    tolerance_ns: int = MAX_GAP_NS,
    max_gap_ns: int = MAX_GAP_NS,
) -> RpeResult:
    """Return the RPE between each pose and the one nearest to `delta_ns` later.

    Pairs whose interval differs from `delta_ns` by more than `tolerance_ns` are left out, as
    across a gap. Raises `EvaluationError` if no pair is left.
    """
    i, j = associate(estimate, truth, max_gap_ns)
    stamps = estimate.stamps_ns[i]
    wanted = stamps + delta_ns
    after = np.clip(np.searchsorted(stamps, wanted), 1, len(stamps) - 1)
    end = np.where(wanted - stamps[after - 1] <= stamps[after] - wanted, after - 1, after)
    start = np.flatnonzero(np.abs(stamps[end] - wanted) <= tolerance_ns)
    if not len(start):
        raise EvaluationError(
            f'no two of {len(stamps)} matched poses are {delta_ns / 1e9:g} s apart: '
            f'they span {(stamps[-1] - stamps[0]) / 1e9:.2f} s'
        )
    end = end[start]
    moved = _relative(estimate.T_world_cam[i], start, end)
    moved_truly = _relative(truth.T_world_cam[j], start, end)
    error = np.linalg.inv(moved_truly) @ moved
    angles = Rotation.from_matrix(error[:, :3, :3]).magnitude()
    return RpeResult(
        trans_rmse_cm=100 * _rms(np.linalg.norm(error[:, :3, 3], axis=1)),
        rot_rmse_deg=float(np.degrees(_rms(angles))),
        pairs=len(start),
    )


def _relative(
    poses: NDArray[np.float64], start: NDArray[np.int64], end: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return T_start_end (N, 4, 4) of the poses at the indices `start` and `end`, (N,) each."""
    return np.linalg.inv(poses[start]) @ poses[end]


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
