# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""When a keyframe is asked for, and what it spawns."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.stages import CloudConfig, KeyframeConfig
from dcgs_ros.core.sensor import SensorNoise
from dcgs_ros.core.tracking.cloud import FrameCloud, sample_cloud
from dcgs_ros.core.tracking.gaussian_map import GaussianMap
from dcgs_ros.core.tracking.keyframes import KeyframePolicy, confirmed, spawn, thinned

SPAWNED_M = 2e-6  # float32 at a few metres
ALMOST_NOTHING = 0.1  # of a keyframe, from another jitter of the same samples
CERTAIN_M = 0.03
STRIDE = 5
SENSOR = SensorNoise.structured_light()
CONFIG = KeyframeConfig()
CAMERA = PinholeCamera(320, 240, 262.0, 262.0, 159.5, 119.5)
T_WORLD_CAM = se3.exp(np.array([0.4, -0.3, 0.2, 0.3, -0.8, 0.5]))
BEFORE_BUDGET_NS = round(0.5e9 * CONFIG.min_interval_s)
LATER_NS = round(1.5e9 * CONFIG.min_interval_s)
LANDMARKS = 100


def wants(
    policy: KeyframePolicy,
    xi: NDArray[np.floating] | None = None,
    after_ns: int = LATER_NS,
    overlap: float = 0.9,
    landmarks: int = LANDMARKS,
    turn_rad_s: float = 0.0,
) -> bool:
    """Ask for a frame that moved by xi since the keyframe."""
    return policy.wants(
        T_world_cam=T_WORLD_CAM @ se3.exp(np.zeros(6) if xi is None else xi),
        stamp_ns=after_ns,
        turn_rad_s=turn_rad_s,
        overlap=overlap,
        landmarks=landmarks,
    )


def policy_at_keyframe(overlap: float = 0.9, landmarks: int = LANDMARKS) -> KeyframePolicy:
    """A policy just after a keyframe, which has seen one frame with that overlap."""
    policy = KeyframePolicy(CONFIG)
    policy.took(T_WORLD_CAM, 0, landmarks)
    assert not wants(policy, overlap=overlap, landmarks=landmarks)
    return policy


def along(axis: int, length: float) -> NDArray[np.float64]:
    xi = np.zeros(6)
    xi[axis] = length
    return xi


def test_a_camera_that_stays_needs_none() -> None:
    policy = policy_at_keyframe()
    assert not any(wants(policy, after_ns=k * LATER_NS) for k in range(1, 50))


@pytest.mark.parametrize('axis', range(6))
@pytest.mark.parametrize('sign', [-1, 1])
def test_moving_on_asks(axis: int, sign: int) -> None:
    limit = CONFIG.translation_m if axis < 3 else CONFIG.rotation_rad
    policy = policy_at_keyframe()
    assert not wants(policy, along(axis, 0.95 * sign * limit))
    assert wants(policy, along(axis, 1.05 * sign * limit))


def test_motion_is_counted_from_the_last_keyframe() -> None:
    policy, step = policy_at_keyframe(), along(0, 1.5 * CONFIG.translation_m)
    assert wants(policy, step)
    policy.took(T_WORLD_CAM @ se3.exp(step), LATER_NS, LANDMARKS)
    assert not wants(policy, step, after_ns=2 * LATER_NS)
    assert wants(policy, after_ns=2 * LATER_NS)


def test_the_budget_holds_back_motion() -> None:
    policy, step = policy_at_keyframe(), along(0, 2 * CONFIG.translation_m)
    assert not wants(policy, step, after_ns=BEFORE_BUDGET_NS)
    assert wants(policy, step, after_ns=LATER_NS)


def test_a_fast_turn_waits_but_need_does_not() -> None:
    """What a blurred frame builds would stay."""
    policy, step = policy_at_keyframe(), along(0, 2 * CONFIG.translation_m)
    assert not wants(policy, step, turn_rad_s=1.05 * CONFIG.max_turn_rad_s)
    assert wants(policy, step, turn_rad_s=0.95 * CONFIG.max_turn_rad_s)
    assert wants(policy, landmarks=5, turn_rad_s=1.05 * CONFIG.max_turn_rad_s)


@pytest.mark.parametrize('best', [0.95, 0.5, 0.3])
def test_overlap_is_held_against_the_best_since_the_last_keyframe(best: float) -> None:
    """What a noisy sensor never explains is not news."""
    policy = policy_at_keyframe(overlap=best)
    assert not wants(policy, overlap=1.02 * CONFIG.overlap * best)
    assert wants(policy, overlap=0.98 * CONFIG.overlap * best)
    assert not wants(policy, after_ns=BEFORE_BUDGET_NS, overlap=0.98 * CONFIG.overlap * best)


def test_the_best_overlap_is_forgotten_at_a_keyframe() -> None:
    policy = policy_at_keyframe(overlap=0.95)
    assert wants(policy, overlap=0.5)
    policy.took(T_WORLD_CAM, 0, LANDMARKS)
    assert not wants(policy, overlap=0.5)


def test_losing_landmarks_asks() -> None:
    policy = policy_at_keyframe()
    kept = CONFIG.landmarks * LANDMARKS
    assert not wants(policy, landmarks=round(1.05 * kept))
    assert wants(policy, landmarks=round(0.95 * kept))


def test_where_there_are_no_landmarks_their_loss_asks_for_none() -> None:
    for few in (0, CONFIG.min_landmarks - 1):
        policy = policy_at_keyframe(landmarks=few)
        assert not wants(policy, landmarks=0)


def test_thinning_leaves_one_point_a_voxel() -> None:
    cloud = wall(0.5)
    kept = thinned(cloud, 0.02).points
    voxels = np.floor(kept / np.float32(0.02)).astype(int)
    assert len(np.unique(voxels, axis=0)) == len(kept)
    assert len(np.unique(np.floor(cloud.points / np.float32(0.02)), axis=0)) == len(kept)


def test_need_is_above_the_budget() -> None:
    """Almost nothing explained, or almost no landmark left: at once."""
    assert wants(policy_at_keyframe(), after_ns=BEFORE_BUDGET_NS, overlap=0.1)
    assert wants(policy_at_keyframe(), after_ns=BEFORE_BUDGET_NS, landmarks=5)


def wall(distance_m: float = 1.5, seed: int = 1, tilt: float = 0.3) -> FrameCloud:
    """Samples of a slanted wall."""
    x, y = CAMERA.undistortion_map[..., 0], CAMERA.undistortion_map[..., 1]
    depth_m = (distance_m / (1 - tilt * x + 0.1 * y)).astype(np.float32)
    return sample_cloud(
        depth_m, CAMERA.undistortion_map, CloudConfig(), SENSOR, STRIDE, seed, np.zeros(6)
    )


def spawned(
    cloud: FrameCloud,
    gaussians: GaussianMap,
    T_world_cam: NDArray[np.float64] = T_WORLD_CAM,
    host: int = 0,
    sensor: SensorNoise = SENSOR,
) -> NDArray[np.int64]:
    return spawn(cloud, T_world_cam, gaussians, host, CAMERA.focal, sensor, CONFIG, CERTAIN_M)


def test_into_an_empty_map_everything_is_spawned_where_it_is() -> None:
    gaussians, cloud = GaussianMap(0.06), wall()
    ids = spawned(cloud, gaussians, host=3)
    assert len(ids) == len(cloud) == len(gaussians) > 1000
    R, t = T_WORLD_CAM[:3, :3], T_WORLD_CAM[:3, 3]
    np.testing.assert_allclose(gaussians.means, cloud.points @ R.T + t, atol=SPAWNED_M)
    np.testing.assert_allclose(gaussians.normals, cloud.normals @ R.T, atol=SPAWNED_M)
    np.testing.assert_array_equal(gaussians.flatness, cloud.flatness)
    np.testing.assert_allclose(gaussians.viewpoints, [t] * len(ids), atol=SPAWNED_M)
    np.testing.assert_array_equal(gaussians.hosts, 3)


def test_the_same_view_again_spawns_nothing() -> None:
    gaussians, cloud = GaussianMap(0.06), wall()
    spawned(cloud, gaussians)
    assert len(spawned(cloud, gaussians)) == 0


def test_other_samples_of_the_same_view_spawn_almost_nothing() -> None:
    """Nor do the fourth and fifth: the surface fills up."""
    gaussians = GaussianMap(0.06)
    first = len(spawned(wall(seed=1), gaussians))
    later = [len(spawned(wall(seed=seed), gaussians)) for seed in range(2, 7)]
    assert max(later) < ALMOST_NOTHING * first
    assert later[-1] < 0.3 * later[0] + 5


def test_noise_along_the_ray_spawns_no_second_layer() -> None:
    """Another depth of the same surface, within its noise."""
    gaussians, cloud = GaussianMap(0.06), wall(2.5, tilt=0.0)
    spawned(cloud, gaussians)
    sigma = SENSOR.sigma(cloud.points[:, 2])[:, None].astype(np.float32)
    farther = cloud.points * (1 + 1.5 * sigma / cloud.points[:, 2:])
    noisy = FrameCloud(farther.astype(np.float32), cloud.normals, cloud.flatness, cloud.samples)
    assert len(spawned(noisy, gaussians)) < ALMOST_NOTHING * len(cloud)


def test_another_surface_behind_is_spawned() -> None:
    gaussians = GaussianMap(0.06)
    spawned(wall(1.5), gaussians)
    behind = wall(1.7)
    assert len(spawned(behind, gaussians)) == len(behind)


def test_what_the_sensor_is_not_sure_of_spawns_nothing() -> None:
    """Sigma_z above what an association may bridge."""
    vague = SensorNoise(a_m=0.5 * CERTAIN_M, b_per_m=0.5 * CERTAIN_M / 1.5**2, depth_max_m=9.0)
    gaussians, cloud = GaussianMap(0.06), wall(1.5)
    ids = spawned(cloud, gaussians, sensor=vague)
    sure = vague.sigma(cloud.points[:, 2]) <= CERTAIN_M
    assert 0 < sure.sum() < len(cloud)
    assert len(ids) == sure.sum()


def test_nothing_spawns_nothing() -> None:
    gaussians, cloud = GaussianMap(0.06), wall()
    assert len(spawned(cloud[np.zeros(len(cloud), np.bool_)], gaussians)) == 0 == len(gaussians)


def depth_image(distance_m: float = 1.5) -> NDArray[np.float32]:
    return np.full((CAMERA.height, CAMERA.width), distance_m, np.float32)


def sampled(depth_m: NDArray[np.float32]) -> FrameCloud:
    return sample_cloud(
        depth_m, CAMERA.undistortion_map, CloudConfig(), SENSOR, STRIDE, 1, np.zeros(6)
    )


def test_what_both_images_measure_is_confirmed() -> None:
    rng, depth_m = np.random.default_rng(2), depth_image()
    noisy = depth_m + rng.normal(scale=SENSOR.sigma(1.5), size=depth_m.shape).astype(np.float32)
    cloud = sampled(depth_m)
    kept = confirmed(cloud, np.eye(4), noisy, CAMERA, SENSOR)
    assert len(kept) > 0.99 * len(cloud)


@pytest.mark.parametrize('flicker_m', [0.1, -0.1, 0.5])
def test_what_flickers_is_dropped(flicker_m: float) -> None:
    """Patches that one of the two images measures elsewhere, or not at all."""
    depth_m, other = depth_image(), depth_image()
    other[100:140, 100:160] += flicker_m
    other[160:200, 30:80] = 0.0
    other[20:50, 200:250] = np.nan
    cloud = sampled(depth_m)
    kept = confirmed(cloud, np.eye(4), other, CAMERA, SENSOR)
    x, y = np.round(CAMERA.project(cloud.points)).astype(int).T
    agrees = other[y, x] == depth_m[y, x]
    assert 0 < (~agrees).sum()
    np.testing.assert_array_equal(kept.points, cloud.points[agrees])
    np.testing.assert_array_equal(kept.normals, cloud.normals[agrees])


def test_confirmation_looks_from_the_other_pose() -> None:
    """A facing wall from 20 cm aside and 10 cm nearer; its rim is out of view there."""
    T_other_cam = np.eye(4)
    T_other_cam[:3, 3] = (0.2, 0.0, -0.1)
    cloud = sampled(depth_image(1.5))
    kept = confirmed(cloud, T_other_cam, depth_image(1.4), CAMERA, SENSOR)
    there = CAMERA.project(cloud.points + np.array([0.2, 0.0, -0.1], np.float32))
    inside = np.all((there > -0.4) & (there < (319.4, 239.4)), axis=1)
    outside = np.any((there < -0.6) | (there > (319.6, 239.6)), axis=1)
    assert outside.sum() > 50
    assert inside.sum() <= len(kept) <= (~outside).sum()
    assert len(confirmed(cloud, np.eye(4), depth_image(1.4), CAMERA, SENSOR)) == 0


@pytest.mark.filterwarnings('error')
def test_what_lies_behind_the_other_camera_is_not_confirmed() -> None:
    T_other_cam = se3.exp(np.array([0, 0, 0, 0, np.pi, 0]))
    assert len(confirmed(sampled(depth_image()), T_other_cam, depth_image(), CAMERA, SENSOR)) == 0
    T_other_cam = se3.exp(np.array([0, 0, 0, 0, np.pi / 2, 0]))
    assert len(confirmed(sampled(depth_image()), T_other_cam, depth_image(), CAMERA, SENSOR)) == 0
