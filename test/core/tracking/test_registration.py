# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Known motions, recovered against maps made by hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.kernels import jit
from dcgs_ros.core.sensor import SensorNoise
from dcgs_ros.core.tracking.cloud import FrameCloud, measurement_covariances
from dcgs_ros.core.tracking.factors import PointFactors, PosePrior, observed_from
from dcgs_ros.core.tracking.gaussian_map import GaussianMap
from dcgs_ros.core.tracking.registration import (
    DepthTerm,
    Registration,
    descend,
    register,
    start_from_landmarks,
)

FOCAL_PX = 525.0
SPACING_M = 0.01
NOISE_FREE_M, NOISE_FREE_RAD = 1e-4, 1e-4
SHARED_M, SHARED_RAD = 1e-3, 1e-3  # the nearest neighbours' places weigh in
SLID_M = 5e-3  # what the places of the samples may move a plane within itself
# 2 cm and 2 degrees off: where the registration starts.
OFF = np.concatenate(
    [0.02 * np.array([0.6, -0.48, 0.64]), np.radians(2) * np.array([0.48, 0.64, -0.6])]
)
T_WORLD_CAM = se3.exp(np.array([0.1, -0.05, 0.08, 0.05, -0.06, 0.04]))
PATIENT = override(
    Config(),
    {
        'registration.max_iterations': 60,
        'registration.tolerance_m': 1e-7,
        'registration.tolerance_rad': 1e-7,
    },
)
RADIUS_M = PATIENT.registration.radius_m
# Origin, two directions, and the normal towards the camera: a room's corner seen from inside.
WALL = ((-0.8, -0.8, 2.0), (1, 0, 0), (0, 1, 0), (0, 0, -1))
SIDE = ((-0.8, -0.8, 0.8), (0, 1, 0), (0, 0, 1), (1, 0, 0))
FLOOR = ((-0.8, 0.8, 0.8), (1, 0, 0), (0, 0, 1), (0, -1, 0))
CORNER = (WALL, SIDE, FLOOR)
Plane = tuple[
    tuple[float, float, float],
    tuple[float, float, float],
    tuple[float, float, float],
    tuple[float, float, float],
]


def on_planes(
    planes: tuple[Plane, ...], shares: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points and normals at the places (N, 2) metres along each plane's directions."""
    points, normals = [], []
    for origin, first, second, normal in planes:
        points.append(np.array(origin) + shares @ np.array([first, second], np.float64))
        normals.append(np.tile(np.array(normal, np.float64), (len(shares), 1)))
    return np.concatenate(points), np.concatenate(normals)


def map_of(planes: tuple[Plane, ...]) -> GaussianMap:
    """Gaussians on a grid, seen from the origin."""
    steps = np.arange(0.0, 1.6, SPACING_M)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    points, normals = on_planes(planes, grid)
    gaussians = GaussianMap(0.06)
    flatness = np.full(len(points), 0.01, np.float32)
    gaussians.add(points.astype(np.float32), normals.astype(np.float32), flatness, np.zeros(3), 0)
    return gaussians


def cloud_of(planes: tuple[Plane, ...], seed: int, count: int = 600) -> FrameCloud:
    """Other points of the same planes, as a camera at T_WORLD_CAM measures them."""
    places = np.random.default_rng(seed).uniform(0.05, 1.55, (count, 2))
    points, normals = on_planes(planes, places)
    flatness = np.full(len(points), 0.01, np.float32)
    world = FrameCloud(
        points.astype(np.float32), normals.astype(np.float32), flatness, len(points)
    )
    return world.moved(se3.inverse(T_WORLD_CAM))


def landmarks_on(planes: tuple[Plane, ...], seed: int, count: int = 30) -> PointFactors:
    """Exact image pairs of points of the planes."""
    world, _ = on_planes(planes, np.random.default_rng(seed).uniform(0.05, 1.55, (count, 2)))
    sensor = SensorNoise.structured_light()
    points = ((world - T_WORLD_CAM[:3, 3]) @ T_WORLD_CAM[:3, :3]).astype(np.float32)
    covariances = measurement_covariances(
        points, np.zeros_like(points), sensor, 1.0 / FOCAL_PX, 0.0
    )
    targets = observed_from(
        world.astype(np.float32), np.zeros(3), sensor, 0.5 / FOCAL_PX,
        np.zeros(len(world), np.int32),
    )  # fmt: skip
    return PointFactors(points, covariances, targets, huber=2.0)


def registered(
    planes: tuple[Plane, ...],
    T_start: NDArray[np.float64],
    image: PointFactors | None = None,
    config: Config = PATIENT,
    search_m: float = RADIUS_M,
) -> Registration:
    term = DepthTerm(cloud_of(planes, seed=1), map_of(planes), FOCAL_PX, config)
    return register(T_start, term, image, config, search_m)


def error(T: NDArray[np.float64]) -> tuple[float, float]:
    """Metres and radians off the truth."""
    xi = se3.log(se3.inverse(T_WORLD_CAM) @ T)
    return float(np.linalg.norm(xi[:3])), float(np.linalg.norm(xi[3:]))


def test_depth_recovers_the_pose_in_a_corner() -> None:
    result = registered(CORNER, T_WORLD_CAM @ se3.exp(OFF))
    metres, radians = error(result.T_world_cam)
    assert metres < NOISE_FREE_M and radians < NOISE_FREE_RAD
    assert result.overlap == result.inliers / 1800 > 0.99
    R = result.T_world_cam[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def test_the_default_patience_arrives_too() -> None:
    """From where the motion model leaves a frame: millimetres and tenths of a degree."""
    start = T_WORLD_CAM @ se3.exp(0.2 * OFF)
    metres, radians = error(registered(CORNER, start, config=Config()).T_world_cam)
    assert metres < 5 * NOISE_FREE_M and radians < 5 * NOISE_FREE_RAD


def test_the_median_is_that_of_the_residuals_that_are_left() -> None:
    found = registered(CORNER, T_WORLD_CAM)
    assert found.median_chi2 == np.nanmedian(found.depth.chi2(found.T_world_cam))


def test_a_wide_first_search_brings_in_what_is_far_off() -> None:
    """Three times as far: 6 cm and 6 degrees; it ends as narrow as any other."""
    start = T_WORLD_CAM @ se3.exp(3 * OFF)
    metres, radians = error(registered(CORNER, start, search_m=4 * RADIUS_M).T_world_cam)
    assert metres < NOISE_FREE_M and radians < NOISE_FREE_RAD


def test_no_pair_is_farther_apart_than_searched() -> None:
    gaussians, cloud = map_of(CORNER), cloud_of(CORNER, seed=7)
    T = T_WORLD_CAM @ se3.exp(3 * OFF)
    world, found = cloud.points @ T[:3, :3].T + T[:3, 3], []
    for search_m in (RADIUS_M, 2 * RADIUS_M, 4 * RADIUS_M):
        pairs = DepthTerm(cloud, gaussians, FOCAL_PX, PATIENT).associate(T, search_m)
        hit = pairs.targets.perp >= 0
        gaps = np.linalg.norm(pairs.targets.points[hit] - world[hit], axis=1)
        assert gaps.max() <= search_m * (1 + 1e-5)
        found.append(hit.sum())
    assert found[0] < found[1] < found[2]


def test_the_truth_is_a_fixed_point() -> None:
    metres, radians = error(registered(CORNER, T_WORLD_CAM).T_world_cam)
    assert metres < NOISE_FREE_M and radians < NOISE_FREE_RAD


@pytest.mark.parametrize('planes', [CORNER, (WALL,)], ids=['corner', 'one plane'])
def test_landmarks_alone_recover_the_pose(planes: tuple[Plane, ...]) -> None:
    image = landmarks_on(planes, seed=2)
    metres, radians = error(descend(T_WORLD_CAM @ se3.exp(OFF), [image], 20))
    assert metres < NOISE_FREE_M and radians < NOISE_FREE_RAD


def test_landmarks_start_the_registration_near_its_end() -> None:
    """A prior as wide as its error hardly holds them back."""
    prior = PosePrior(T_WORLD_CAM @ se3.exp(OFF), 0.02, np.radians(2))
    metres, radians = error(start_from_landmarks(prior, landmarks_on(CORNER, seed=3)))
    assert metres < 1e-3 and radians < 1e-3


def test_few_landmarks_do_not_throw_the_pose_about() -> None:
    """Two landmarks leave a turn about their line free: the prior holds it."""
    prior = PosePrior(T_WORLD_CAM @ se3.exp(OFF), 0.02, np.radians(2))
    metres, radians = error(start_from_landmarks(prior, landmarks_on((WALL,), 4, count=2)))
    assert metres < 0.06 and radians < np.radians(3)


def test_a_plane_leaves_the_motion_within_it_to_the_landmarks() -> None:
    """Depth fixes distance and tilt; shift and turn within the plane only the image sees."""
    shift = T_WORLD_CAM[:3, :3].T @ np.array([0.015, 0.01, 0.0])
    start = T_WORLD_CAM @ se3.exp(np.array([*shift, 0, 0, 0]))
    alone = registered((WALL,), start).T_world_cam
    slid = T_WORLD_CAM[:3, 3] - alone[:3, 3]
    assert abs(slid[2]) < 5 * NOISE_FREE_M
    assert np.linalg.norm((alone - start)[:2, 3]) < SLID_M < np.linalg.norm(slid[:2])
    image = landmarks_on((WALL,), seed=5)
    metres, radians = error(registered((WALL,), start, image).T_world_cam)
    assert metres < 10 * NOISE_FREE_M and radians < 10 * NOISE_FREE_RAD


def test_the_weak_direction_shows_without_the_radius() -> None:
    """On one plane the radius alone carries shift in it; in a corner there is none."""
    for planes, flat in (((WALL,), True), (CORNER, False)):
        sharp = registered(planes, T_WORLD_CAM).sharp_depth.H
        eigenvalues = np.linalg.eigvalsh(sharp[:3, :3])
        assert (eigenvalues[0] < 1e-3 * eigenvalues[2]) == flat


def test_a_turned_world_gives_a_turned_pose() -> None:
    """Left invariance: map and start moved by T, the result moves by T."""
    T = se3.exp(np.array([1.0, -2.0, 0.5, 0.4, -0.3, 0.8]))
    here, there = map_of(CORNER), GaussianMap(0.06)
    there.add(
        (here.means @ T[:3, :3].T + T[:3, 3]).astype(np.float32),
        (here.normals @ T[:3, :3].T).astype(np.float32),
        here.flatness, T[:3, 3], 0,
    )  # fmt: skip
    cloud, start = cloud_of(CORNER, seed=1), T_WORLD_CAM @ se3.exp(0.3 * OFF)
    one = register(start, DepthTerm(cloud, here, FOCAL_PX, PATIENT), None, PATIENT, RADIUS_M)
    other = register(
        T @ start, DepthTerm(cloud, there, FOCAL_PX, PATIENT), None, PATIENT, RADIUS_M
    )
    np.testing.assert_allclose(other.T_world_cam, T @ one.T_world_cam, atol=NOISE_FREE_M)


def test_the_shared_covariance_recovers_the_pose_in_a_corner() -> None:
    config = override(PATIENT, {'ablation': 'shared'})
    metres, radians = error(
        registered(CORNER, T_WORLD_CAM @ se3.exp(OFF), None, config).T_world_cam
    )
    assert metres < SHARED_M and radians < SHARED_RAD


def test_surfaces_seen_from_behind_are_not_paired() -> None:
    """A map whose normals look the other way explains nothing."""
    planes = tuple((*plane[:3], tuple(-x for x in plane[3])) for plane in CORNER)
    term = DepthTerm(cloud_of(CORNER, seed=1), map_of(planes), FOCAL_PX, PATIENT)  # type: ignore[arg-type]
    pairs = term.associate(T_WORLD_CAM, RADIUS_M)
    assert not (pairs.targets.perp >= 0).any()


@pytest.mark.slow
def test_pairs_are_the_nearest_gaussians_with_their_covariance() -> None:
    gaussians, cloud = map_of(CORNER), cloud_of(CORNER, seed=6)
    pairs = DepthTerm(cloud, gaussians, FOCAL_PX, PATIENT).associate(T_WORLD_CAM, RADIUS_M)
    world = cloud.points @ T_WORLD_CAM[:3, :3].T + T_WORLD_CAM[:3, 3]
    hit = np.flatnonzero(pairs.targets.perp >= 0)[::10]
    distances = np.linalg.norm(gaussians.means[None] - world[hit, None], axis=2)
    reached = np.linalg.norm(pairs.targets.points[hit] - world[hit], axis=1)
    np.testing.assert_allclose(reached, distances.min(axis=1), atol=1e-6)
    slots = distances.argmin(axis=1).astype(np.int32)
    t = pairs.targets[hit]
    along = (t.along - t.perp)[:, None, None] * (t.axes[:, :, None] * t.axes[:, None, :])
    anchor_px = PATIENT.registration.anchor_px
    expected = gaussians.tracking_covariances(slots, PATIENT.sensor, anchor_px, FOCAL_PX)
    np.testing.assert_allclose(
        t.perp[:, None, None] * np.eye(3) + along, expected, atol=1e-4 * expected.max()
    )


def test_no_map_and_no_cloud_leave_the_start() -> None:
    empty = cloud_of(CORNER, seed=1)[np.zeros(1800, np.bool_)]
    for cloud, gaussians in (
        (cloud_of(CORNER, seed=1), GaussianMap(0.06)),
        (empty, map_of(CORNER)),
    ):
        term = DepthTerm(cloud, gaussians, FOCAL_PX, Config())
        result = register(T_WORLD_CAM, term, None, Config(), RADIUS_M)
        assert result.inliers == 0 == result.overlap
        np.testing.assert_allclose(result.T_world_cam, T_WORLD_CAM, atol=1e-12)


def test_threads_do_not_change_a_bit() -> None:
    poses = []
    for threads in (1, None):
        jit.set_threads(threads)
        poses.append(registered(CORNER, T_WORLD_CAM @ se3.exp(OFF)).T_world_cam)
    np.testing.assert_array_equal(poses[0], poses[1])
