# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Landmarks: where they are anchored, what is measured of them, and how they are followed."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.stages import LandmarkConfig
from dcgs_ros.core.sensor import SensorNoise
from dcgs_ros.core.tracking.factors import PointFactors, Targets, observed_from
from dcgs_ros.core.tracking.gaussian_map import GaussianMap
from dcgs_ros.core.tracking.landmarks import Landmarks, detect
from dcgs_ros.core.tracking.patches import cut

ON_PLANE_M = 2e-6  # float32 at a few metres
BACK_PROJECTED_M = 2e-6
LOOKED_UP_M = 1e-3  # depth of the nearest pixel, on a slope, half a pixel off
TRACKED_PX = 0.1  # what KLT leaves on a clean image
SENSOR = SensorNoise.structured_light()
CONFIG = LandmarkConfig()
ANCHOR_PX = 0.5
PINHOLE = PinholeCamera(320, 240, 262.0, 262.0, 159.5, 119.5)
DISTORTED = PinholeCamera(
    320, 240, 258.6, 258.2, 159.3, 127.6, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
)
T_WORLD_CAM = se3.exp(np.array([0.4, -0.3, 0.2, 0.3, -0.8, 0.5]))
STILL = np.eye(4)
AT_REST = np.zeros(6)
KEYFRAME = 5
SECOND_ORDER_PX = 0.1  # of the motion within a readout


def image_of_blocks(seed: int, size: tuple[int, int] = (240, 320)) -> NDArray[np.uint8]:
    """Random grey blocks, slightly blurred: corners everywhere."""
    blocks = np.random.default_rng(seed).integers(20, 230, (size[0] // 16, size[1] // 16))
    image = np.kron(blocks, np.ones((16, 16))).astype(np.uint8)
    return cv2.GaussianBlur(image, (5, 5), 1.0)  # type: ignore[no-any-return]


def plane_depth(
    camera: PinholeCamera, normal: NDArray[np.floating], distance_m: float
) -> NDArray[np.float32]:
    """Depth image of the plane n . p = -distance."""
    rays = camera.undistortion_map.astype(np.float64)
    depth: NDArray[np.float32] = (-distance_m / (rays @ normal[:2] + normal[2])).astype(np.float32)
    return depth


def lifted(
    camera: PinholeCamera, pixels: NDArray[np.floating], z: NDArray[np.floating]
) -> NDArray[np.float64]:
    rays = camera.undistort(pixels).astype(np.float64)
    return np.column_stack([rays, np.ones(len(rays))]) * np.asarray(z)[:, None]


def to_world(
    points: NDArray[np.floating], T_world_cam: NDArray[np.float64]
) -> NDArray[np.float64]:
    moved: NDArray[np.float64] = points @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
    return moved


def landmarks_at(
    pixels: NDArray[np.floating],
    world: NDArray[np.floating],
    image: NDArray[np.uint8] | None = None,
) -> Landmarks:
    """Landmarks on surfaces that face the camera, whose pose is the identity."""
    n = len(pixels)
    image = np.zeros((240, 320), np.uint8) if image is None else image
    at = np.asarray(pixels, np.float32)
    points = lifted(PINHOLE, at, np.full(n, 1.5))
    facing = np.tile([0.0, 0.0, -1.0], (n, 1))
    variance = np.full(n, 1e-6, np.float32)
    axes = np.tile(np.array([0, 0, 1], np.float32), (n, 1))
    hosts = np.zeros(len(at), np.int32)
    return Landmarks(
        at,
        Targets(np.asarray(world, np.float32), axes, variance, variance, hosts),
        cut(image, at, points[:, 2], facing, STILL, PINHOLE),
        np.arange(n),
    )


def measured(
    landmarks: Landmarks,
    depth_m: NDArray[np.float32],
    camera: PinholeCamera = PINHOLE,
    T_cam_cam_at_depth: NDArray[np.float64] = STILL,
    T_world_cam: NDArray[np.float64] = STILL,
    weight: float = 1.0,
    twist: NDArray[np.float64] = AT_REST,
    sensor: SensorNoise = SENSOR,
) -> PointFactors:
    return landmarks.measured(
        depth_m, T_world_cam, T_cam_cam_at_depth, twist, camera, sensor, CONFIG, weight
    )


def detected(
    grey: NDArray[np.uint8],
    depth_m: NDArray[np.float32],
    gaussians: GaussianMap,
    camera: PinholeCamera = PINHOLE,
    alive: Landmarks | None = None,
    config: LandmarkConfig = CONFIG,
    sensor: SensorNoise = SENSOR,
) -> Landmarks:
    alive = Landmarks.none() if alive is None else alive
    return detect(
        grey, depth_m, alive, T_WORLD_CAM, STILL, AT_REST, gaussians, camera, sensor, config,
        ANCHOR_PX, KEYFRAME,
    )  # fmt: skip


def map_about(camera: PinholeCamera, depth_m: NDArray[np.floating], seed: int) -> GaussianMap:
    """Gaussians within a centimetre of the measured surface, with normals of their own."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0 : camera.height : 2, 0 : camera.width : 2]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    points = lifted(camera, pixels, depth_m[v.ravel(), u.ravel()])
    world = to_world(points, T_WORLD_CAM) + rng.uniform(-0.005, 0.005, (len(points), 3))
    normals = rng.normal(size=(len(points), 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    gaussians = GaussianMap(0.06)
    gaussians.add(
        world.astype(np.float32), normals.astype(np.float32), np.zeros(len(points), np.float32),
        T_WORLD_CAM[:3, 3], 0,
    )  # fmt: skip
    return gaussians


@pytest.mark.parametrize('camera', [PINHOLE, DISTORTED], ids=['pinhole', 'distorted'])
def test_a_landmark_lies_on_the_tangent_plane_of_the_nearest_gaussian(
    camera: PinholeCamera,
) -> None:
    """l = x + n_j n_j^T (mu_j - x): n . l = n . mu, and along the plane l = x."""
    depth_m = plane_depth(camera, np.array([0.0, 0.0, -1.0]), 1.2)
    gaussians = map_about(camera, depth_m, seed=1)
    found = detected(image_of_blocks(seed=2), depth_m, gaussians, camera)
    assert len(found) > 50
    x = to_world(lifted(camera, found.pixels, np.full(len(found), 1.2)), T_WORLD_CAM)
    distances = np.linalg.norm(gaussians.means[None] - x[:, None], axis=2)
    j = distances.argmin(axis=1)
    n, mu = gaussians.normals[j].astype(np.float64), gaussians.means[j].astype(np.float64)
    height = np.sum(n * (found.targets.points - mu), axis=1)
    np.testing.assert_allclose(height, 0.0, atol=ON_PLANE_M)
    moved = found.targets.points - x
    along_plane = moved - n * np.sum(n * moved, axis=1, keepdims=True)
    np.testing.assert_allclose(along_plane, 0.0, atol=ON_PLANE_M)
    assert np.abs(moved).max() > 1e-3  # the map's coordinate, not the measured one


def test_a_landmark_inherits_the_covariance_of_its_gaussian() -> None:
    depth_m = plane_depth(PINHOLE, np.array([0.0, 0.0, -1.0]), 1.2)
    gaussians = map_about(PINHOLE, depth_m, seed=3)
    found = detected(image_of_blocks(seed=4), depth_m, gaussians)
    x = to_world(lifted(PINHOLE, found.pixels, np.full(len(found), 1.2)), T_WORLD_CAM)
    slots = gaussians.index.nearest(gaussians.means, x.astype(np.float32), 0.03)
    t = found.targets
    along = (t.along - t.perp)[:, None, None] * (t.axes[:, :, None] * t.axes[:, None, :])
    expected = gaussians.tracking_covariances(slots, SENSOR, ANCHOR_PX, PINHOLE.focal)
    np.testing.assert_array_equal(t.hosts, gaussians.hosts[slots])
    np.testing.assert_allclose(
        t.perp[:, None, None] * np.eye(3) + along, expected, atol=1e-4 * expected.max()
    )


def test_far_from_any_gaussian_a_landmark_is_where_it_was_measured() -> None:
    """With Sigma_t of this view: a turn outruns the keyframes, not the landmarks."""
    depth_m = plane_depth(PINHOLE, np.array([0.0, 0.0, -1.0]), 1.2)
    grey = image_of_blocks(seed=5)
    beyond = CONFIG.anchor_radius_m + 0.02
    far = map_about(PINHOLE, (depth_m - beyond).astype(np.float32), seed=6)
    for gaussians in (GaussianMap(0.06), far):
        found = detected(grey, depth_m, gaussians)
        x = to_world(lifted(PINHOLE, found.pixels, np.full(len(found), 1.2)), T_WORLD_CAM)
        assert len(found) > 50
        np.testing.assert_allclose(found.targets.points, x, atol=ON_PLANE_M)
        assert (found.targets.hosts == KEYFRAME).all()
        viewpoint, px = T_WORLD_CAM[:3, 3], ANCHOR_PX / 262.0
        own = observed_from(x.astype(np.float32), viewpoint, SENSOR, px, found.targets.hosts)
        np.testing.assert_allclose(found.targets.covariances, own.covariances, rtol=1e-3)


def test_a_smooth_bias_of_depth_leaves_the_range_open() -> None:
    """By its share of the range from where the anchor was seen; across the ray nothing changes."""
    depth_m = plane_depth(PINHOLE, np.array([0.0, 0.0, -1.0]), 1.2)
    gaussians, grey = map_about(PINHOLE, depth_m, seed=8), image_of_blocks(seed=9)
    biased = replace(SENSOR, depth_bias=0.02)
    without = detected(grey, depth_m, gaussians).targets
    found = detected(grey, depth_m, gaussians, sensor=biased).targets
    ranges = np.sqrt(without.perp) * PINHOLE.focal / ANCHOR_PX
    expected = without.along + (0.02 * ranges) ** 2
    np.testing.assert_allclose(found.along, expected, rtol=1e-5)
    np.testing.assert_array_equal(found.perp, without.perp)
    np.testing.assert_array_equal(found.points, without.points)


def test_a_rolling_shutter_is_undone() -> None:
    """Each row sees the points from where the camera is then; all are wanted where it is."""
    rng = np.random.default_rng(41)
    readout_s, z = 0.03, 1.5
    twist = np.array([0.3, -0.2, 0.4, 0.8, -1.2, 0.6])
    pixels = rng.uniform((60, 40), (260, 200), (60, 2))
    points = lifted(PINHOLE, pixels, np.full(60, z))
    seen = pixels.copy()
    for _ in range(6):
        late_s = readout_s * ((seen[:, 1] + 0.5) / PINHOLE.height - 0.5)
        seen = np.array(
            [
                PINHOLE.project(se3.transform(se3.exp(-dt * twist), p[None]))[0]
                for dt, p in zip(late_s, points, strict=True)
            ]
        )
    depth_m = np.full((240, 320), z, np.float32)
    rolling = replace(SENSOR, color_readout_ms=1e3 * readout_s)
    there = landmarks_at(seen, points)
    off = [
        np.abs(PINHOLE.project(measured(there, depth_m, twist=twist, sensor=s).points) - pixels)
        for s in (rolling, SENSOR)
    ]
    assert off[0].max() < SECOND_ORDER_PX
    assert off[1].max() > 20 * SECOND_ORDER_PX


def test_corners_keep_their_distance_and_their_number() -> None:
    depth_m = plane_depth(PINHOLE, np.array([0.0, 0.0, -1.0]), 1.2)
    gaussians, grey = map_about(PINHOLE, depth_m, seed=7), image_of_blocks(seed=8)
    config = replace(CONFIG, corners=60)
    first = detected(grey, depth_m, gaussians, config=config)
    assert 40 < len(first) <= 60
    half = first[np.arange(len(first)) % 2 == 0]
    both = half.joined(detected(grey, depth_m, gaussians, alive=half, config=config))
    assert len(half) < len(both) <= 60
    gaps = np.linalg.norm(both.pixels[:, None] - both.pixels[None], axis=2)
    gaps[np.diag_indices(len(both))] = np.inf
    assert gaps.min() >= config.min_distance_px - 2  # found at half resolution
    enough = replace(config, corners=len(first))
    assert len(detected(grey, depth_m, gaussians, alive=first, config=enough)) == 0


def test_a_blank_image_has_no_corners() -> None:
    depth_m = plane_depth(PINHOLE, np.array([0.0, 0.0, -1.0]), 1.2)
    gaussians = map_about(PINHOLE, depth_m, seed=9)
    assert len(detected(np.full((240, 320), 90, np.uint8), depth_m, gaussians)) == 0
    noise = np.random.default_rng(10).normal(90, 1.0, (240, 320)).round().astype(np.uint8)
    assert len(detected(noise, depth_m, gaussians)) == 0


@pytest.mark.parametrize('camera', [PINHOLE, DISTORTED], ids=['pinhole', 'distorted'])
def test_a_measurement_is_the_pixel_at_the_measured_depth(camera: PinholeCamera) -> None:
    depth_m = np.full((240, 320), 1.7, np.float32)
    pixels = np.random.default_rng(11).uniform((5, 5), (314, 234), (80, 2)).astype(np.float32)
    expected = lifted(camera, pixels, np.full(80, 1.7))
    landmarks = landmarks_at(pixels, expected + 0.01)
    pairs = measured(landmarks, depth_m, camera)
    np.testing.assert_allclose(pairs.points, expected, atol=BACK_PROJECTED_M)
    np.testing.assert_array_equal(pairs.targets.points, landmarks.targets.points)


def test_the_covariance_is_that_of_a_match() -> None:
    """S_l = S(v, z; sigma_m): no association term, for the track fixes the correspondence."""
    depth_m = np.full((240, 320), 1.7, np.float32)
    pixels = np.random.default_rng(12).uniform((5, 5), (314, 234), (30, 2))
    pairs = measured(landmarks_at(pixels, lifted(PINHOLE, pixels, np.full(30, 1.7))), depth_m)
    ranges = np.linalg.norm(pairs.points.astype(np.float64), axis=1)
    S = SENSOR.covariance(pairs.points / ranges[:, None], ranges, CONFIG.sigma_px, PINHOLE.focal)
    rows, columns = np.triu_indices(3)
    np.testing.assert_allclose(pairs.covariances, S[:, rows, columns], atol=1e-5 * S.max())
    assert pairs.huber == CONFIG.huber


def is_bearing(pairs: PointFactors) -> NDArray[np.bool_]:
    """Which measurements say nothing along the ray: a metre of standard deviation."""
    rays = pairs.points / np.linalg.norm(pairs.points, axis=1, keepdims=True)
    xx, xy, xz, yy, yz, zz = pairs.covariances.astype(np.float64).T
    x, y, z = rays.T
    along = xx * x * x + yy * y * y + zz * z * z + 2 * (xy * x * y + xz * x * z + yz * y * z)
    bearing: NDArray[np.bool_] = along > 0.5
    return bearing


@pytest.mark.parametrize('hole', [0.0, np.nan, np.inf, -1.0])
def test_without_depth_a_corner_counts_across_its_ray(hole: float) -> None:
    depth_m = np.full((240, 320), 1.7, np.float32)
    depth_m[90:110, 90:110] = hole
    pixels = np.array([[100, 100], [200, 100], [0.2, 100], [100, 239.4], [-5, 50], [400, 50]])
    expected = lifted(PINHOLE, pixels, np.full(6, 1.7))
    pairs = measured(landmarks_at(pixels, expected), depth_m)
    assert is_bearing(pairs).tolist() == [True, False, True, True, True, True]
    np.testing.assert_allclose(pairs.points, expected, atol=BACK_PROJECTED_M)


@pytest.mark.parametrize('distance_m', [0.5 * SENSOR.depth_min_m, 1.1 * SENSOR.depth_max_m])
def test_out_of_range_there_is_no_depth(distance_m: float) -> None:
    pixels = np.array([[100.0, 100.0]])
    depth_m = np.full((240, 320), distance_m, np.float32)
    there = lifted(PINHOLE, pixels, np.array([distance_m]))
    assert is_bearing(measured(landmarks_at(pixels, there), depth_m)).all()


def test_a_depth_that_contradicts_the_landmark_is_not_used() -> None:
    """Something stands before it: what is seen there is a corner of its edge."""
    pixels = np.array([[100.0, 100.0], [200.0, 100.0]])
    depth_m = np.full((240, 320), 1.7, np.float32)
    depth_m[:, 150:] = 1.2
    expected = lifted(PINHOLE, pixels, np.full(2, 1.7))
    pairs = measured(landmarks_at(pixels, expected), depth_m)
    assert is_bearing(pairs).tolist() == [False, True]
    np.testing.assert_allclose(pairs.points, expected, atol=BACK_PROJECTED_M)


def test_a_corner_at_an_edge_of_depth_has_none() -> None:
    """Its depth is either surface's."""
    depth_m = np.full((240, 320), 1.0, np.float32)
    depth_m[:, 160:] = 1.3
    columns = np.arange(150.0, 171.0)
    pixels = np.stack([columns, np.full(21, 100.0)], axis=1)
    z = np.where(columns < 160, 1.0, 1.3)
    pairs = measured(landmarks_at(pixels, lifted(PINHOLE, pixels, z)), depth_m)
    np.testing.assert_array_equal(is_bearing(pairs), (columns == 159) | (columns == 160))


@pytest.mark.parametrize('camera', [PINHOLE, DISTORTED], ids=['pinhole', 'distorted'])
@pytest.mark.parametrize(
    ('twist', 'tolerance_m'),
    [
        ((0, 0, 0.04, 0, 0, 0), LOOKED_UP_M),
        ((0.03, -0.02, 0, 0, 0, 0), LOOKED_UP_M),
        ((0, 0, 0, 0.03, -0.05, 0.02), LOOKED_UP_M),
        ((0.03, -0.02, 0.02, 0.03, -0.02, 0.05), LOOKED_UP_M),
    ],
)
def test_depth_of_another_instant_is_brought_to_the_colors(
    camera: PinholeCamera, twist: tuple[float, ...], tolerance_m: float
) -> None:
    """A slanted plane, its depth seen from another pose: the points are where colour sees them."""
    T_cam_cam_at_depth = se3.exp(np.array(twist, np.float64))
    normal = np.array([0.3, 0.2, -1.0])
    normal /= np.linalg.norm(normal)
    distance_m = 1.3
    # n . p = -d in the colour's frame; in the depth's: n' = R^T n, d' = d + n . t.
    R, t = T_cam_cam_at_depth[:3, :3], T_cam_cam_at_depth[:3, 3]
    depth_m = plane_depth(camera, R.T @ normal, float(distance_m + normal @ t))
    pixels = np.random.default_rng(13).uniform((40, 40), (280, 200), (60, 2))
    rays = lifted(camera, pixels, np.ones(60))
    true = rays * (-distance_m / (rays @ normal))[:, None]
    pairs = measured(
        landmarks_at(pixels, to_world(true, T_WORLD_CAM)), depth_m, camera, T_cam_cam_at_depth,
        T_WORLD_CAM,
    )  # fmt: skip
    assert len(pairs.points) == 60
    assert np.linalg.norm(pairs.points - true, axis=1).max() < 2 * tolerance_m
    assert np.abs(pairs.points - true).mean() < 0.3 * tolerance_m


def test_corners_follow_a_known_flow() -> None:
    """A wall seen from two places: an image shifted by whole pixels."""
    wide = image_of_blocks(seed=14, size=(256, 352))
    previous, grey = wide[8:248, 16:336].copy(), wide[5:245, 22:342].copy()
    z, shift = 1.5, np.array([-6.0, 3.0])
    T_moved = np.eye(4)
    T_moved[:2, 3] = -shift * z / PINHOLE.fx
    depth_m = np.full((240, 320), z, np.float32)
    gaussians = GaussianMap(0.06)
    v, u = (g.ravel() for g in np.mgrid[0:240:4, 0:320:4])
    world = lifted(PINHOLE, np.stack([u, v], axis=1), depth_m[v, u]).astype(np.float32)
    normals = np.tile(np.array([0, 0, -1], np.float32), (len(world), 1))
    gaussians.add(world, normals, np.zeros(len(world), np.float32), np.zeros(3), 0)
    corners = detect(
        previous, depth_m, Landmarks.none(), STILL, STILL, AT_REST, gaussians, PINHOLE, SENSOR,
        CONFIG, ANCHOR_PX, 0,
    )  # fmt: skip
    inside = np.all((corners.pixels > 30) & (corners.pixels < (290, 210)), axis=1)
    corners = corners[inside]
    for T_predicted in (T_moved, STILL):
        followed = corners.followed(previous, grey, STILL, T_predicted, PINHOLE, CONFIG)
        assert len(followed) > 0.9 * len(corners) > 30
        rows = [
            int(np.flatnonzero((corners.targets.points == p).all(axis=1))[0])
            for p in followed.targets.points
        ]
        flow = followed.pixels - corners.pixels[rows]
        np.testing.assert_allclose(flow, [shift] * len(flow), atol=TRACKED_PX)


def test_corners_that_vanish_are_lost() -> None:
    previous = image_of_blocks(seed=15)
    pixels = np.random.default_rng(16).uniform(40, 200, (50, 2))
    landmarks = landmarks_at(pixels, lifted(PINHOLE, pixels, np.full(50, 1.5)), previous)
    assert len(landmarks.followed(previous, previous, STILL, STILL, PINHOLE, CONFIG)) > 40
    for grey in (np.full_like(previous, 90), image_of_blocks(seed=17)):
        followed = landmarks.followed(previous, grey, STILL, STILL, PINHOLE, CONFIG)
        assert len(followed) < 0.2 * len(landmarks)


def test_a_corner_that_slid_along_an_edge_is_lost() -> None:
    """From image to image it slides a little; the patch it was detected in gives it away."""
    image = np.full((240, 320), 60, np.uint8)
    image[100:140, 100:220] = 180
    image = cv2.GaussianBlur(image, (5, 5), 1.0).astype(np.uint8)
    pixels = np.array([[100.0, 100.0], [160.0, 100.0]])  # a corner, and a place along an edge
    born = landmarks_at(pixels, lifted(PINHOLE, pixels, np.full(2, 1.5)), image)
    for slid in (0.0, 2.0):
        now = replace(born, pixels=born.pixels + np.array([slid, 0.0], np.float32))
        followed = now.followed(image, image, STILL, STILL, PINHOLE, CONFIG)
        kept = followed.targets.points[:, 0].round(6).tolist()
        assert kept == ([born.targets.points[0, 0].round(6)] if slid == 0.0 else [])


def test_nothing_to_follow() -> None:
    previous = image_of_blocks(seed=18)
    none = Landmarks.none()
    assert len(none.followed(previous, previous, STILL, STILL, PINHOLE, CONFIG)) == 0
    pixels = np.array([[100.0, 100.0]])
    behind = landmarks_at(pixels, lifted(PINHOLE, pixels, np.array([-1.0])), previous)
    assert len(behind.followed(previous, previous, STILL, STILL, PINHOLE, CONFIG)) == 0
    assert len(measured(none, np.full((240, 320), 1.0, np.float32)).points) == 0


def test_seen_from_undoes_the_pose() -> None:
    points = np.random.default_rng(19).uniform(-1, 1, (10, 3))
    landmarks = landmarks_at(np.zeros((10, 2)), to_world(points, T_WORLD_CAM))
    np.testing.assert_allclose(landmarks.seen_from(T_WORLD_CAM), points, atol=ON_PLANE_M)
