# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""ATE and RPE against closed forms, invariances and evo."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dcgs_ros.core.trajectory import Trajectory
from dcgs_ros.evaluation.trajectory import (
    EvaluationError,
    absolute_trajectory_error,
    align_umeyama,
    associate,
    coverage,
    relative_pose_error,
)
from dcgs_ros.io.trajectory import read_tum

EVO_TOLERANCE = 1e-9  # centimetres and degrees
EXACT = 1e-9
SECOND_NS = 1_000_000_000


def rigid(rng: np.random.Generator, scale_m: float = 3.0) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    pose[:3, 3] = rng.normal(scale=scale_m, size=3)
    return pose


def walk(rng: np.random.Generator, count: int, step_ns: int = 33_000_000) -> Trajectory:
    """Return a smooth random path with jittered stamps."""
    jitter = rng.integers(-3_000_000, 3_000_000, count)
    stamps = 5 * SECOND_NS + step_ns * np.arange(count) + jitter
    turns = np.cumsum(rng.normal(scale=0.03, size=(count, 3)), axis=0)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    poses[:, :3, 3] = np.cumsum(rng.normal(scale=0.02, size=(count, 3)), axis=0)
    return Trajectory(stamps.astype(np.int64), poses)


def disturbed(rng: np.random.Generator, truth: Trajectory, sigma_m: float = 0.01) -> Trajectory:
    """Return the truth in another frame, with noise on each pose."""
    poses = rigid(rng) @ truth.T_world_cam
    poses[:, :3, 3] += rng.normal(scale=sigma_m, size=(len(truth), 3))
    small = Rotation.from_rotvec(rng.normal(scale=0.01, size=(len(truth), 3))).as_matrix()
    poses[:, :3, :3] = poses[:, :3, :3] @ small
    return Trajectory(truth.stamps_ns, poses)


def to_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    seconds = trajectory.stamps_ns / SECOND_NS
    return PoseTrajectory3D(poses_se3=list(trajectory.T_world_cam), timestamps=seconds)


def evo_pair(estimate: Trajectory, truth: Trajectory) -> tuple[PoseTrajectory3D, PoseTrajectory3D]:
    return sync.associate_trajectories(to_evo(truth), to_evo(estimate), max_diff=0.02)


def evo_ate_cm(estimate: Trajectory, truth: Trajectory) -> dict[str, float]:
    reference, aligned = evo_pair(estimate, truth)
    aligned.align(reference, correct_scale=False)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, aligned))
    return {name: 100 * value for name, value in ape.get_all_statistics().items()}


def assert_ate_is_evos(estimate: Trajectory, truth: Trajectory) -> None:
    ours, theirs = absolute_trajectory_error(estimate, truth), evo_ate_cm(estimate, truth)
    for name in ('rmse', 'mean', 'median', 'max'):
        assert getattr(ours, f'{name}_cm') == pytest.approx(theirs[name], abs=EVO_TOLERANCE)


# The estimate as dense as the truth, sparser and denser: evo matches from the sparser one.
@pytest.mark.parametrize(('every', 'truth_every'), [(1, 1), (4, 1), (1, 3), (3, 2)])
@pytest.mark.parametrize('seed', range(5))
def test_ate_is_evos(seed: int, every: int, truth_every: int) -> None:
    rng = np.random.default_rng(seed)
    path = walk(rng, 300, step_ns=9_000_000)
    noisy = disturbed(rng, path)
    estimate = Trajectory(noisy.stamps_ns[::every] + 1_000_000, noisy.T_world_cam[::every])
    truth = Trajectory(path.stamps_ns[::truth_every], path.T_world_cam[::truth_every])
    assert_ate_is_evos(estimate, truth)


@pytest.mark.parametrize('seed', range(3))
def test_rpe_is_evos_on_even_stamps(seed: int) -> None:
    rng = np.random.default_rng(seed)
    path = walk(rng, 200)
    stamps = 100_000_000 * np.arange(200, dtype=np.int64)
    truth = Trajectory(stamps, path.T_world_cam)
    estimate = disturbed(rng, truth)
    ours = relative_pose_error(estimate, truth)
    for relation, value in (
        (metrics.PoseRelation.translation_part, ours.trans_rmse_cm / 100),
        (metrics.PoseRelation.rotation_angle_deg, ours.rot_rmse_deg),
    ):
        rpe = metrics.RPE(relation, delta=10, delta_unit=metrics.Unit.frames, all_pairs=True)
        rpe.process_data((to_evo(truth), to_evo(estimate)))
        assert value == pytest.approx(
            rpe.get_statistic(metrics.StatisticsType.rmse), abs=EVO_TOLERANCE
        )
    assert ours.pairs == 190


@pytest.mark.parametrize('name', ['tum_fr3_teddy_200', 'mini_fr1_xyz_vga_120'])
def test_ate_on_real_truth_is_evos(data_dir: Path, name: str) -> None:
    truth = read_tum(data_dir / name / 'groundtruth.txt')
    lines = (data_dir / name / 'associations.txt').read_text().splitlines()
    stamps = np.array([int(line.split()[0].replace('.', '')) * 1000 for line in lines])
    stamps = stamps[stamps > truth.stamps_ns[0]]
    nearest = np.searchsorted(truth.stamps_ns, stamps)
    poses = truth.T_world_cam[np.minimum(nearest, len(truth) - 1)]
    assert_ate_is_evos(disturbed(np.random.default_rng(1), Trajectory(stamps, poses)), truth)


def test_ate_of_a_moved_copy_is_zero() -> None:
    rng = np.random.default_rng(2)
    truth = walk(rng, 100)
    T_estimate_truth = rigid(rng)
    ate = absolute_trajectory_error(
        Trajectory(truth.stamps_ns, T_estimate_truth @ truth.T_world_cam), truth
    )
    assert ate.max_cm < EXACT
    np.testing.assert_allclose(ate.T_truth_estimate @ T_estimate_truth, np.eye(4), atol=EXACT)
    assert ate.matched == ate.poses == 100


def test_ate_and_rpe_do_not_depend_on_the_world_frame() -> None:
    rng = np.random.default_rng(3)
    truth = walk(rng, 100)
    estimate = disturbed(rng, truth)
    moved = Trajectory(estimate.stamps_ns, rigid(rng) @ estimate.T_world_cam)
    first, second = (absolute_trajectory_error(e, truth) for e in (estimate, moved))
    np.testing.assert_allclose(first.errors_m, second.errors_m, atol=EXACT)
    first_rpe, second_rpe = (relative_pose_error(e, truth) for e in (estimate, moved))
    assert first_rpe.trans_rmse_cm == pytest.approx(second_rpe.trans_rmse_cm, abs=EXACT)
    assert first_rpe.rot_rmse_deg == pytest.approx(second_rpe.rot_rmse_deg, abs=EXACT)


def test_ate_sums_up_its_errors() -> None:
    rng = np.random.default_rng(4)
    truth = walk(rng, 50)
    ate = absolute_trajectory_error(disturbed(rng, truth), truth)
    assert ate.rmse_cm**2 == pytest.approx(1e4 * np.mean(ate.errors_m**2))
    assert ate.mean_cm <= ate.rmse_cm <= ate.max_cm
    np.testing.assert_array_equal(ate.stamps_ns, truth.stamps_ns)


def test_alignment_is_the_best_rigid_motion() -> None:
    rng = np.random.default_rng(5)
    points = rng.normal(size=(40, 3))
    targets = points @ rigid(rng)[:3, :3].T + rng.normal(scale=0.2, size=(40, 3))
    best = align_umeyama(points, targets)

    def cost(pose: NDArray[np.float64]) -> float:
        return float(np.sum((targets - points @ pose[:3, :3].T - pose[:3, 3]) ** 2))

    for _ in range(200):
        nudge = np.eye(4)
        nudge[:3, :3] = Rotation.from_rotvec(rng.normal(scale=1e-3, size=3)).as_matrix()
        nudge[:3, 3] = rng.normal(scale=1e-3, size=3)
        assert cost(best) <= cost(nudge @ best)


@pytest.mark.parametrize('shape', ['mirrored', 'flat', 'line', 'point'])
def test_alignment_is_a_rotation_in_degenerate_cases(shape: str) -> None:
    rng = np.random.default_rng(6)
    points = rng.normal(size=(30, 3))
    targets = points.copy()
    if shape == 'mirrored':
        targets[:, 0] *= -1
    else:
        kept = {'flat': 2, 'line': 1, 'point': 0}[shape]
        points[:, kept:] = 0
        targets = points @ rigid(rng)[:3, :3].T + 5
    T_target_point = align_umeyama(points, targets)
    rotation = T_target_point[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=EXACT)
    assert np.linalg.det(rotation) == pytest.approx(1)
    if shape != 'mirrored':
        aligned = points @ rotation.T + T_target_point[:3, 3]
        np.testing.assert_allclose(aligned, targets, atol=EXACT)


def test_rpe_of_a_constant_drift_is_the_drift() -> None:
    seconds = np.arange(0, 10, 0.04)
    stamps = (seconds * SECOND_NS).astype(np.int64)
    still = np.tile(np.eye(4), (len(stamps), 1, 1))
    drifting = still.copy()
    drifting[:, 0, 3] = 0.03 * seconds
    turning = still.copy()
    turning[:, :3, :3] = Rotation.from_rotvec(
        np.radians(2.0) * seconds[:, None] * [0, 0, 1]
    ).as_matrix()
    truth = Trajectory(stamps, still)
    drift = relative_pose_error(Trajectory(stamps, drifting), truth)
    assert drift.trans_rmse_cm == pytest.approx(3.0)
    assert drift.rot_rmse_deg == pytest.approx(0.0, abs=EXACT)
    turn = relative_pose_error(Trajectory(stamps, turning), truth)
    assert turn.trans_rmse_cm == pytest.approx(0.0, abs=EXACT)
    assert turn.rot_rmse_deg == pytest.approx(2.0)
    half = relative_pose_error(Trajectory(stamps, drifting), truth, delta_ns=SECOND_NS // 2)
    assert half.trans_rmse_cm == pytest.approx(1.5, rel=0.05)  # 12 or 13 frames of 40 ms


def test_rpe_leaves_out_pairs_across_a_gap() -> None:
    stamps = SECOND_NS // 10 * np.r_[0:15, 40:55].astype(np.int64)
    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[15:, 0, 3] = 7.0  # the jump is in the gap
    truth = Trajectory(stamps, np.tile(np.eye(4), (30, 1, 1)))
    rpe = relative_pose_error(Trajectory(stamps, poses), truth)
    assert rpe.pairs == 10  # five before the gap, five behind it
    assert rpe.trans_rmse_cm == 0


def test_association_takes_the_nearest_within_the_limit() -> None:
    rng = np.random.default_rng(7)
    milliseconds = 1_000_000
    a = walk(rng, 60, step_ns=50 * milliseconds)
    b = walk(rng, 200, step_ns=17 * milliseconds)
    i, j = associate(a, b, max_gap_ns=6 * milliseconds)
    gaps = np.abs(a.stamps_ns[:, None] - b.stamps_ns[None, :])
    np.testing.assert_array_equal(i, np.flatnonzero(gaps.min(axis=1) <= 6 * milliseconds))
    np.testing.assert_array_equal(gaps[i, j], gaps[i].min(axis=1))
    swapped = associate(b, a, max_gap_ns=6 * milliseconds)
    np.testing.assert_array_equal(swapped, (j, i))


def test_coverage_is_over_the_frames_with_truth() -> None:
    truth = walk(np.random.default_rng(8), 50)
    frames = truth.stamps_ns[:40] + 1_000_000
    early = frames - 60 * SECOND_NS  # no truth yet
    assert coverage(frames, frames, truth) == 1.0
    assert coverage(frames[:30], np.r_[early, frames], truth) == 0.75
    assert coverage(np.r_[early, frames[:30]], np.r_[early, frames], truth) == 0.75
    assert coverage(frames[:0], frames, truth) == 0.0
    assert coverage(early, early, truth) is None
    none = Trajectory(truth.stamps_ns[:0], truth.T_world_cam[:0])
    assert coverage(frames, frames, none) is None


def test_errors_say_what_cannot_be_compared_with_numbers() -> None:
    truth = walk(np.random.default_rng(8), 50)
    late = Trajectory(truth.stamps_ns + 60 * SECOND_NS, truth.T_world_cam)
    with pytest.raises(EvaluationError, match=r'found 0 of 50 .* 20 ms.*largest 6\d{4} ms'):
        absolute_trajectory_error(late, truth)
    two = Trajectory(truth.stamps_ns[:2], truth.T_world_cam[:2])
    with pytest.raises(EvaluationError, match='found 2 of 2 poses'):
        absolute_trajectory_error(two, truth)
    none = Trajectory(truth.stamps_ns[:0], truth.T_world_cam[:0])
    with pytest.raises(EvaluationError, match='0 estimated and 50 true'):
        absolute_trajectory_error(none, truth)
    short = Trajectory(truth.stamps_ns[:20], truth.T_world_cam[:20])
    with pytest.raises(EvaluationError, match=r'20 matched poses are 1 s apart.*span 0\.6'):
        relative_pose_error(short, truth)
