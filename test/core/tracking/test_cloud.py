# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Points, normals and covariances of depth images of planes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.stages import CloudConfig
from dcgs_ros.core.kernels import jit
from dcgs_ros.core.sensor import SensorNoise
from dcgs_ros.core.tracking.cloud import FrameCloud, measurement_covariances, sample_cloud

NORMAL_RAD = 2e-3  # of a noise-free plane: what float32 leaves
ON_PLANE_M = 1e-6
COVARIANCE = 1e-5  # relative, float32
STRIDE = 8
SENSOR = SensorNoise.structured_light()
STILL = np.zeros(6)
PINHOLE = PinholeCamera(320, 240, 262.0, 262.0, 159.5, 119.5)
DISTORTED = PinholeCamera(
    320, 240, 258.6, 258.2, 159.3, 127.6, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
)
TILTS = {
    'facing': (0.0, 0.0, -1.0),
    'slanted': (0.5, 0.2, -1.0),
    'steep': (-1.2, 0.3, -1.0),
    'floor': (0.1, -1.0, -0.8),
}


@pytest.fixture(params=TILTS.values(), ids=list(TILTS))
def normal(request: pytest.FixtureRequest) -> NDArray[np.float64]:
    """Unit normal of a plane, towards the camera."""
    n = np.array(request.param)
    unit: NDArray[np.float64] = n / np.linalg.norm(n)
    return unit


@pytest.fixture
def restored_threads() -> Iterator[None]:
    """Leave as many threads as there were."""
    yield
    jit.set_threads(None)


def plane_depth(
    camera: PinholeCamera, normal: NDArray[np.floating], distance_m: float
) -> NDArray[np.float32]:
    """Depth image of the plane n . p = -distance; 0 where it is not in front of the camera."""
    rays = camera.undistortion_map.astype(np.float64)
    facing = rays @ normal[:2] + normal[2]
    with np.errstate(divide='ignore'):
        z = -distance_m / facing
    return np.where((facing < 0) & (z < 20), z, 0.0).astype(np.float32)


def sampled(
    depth_m: NDArray[np.floating],
    camera: PinholeCamera = PINHOLE,
    seed: int = 1,
    stride: int = STRIDE,
) -> FrameCloud:
    return sample_cloud(
        depth_m, camera.undistortion_map, CloudConfig(), SENSOR, stride, seed, STILL
    )


def pixels_of(cloud: FrameCloud, camera: PinholeCamera = PINHOLE) -> NDArray[np.int64]:
    """(N, 2) columns and rows the points were taken from."""
    return np.round(camera.project(cloud.points)).astype(np.int64)


@pytest.mark.parametrize('camera', [PINHOLE, DISTORTED], ids=['pinhole', 'distorted'])
def test_a_plane_has_its_normal_everywhere(
    normal: NDArray[np.float64], camera: PinholeCamera
) -> None:
    """Also through a lens: rays are undistorted, images are not."""
    cloud = sampled(plane_depth(camera, normal, 1.0), camera)
    assert len(cloud) > 100
    np.testing.assert_allclose(cloud.points @ normal, -1.0, atol=ON_PLANE_M * 5)
    assert np.linalg.norm(np.cross(cloud.normals, normal), axis=1).max() < NORMAL_RAD
    assert (cloud.flatness < 1e-3).all() and (cloud.flatness >= 0).all()


def test_normals_are_unit_and_face_the_camera(normal: NDArray[np.float64]) -> None:
    cloud = sampled(plane_depth(PINHOLE, normal, 1.0))
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1.0, atol=1e-5)
    assert (np.sum(cloud.normals * cloud.points, axis=1) < 0).all()


def test_points_are_pixels_of_the_image_one_a_cell() -> None:
    rng = np.random.default_rng(2)
    depth_m = rng.uniform(1.0, 1.005, (240, 320)).astype(np.float32)
    cloud = sampled(depth_m)
    x, y = pixels_of(cloud).T
    np.testing.assert_array_equal(cloud.points[:, 2], depth_m[y, x])
    cells = np.stack([x // STRIDE, y // STRIDE], axis=1)
    assert len(np.unique(cells, axis=0)) == len(cells)
    assert cloud.samples == (240 // STRIDE) * (320 // STRIDE)
    assert len(cloud) > 0.99 * cloud.samples  # the image's corners have few neighbours


def test_seed_moves_the_samples_within_their_cells() -> None:
    depth_m = plane_depth(PINHOLE, np.array([0.0, 0.0, -1.0]), 1.0)
    one, other = ({(x, y) for x, y in pixels_of(sampled(depth_m, seed=k))} for k in (1, 2))
    cells = [{(x // STRIDE, y // STRIDE) for x, y in pixels} for pixels in (one, other)]
    assert len(cells[0] & cells[1]) > 0.99 * len(one)
    assert len(one & other) < 0.2 * len(one)


def test_same_seed_same_bytes_whatever_the_threads(restored_threads: None) -> None:
    rng = np.random.default_rng(3)
    depth_m = plane_depth(PINHOLE, np.array([0.3, 0.1, -0.9]), 1.2)
    depth_m *= rng.uniform(0.998, 1.002, depth_m.shape).astype(np.float32)
    clouds = []
    for threads in (1, 2, 2):
        jit.set_threads(threads)
        clouds.append(sampled(depth_m))
    for other in clouds[1:]:
        for name in ('points', 'normals', 'flatness'):
            assert getattr(clouds[0], name).tobytes() == getattr(other, name).tobytes()


def test_no_normal_mixes_the_two_sides_of_an_edge() -> None:
    """A step between two walls that face the camera: all normals are the walls'."""
    depth_m = np.full((240, 320), 1.0, np.float32)
    depth_m[:, 163:] = 1.6
    cloud = sampled(depth_m)
    np.testing.assert_allclose(cloud.normals, [[0, 0, -1]] * len(cloud), atol=NORMAL_RAD)
    assert set(np.unique(cloud.points[:, 2])) == {np.float32(1.0), np.float32(1.6)}


def test_what_is_narrower_than_the_window_gives_no_point() -> None:
    """A rod before a wall, and single flying pixels: too few neighbours on the same surface."""
    depth_m = np.full((240, 320), 2.0, np.float32)
    depth_m[:, 160:163] = 1.0
    depth_m[7::20, 9::20] = 1.5
    cloud = sampled(depth_m)
    assert len(cloud) > 500
    np.testing.assert_array_equal(cloud.points[:, 2], 2.0)
    assert cloud.samples == (240 // STRIDE) * (320 // STRIDE)


def test_grazing_surfaces_are_left_out() -> None:
    """A floor is seen the flatter the farther it is: what is flatter than asked is gone."""
    floor = np.array([0.0, -1.0, 0.0])
    depth_m = plane_depth(PINHOLE, floor, 0.4)
    rays, seen = PINHOLE.undistortion_map, {}
    for cosine in (0.2, 0.3, 0.6):
        config = CloudConfig(min_view_cosine=cosine)
        cloud = sample_cloud(depth_m, rays, config, SENSOR, STRIDE, 1, STILL)
        views = cloud.points / np.linalg.norm(cloud.points, axis=1, keepdims=True)
        assert (-views @ floor >= cosine - NORMAL_RAD).all()
        seen[cosine] = len(cloud)
        assert cloud.samples > seen[cosine]
    assert seen[0.2] > seen[0.3] > 0 == seen[0.6]  # 0.42 is the image's lower edge


@pytest.mark.parametrize('distance_m', [0.5 * SENSOR.depth_min_m, 1.01 * SENSOR.depth_max_m])
def test_out_of_range_is_no_measurement(distance_m: float) -> None:
    cloud = sampled(np.full((240, 320), distance_m, np.float32))
    assert len(cloud) == cloud.samples == 0


@pytest.mark.parametrize('junk', [np.nan, np.inf, -np.inf, 0.0, -1.0])
def test_junk_in_depth_never_yields_a_point(junk: float) -> None:
    rng = np.random.default_rng(5)
    depth_m = plane_depth(PINHOLE, np.array([0.3, 0.0, -1.0]), 1.0)
    bad = rng.random(depth_m.shape) < 0.1
    depth_m[bad] = junk
    cloud = sampled(depth_m)
    x, y = pixels_of(cloud).T
    assert len(cloud) > 500
    assert not bad[y, x].any()
    assert np.isfinite(cloud.points).all() and np.isfinite(cloud.normals).all()
    everywhere = sampled(np.full((240, 320), junk, np.float32))
    assert len(everywhere) == everywhere.samples == 0


def test_a_rolling_shutter_is_undone() -> None:
    """A plane seen row by row by a moving camera is that of the middle row's instant again."""
    normal, distance_m = np.array([0.3, 0.1, -0.9]) / np.sqrt(0.91), 1.2
    twist = np.array([0.3, -0.4, 0.2, 0.5, -0.3, 0.6])
    sensor = replace(SENSOR, depth_readout_ms=30.0)
    rays = PINHOLE.undistortion_map
    rolled = np.empty(rays.shape[:2], np.float32)
    for row in range(len(rolled)):
        late_s = ((row + 0.5) / len(rolled) - 0.5) * 0.03
        T = se3.exp(late_s * twist)
        then = -(distance_m + normal @ T[:3, 3])  # n . T p = -distance
        facing = normal @ T[:3, :3]
        rolled[row] = then / (rays[row] @ facing[:2] + facing[2])
    errors = {}
    for motion in (twist, STILL):
        cloud = sample_cloud(rolled, rays, CloudConfig(), sensor, STRIDE, 1, motion)
        off_m = np.abs(cloud.points @ normal + distance_m).max()
        tilt = np.abs(cloud.normals @ normal - 1).max()
        errors[motion is twist] = off_m, tilt
    assert errors[True][0] < 1e-4 and errors[False][0] > 5e-3  # second order in 30 ms remains
    assert errors[True][1] < 1e-6 < 2e-5 < errors[False][1]


def test_moved_is_the_rigid_motion() -> None:
    cloud = sampled(plane_depth(PINHOLE, np.array([0.3, 0.1, -0.9]), 1.2))
    T = se3.exp(np.random.default_rng(6).normal(size=6))
    moved = cloud.moved(T)
    np.testing.assert_allclose(
        moved.points, cloud.points @ T[:3, :3].T + T[:3, 3], atol=ON_PLANE_M * 5
    )
    np.testing.assert_allclose(moved.normals, cloud.normals @ T[:3, :3].T, atol=1e-6)
    np.testing.assert_array_equal(moved.flatness, cloud.flatness)
    assert moved.samples == cloud.samples and moved.points.dtype == np.float32
    back = moved.moved(se3.inverse(T))
    np.testing.assert_allclose(back.points, cloud.points, atol=ON_PLANE_M * 5)


def test_selection_keeps_rows_together() -> None:
    cloud = sampled(plane_depth(PINHOLE, np.array([0.3, 0.1, -0.9]), 1.2))
    keep = np.arange(len(cloud)) % 3 == 0
    subset = cloud[keep]
    assert len(subset) == keep.sum() and subset.samples == cloud.samples
    np.testing.assert_array_equal(subset.points, cloud.points[keep])
    np.testing.assert_array_equal(subset.normals, cloud.normals[keep])
    np.testing.assert_array_equal(subset.flatness, cloud.flatness[keep])


@pytest.mark.parametrize('sensor', [SENSOR, SensorNoise.stereo(385.0, 0.05), SensorNoise.floor()])
@pytest.mark.parametrize('radius_m', [0.0, 0.03])
def test_covariance_is_sensor_plus_ambiguity_in_the_tangent_plane(
    sensor: SensorNoise, radius_m: float
) -> None:
    """D_i = S(v_i, |a_i|; p_d) + r^2 (I - n_i n_i^T)."""
    rng = np.random.default_rng(7)
    points = rng.uniform((-1, -1, 0.5), (1, 1, 4), (50, 3)).astype(np.float32)
    normals = rng.normal(size=(50, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    footprint_px, focal_px = 1.5, 525.0
    ranges = np.linalg.norm(points.astype(np.float64), axis=1)
    S = sensor.covariance(points / ranges[:, None], ranges, footprint_px, focal_px)
    ambiguity = np.eye(3) - normals[:, :, None] * normals[:, None, :].astype(np.float64)
    expected = S + radius_m**2 * ambiguity
    found = measurement_covariances(points, normals, sensor, footprint_px / focal_px, radius_m)
    rows, columns = np.triu_indices(3)
    error = np.abs(found - expected[:, rows, columns]).max(axis=1)
    assert (error <= COVARIANCE * np.abs(expected).max(axis=(1, 2))).all()
