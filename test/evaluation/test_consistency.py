# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""NEES and silent frames against the distributions and the limits that define them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from dcgs_ros.core import se3
from dcgs_ros.core.tracking.result import TrackingState
from dcgs_ros.core.trajectory import Trajectory
from dcgs_ros.evaluation.consistency import (
    MotionNees,
    SilentFrames,
    coverage_2sigma,
    mean_nees_bounds,
    motion_nees,
    silent_frames,
)
from dcgs_ros.evaluation.trajectory import EvaluationError

OK, DEGENERATE = TrackingState.OK, TrackingState.DEGENERATE
LOST, RELOCALISED = TrackingState.LOST, TrackingState.RELOCALISED
FRAME_NS = 100_000_000  # ten frames a second: a motion over 1 s joins frames k - 10 and k
SECOND = 10  # frames
ROUNDING = 1e-9
SIGMA = np.array([2e-3, 5e-3, 1e-3, 4e-3, 1e-3, 2e-3])  # m and rad: small against curvature


def walk(rng: np.random.Generator, count: int) -> Trajectory:
    """Return a camera that turns by a radian and goes a metre in a second, about."""
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ se3.exp(rng.normal(scale=0.2, size=6)))
    return Trajectory(FRAME_NS * np.arange(count, dtype=np.int64), np.stack(poses))


def random_covariances(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Return covariances (count, 6, 6) whose shape and size change from frame to frame."""
    roots = rng.normal(size=(count, 6, 6)) * SIGMA[:, None]
    return roots @ roots.transpose(0, 2, 1) * rng.uniform(0.3, 3.0, (count, 1, 1))


def with_errors(
    rng: np.random.Generator, truth: Trajectory, covariances: NDArray[np.float64]
) -> Trajectory:
    """Return poses T exp(xi) whose independent errors xi have the given covariances."""
    errors = np.einsum(
        'nij,nj->ni', np.linalg.cholesky(covariances), rng.normal(size=(len(truth), 6))
    )
    return replace(
        truth,
        T_world_cam=np.stack(
            [T @ se3.exp(xi) for T, xi in zip(truth.T_world_cam, errors, strict=True)]
        ),
    )


def nees_of(
    seed: int, equal: bool, count: int = 4000, claimed: float = 1.0
) -> tuple[MotionNees, NDArray[np.int64]]:
    """Return the NEES of Gaussian errors where `claimed` times their covariance is claimed.

    Also which of the motions share no frame with another.
    """
    rng = np.random.default_rng(seed)
    truth = walk(rng, count)
    covariances = np.tile(np.diag(SIGMA**2), (count, 1, 1))
    if not equal:
        covariances = random_covariances(rng, count)
    estimate = with_errors(rng, truth, covariances)
    found = motion_nees(estimate, [OK] * count, claimed * covariances, truth)
    return found, np.flatnonzero(found.frames % (SECOND + 1) == SECOND)


@pytest.mark.parametrize('equal', [True, False])
@pytest.mark.parametrize('seed', range(3))
def test_nees_of_gaussian_errors_is_chi_square(seed: int, equal: bool) -> None:
    found, alone = nees_of(seed, equal)
    assert len(found.values) == 4000 - SECOND
    for values, dof in ((found.values, 6), (found.translation, 3), (found.rotation, 3)):
        assert stats.kstest(values[alone], stats.chi2(dof).cdf).pvalue > 1e-3
        low, high = mean_nees_bounds(len(alone), dof, confidence=0.999)
        assert low < values.mean() < high
    assert coverage_2sigma(found.values, dof=6) == pytest.approx(0.9545, abs=0.02)
    assert coverage_2sigma(found.translation) == pytest.approx(0.9545, abs=0.02)


def test_nees_is_over_the_covariance() -> None:
    once, fourfold = (nees_of(7, False, 200, claimed)[0] for claimed in (1.0, 4.0))
    for name in ('values', 'translation', 'rotation'):
        np.testing.assert_allclose(getattr(once, name), 4.0 * getattr(fourfold, name))


def test_the_first_pose_counts_where_it_is_seen_from_the_second() -> None:
    """An error in turning at the start moves the end, in proportion to the way between."""
    truth = standing(SECOND + 1)
    truth.T_world_cam[-1, 2, 3] = 2.0  # ahead
    xi = np.array([0, 0, 0, 0, 1e-4, 0])  # about y, 2 m behind: 0.2 mm sideways
    poses = truth.T_world_cam.copy()
    poses[0] = poses[0] @ se3.exp(xi)
    covariances = np.zeros((len(truth), 6, 6))
    covariances[0] = 1e-8 * np.eye(6)
    covariances[-1] = 1e-12 * np.eye(6)
    estimate = replace(truth, T_world_cam=poses)
    found = motion_nees(estimate, [OK] * len(truth), covariances, truth)
    at_end = found.frames == len(truth) - 1
    # sigma along x at the end: 0.1 mm of the start's own, and 2 m times 0.1 mrad
    assert found.translation[at_end] == pytest.approx(2e-4**2 / (1e-4**2 + 2e-4**2), rel=1e-3)
    assert found.rotation[at_end] == pytest.approx(1.0, rel=1e-3)


@pytest.mark.parametrize('moved', ['truth', 'estimate'])
def test_the_choice_of_a_world_changes_nothing(moved: str) -> None:
    rng = np.random.default_rng(1)
    truth, covariances = walk(rng, 60), random_covariances(rng, 60)
    estimate = with_errors(rng, truth, covariances)
    T = se3.exp(np.array([3.0, -2.0, 5.0, 0.5, 1.0, -1.5]))
    others = {
        'truth': (estimate, replace(truth, T_world_cam=T @ truth.T_world_cam)),
        'estimate': (replace(estimate, T_world_cam=T @ estimate.T_world_cam), truth),
    }
    states, sigmas_m = [OK] * 60, np.full(60, 1.5e-3)
    one = motion_nees(estimate, states, covariances, truth)
    other = motion_nees(others[moved][0], states, covariances, others[moved][1])
    np.testing.assert_allclose(one.values, other.values, rtol=1e-6)
    silent = silent_frames(estimate, states, sigmas_m, truth).silent
    assert 0 < silent.sum() < 60 - SECOND
    np.testing.assert_array_equal(
        silent, silent_frames(others[moved][0], states, sigmas_m, others[moved][1]).silent
    )


def test_an_error_that_the_covariance_excludes_is_infinite() -> None:
    truth = standing(20)
    off = shifted(truth, 15, 1e-3)
    found = motion_nees(off, [OK] * 20, np.zeros((20, 6, 6)), truth)
    assert found.values[found.frames < 15].tolist() == [0.0] * 5
    assert np.isinf(found.values[found.frames >= 15]).all()
    flat = np.tile(np.diag([1e-6, 0, 0, 0, 0, 0]), (20, 1, 1))  # along x, where the error is
    found = motion_nees(off, [OK] * 20, flat, truth)
    np.testing.assert_allclose(found.values[found.frames >= 15], 0.5)


def test_motions_with_a_loss_at_an_end_or_between_are_left_out() -> None:
    truth, states = standing(40), [OK] * 40
    states[20] = LOST
    found = motion_nees(truth, states, np.tile(np.eye(6), (40, 1, 1)), truth)
    assert found.frames.tolist() == [*range(10, 20), *range(31, 40)]
    states[20] = DEGENERATE
    states[21] = RELOCALISED
    found = motion_nees(truth, states, np.tile(np.eye(6), (40, 1, 1)), truth)
    assert found.frames.tolist() == [*range(10, 40)]


def test_motions_are_a_second_long_and_their_ends_have_truth() -> None:
    truth = standing(40)
    estimate = Trajectory(
        np.delete(truth.stamps_ns, range(15, 18)), np.delete(truth.T_world_cam, range(15, 18), 0)
    )
    covariances = np.tile(np.eye(6), (37, 1, 1))
    found = motion_nees(estimate, [OK] * 37, covariances, truth)
    ends = estimate.stamps_ns[found.frames] // FRAME_NS
    assert ends.tolist() == [*range(10, 15), *range(18, 25), *range(28, 40)]
    short = Trajectory(truth.stamps_ns[:30], truth.T_world_cam[:30])
    found = motion_nees(estimate, [OK] * 37, covariances, short)
    assert (estimate.stamps_ns[found.frames] // FRAME_NS).max() == 29
    with pytest.raises(EvaluationError, match='1 s apart'):
        motion_nees(estimate, [LOST] * 37, covariances, truth)
    with pytest.raises(EvaluationError, match='1 s apart'):
        motion_nees(
            estimate, [OK] * 37, covariances, replace(short, stamps_ns=short.stamps_ns + 10**12)
        )


def test_bounds_of_the_mean_are_those_of_motions_that_share_no_frame() -> None:
    found = motion_nees(
        standing(45), [OK] * 45, np.tile(np.eye(6), (45, 1, 1)), standing(45)
    )  # 0-10, 11-21, 22-32, 33-43
    assert found.independent == 4
    low, high = found.mean_bounds()
    chi2 = stats.chi2(24)
    assert (4 * low, 4 * high) == pytest.approx((chi2.ppf(0.025), chi2.ppf(0.975)))


@pytest.mark.parametrize('drifts', [False, True], ids=['independent errors', 'drift'])
def test_the_mean_of_overlapping_motions_is_within_its_bounds(drifts: bool) -> None:
    """At least as often as promised. Drift is what a tracker does: errors add up on the way."""
    inside, runs, count = 0, 300, 6 * (SECOND + 1)
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        errors = rng.normal(scale=1e-3, size=(count, 6))
        claimed = 1e-6 * np.eye(6)
        if drifts:  # ten steps a second, half claimed by either end
            errors, claimed = np.cumsum(errors, axis=0), 5e-6 * np.eye(6)
        estimate = replace(standing(count), T_world_cam=np.stack([se3.exp(xi) for xi in errors]))
        found = motion_nees(
            estimate, [OK] * count, np.tile(claimed, (count, 1, 1)), standing(count)
        )
        low, high = found.mean_bounds()
        inside += low < found.values.mean() < high
    assert inside >= 0.94 * runs


def standing(count: int) -> Trajectory:
    stamps = FRAME_NS * np.arange(count, dtype=np.int64)
    return Trajectory(stamps, np.tile(np.eye(4), (count, 1, 1)))


def shifted(trajectory: Trajectory, start: int, by_m: float) -> Trajectory:
    """Move all poses from `start` on sideways."""
    poses = trajectory.T_world_cam.copy()
    poses[start:, 0, 3] += by_m
    return replace(trajectory, T_world_cam=poses)


def silent_of(
    by_m: float,
    sigma_m: float = 1.0,
    states: dict[int, TrackingState] | None = None,
    truth: Trajectory | None = None,
) -> SilentFrames:
    """Judge 40 frames of a camera that jumps by `by_m` at frame 20 and stays there."""
    all_states = [(states or {}).get(k, OK) for k in range(40)]
    estimate = shifted(standing(40), 20, by_m)
    return silent_frames(estimate, all_states, np.full(40, sigma_m), truth or standing(40))


def at(mask: NDArray[np.bool_]) -> list[int]:
    return np.flatnonzero(mask).tolist()


JUMP = list(range(20, 30))  # frames whose last second has the jump


def test_ten_centimetres_are_silent_whatever_is_claimed() -> None:
    assert at(silent_of(0.1001).silent) == at(silent_of(0.1001).off) == JUMP
    assert silent_of(0.1001).count == 10
    assert silent_of(0.0999).count == 0
    assert at(silent_of(0.0999).judged) == list(range(10, 40))


def test_five_times_the_claimed_three_sigma_are_silent_however_small() -> None:
    assert at(silent_of(0.0151, 1e-3).overconfident) == JUMP
    assert not silent_of(0.0151, 1e-3).off.any()
    assert silent_of(0.0149, 1e-3).count == 0


def test_a_motion_between_two_worlds_is_not_judged() -> None:
    worlds = (np.arange(40) >= 20).astype(int)
    estimate, sigmas_m = shifted(standing(40), 20, 5.0), np.ones(40)
    assert silent_frames(estimate, [OK] * 40, sigmas_m, standing(40)).count == 10
    found = silent_frames(estimate, [OK] * 40, sigmas_m, standing(40), worlds)
    assert found.count == 0 and at(found.judged) == [*range(10, 20), *range(30, 40)]
    covariances = np.tile(np.eye(6), (40, 1, 1))
    nees = motion_nees(estimate, [OK] * 40, covariances, standing(40), worlds)
    assert nees.frames.tolist() == [*range(10, 20), *range(30, 40)]
    assert nees.values.max() == 0.0


def test_the_sigma_that_counts_is_the_one_of_the_frame() -> None:
    sigmas_m = np.full(40, 1.0)
    sigmas_m[25] = 1e-3
    found = silent_frames(shifted(standing(40), 20, 0.05), [OK] * 40, sigmas_m, standing(40))
    assert at(found.silent) == [25]


@pytest.mark.parametrize(('by_m', 'sigma_m'), [(0.5, 1.0), (0.05, 1e-3)])
@pytest.mark.parametrize('state', [DEGENERATE, LOST, RELOCALISED])
def test_a_frame_that_says_so_is_not_silent(
    state: TrackingState, by_m: float, sigma_m: float
) -> None:
    found = silent_of(by_m, sigma_m, states={20: state, 21: state})
    late = [30, 31] if state is LOST else []  # the motion since frame 19 counts
    assert at(found.silent) == JUMP[2:] + late
    assert found.judged[20:22].all() == (state is not LOST)


def test_a_camera_found_in_the_wrong_place_is_silent_for_a_second() -> None:
    """A lost frame's pose is no estimate: the motion since the last tracked frame counts."""
    lost = dict.fromkeys(range(12, 35), LOST)
    assert at(silent_of(0.5, states=lost).silent) == [35, 36, 37, 38, 39]
    assert silent_of(0.05, states=lost).count == 0
    told = lost | dict.fromkeys(range(35, 38), RELOCALISED)
    assert at(silent_of(0.5, states=told).silent) == [38, 39]


def test_the_pose_of_a_lost_frame_is_not_compared() -> None:
    """The camera moves on while lost, and is found where it is."""
    truth = shifted(standing(40), 15, 0.5)
    lost = dict.fromkeys(range(15, 20), LOST)
    assert silent_of(0.5, states=lost, truth=truth).count == 0


def test_a_gap_in_the_frames_is_bridged() -> None:
    kept = [*range(0, 12), *range(30, 40)]
    estimate = shifted(standing(40), 20, 0.5)
    estimate = Trajectory(estimate.stamps_ns[kept], estimate.T_world_cam[kept])
    found = silent_frames(estimate, [OK] * len(kept), np.ones(len(kept)), standing(40))
    assert [kept[k] for k in at(found.silent)] == list(range(30, 40))


def test_frames_without_truth_are_not_judged() -> None:
    truth = standing(40)
    without = [k for k in range(40) if k not in (12, 25)]
    truth = Trajectory(truth.stamps_ns[without], truth.T_world_cam[without])
    found = silent_of(0.5, truth=truth)
    assert at(found.silent) == [k for k in JUMP if k not in (22, 25)]
    assert not found.judged[[22, 25, 35]].any()
    late = replace(standing(40), stamps_ns=standing(40).stamps_ns + 10**12)
    assert not silent_of(0.5, truth=late).judged.any()
    assert not silent_of(0.5, states=dict.fromkeys(range(40), LOST)).judged.any()
