# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Images of a keyframe: rectified, quantised, compressed, unpacked; and its pose's descent."""

from __future__ import annotations

from contextlib import closing
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.kernels.workers import Workers
from dcgs_ros.core.mapping.exposure import Exposure
from dcgs_ros.core.mapping.rectification import Images, Rectifier
from dcgs_ros.core.mapping.views import KeyframeView, bend

UNIT_M = 5e-4
HALF_UNIT_M = 0.5 * UNIT_M + 1e-6
LEVELS = 2.5  # grey levels: two roundings, and interpolation between pixels
COVERED = 0.95  # of the pixels get depth where resampling spreads it out
PIXEL = 0.75  # how far from its middle a depth may come from
PSNR_DB = 36.0  # of a compressed image that is smooth
PINHOLE = PinholeCamera(96, 72, 80.0, 82.0, 46.0, 37.5)
DISTORTIONS = {
    'barrel': (-0.28, 0.08, 0.001, -0.0007),
    'pincushion': (0.1, 0.02, 0.0, 0.0, 0.01),
    'tum_fr1': (0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
}
WORKERS = Workers(1)
RNG = np.random.default_rng


def distorted(name: str) -> PinholeCamera:
    p = PINHOLE
    return PinholeCamera(p.width, p.height, p.fx, p.fy, p.cx, p.cy, DISTORTIONS[name])


def shade(rays: NDArray[np.floating]) -> NDArray[np.float64]:
    """Colours (..., 3) from 0 to 255 of what is seen along x/z, y/z: smooth."""
    x, y = rays[..., 0], rays[..., 1]
    waves = [np.sin(6 * x + y), np.cos(5 * y - 2 * x), np.sin(4 * x * y + 3 * y)]
    return np.asarray(127.5 + 100 * np.stack(waves, axis=-1))


PLANE_N, PLANE_D = np.array([0.25, -0.15, 1.0]), 1.4  # n . X = d in the first camera


def plane_depth(
    rays: NDArray[np.floating], T_plane_cam: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Depth of the plane along x/z, y/z from a camera elsewhere."""
    T = np.eye(4) if T_plane_cam is None else T_plane_cam
    n, d = PLANE_N @ T[:3, :3], PLANE_D - PLANE_N @ T[:3, 3]
    return np.asarray(d / (rays @ n[:2] + n[2]))


def pinhole_rays() -> NDArray[np.float64]:
    v, u = np.mgrid[: PINHOLE.height, : PINHOLE.width]
    return np.stack([(u - PINHOLE.cx) / PINHOLE.fx, (v - PINHOLE.cy) / PINHOLE.fy], axis=-1)


def frame_of(camera: PinholeCamera, depth_m: NDArray[np.floating] | None = None) -> RgbdFrame:
    rays = camera.undistortion_map.astype(np.float64)
    color = np.round(shade(rays)).astype(np.uint8)
    if depth_m is None:
        depth_m = plane_depth(rays)
    return RgbdFrame(0, 0, color, depth_m.astype(np.float32))


def random_images(seed: int, width: int = 64, height: int = 48) -> Images:
    rng = RNG(seed)
    return Images(
        rng.integers(0, 256, (height, width, 3), dtype=np.uint8),
        rng.integers(0, 1 << 16, (height, width), dtype=np.uint16),
    )


def view_of(
    images: Images, T: NDArray[np.float64] | None = None, last: KeyframeView | None = None
) -> KeyframeView:
    return KeyframeView.of(3, 77, np.eye(4) if T is None else T, images, last)


def slope_m(depth_m: NDArray[np.floating]) -> NDArray[np.float64]:
    """By how much depth changes from a pixel to the next, in both directions together."""
    return np.asarray(np.abs(np.gradient(depth_m)).sum(axis=0))


def test_without_distortion_images_stay_as_they_are() -> None:
    frame = frame_of(PINHOLE)
    rectify = Rectifier(PINHOLE)
    for images in (rectify(frame), rectify(frame, np.eye(4))):
        np.testing.assert_array_equal(images.color, frame.color)
        assert np.abs(images.depth_m - frame.depth_m).max() <= HALF_UNIT_M
    assert rectify.valid.all()


@pytest.mark.parametrize('name', DISTORTIONS)
def test_a_distorted_image_becomes_what_a_pinhole_sees(name: str) -> None:
    """The same colour and depth along each ray, whatever the distortion."""
    camera = distorted(name)
    rectify, rays = Rectifier(camera), pinhole_rays()
    images = rectify(frame_of(camera))
    error = np.abs(images.color - shade(rays))[rectify.valid]
    assert error.max() < LEVELS
    assert np.abs(frame_of(camera).color - shade(rays)).max() > 4 * LEVELS  # it was distorted
    expected = plane_depth(rays)
    seen = images.depth > 0
    assert seen[rectify.valid].mean() > COVERED
    error = np.abs(images.depth_m - expected)[seen]
    assert (error <= PIXEL * slope_m(expected)[seen] + HALF_UNIT_M).all()


@pytest.mark.parametrize('name', DISTORTIONS)
def test_valid_is_what_the_lens_has_seen(name: str) -> None:
    camera = distorted(name)
    rays = pinhole_rays().reshape(-1, 2)
    seen = camera.project(np.column_stack([rays, np.ones(len(rays))]))
    inside = np.all((seen >= 0) & (seen <= (camera.width - 1, camera.height - 1)), axis=1)
    valid = Rectifier(camera).valid
    np.testing.assert_array_equal(valid, inside.reshape(valid.shape))
    assert 0.5 < valid.mean() < 1.0 or name == 'barrel'
    images = Rectifier(camera)(frame_of(camera))
    beyond = np.any((seen < -1) | (seen > (camera.width, camera.height)), axis=1)
    assert not images.color.reshape(-1, 3)[beyond].any()


@pytest.mark.parametrize('name', [None, 'pincushion'])
def test_depth_goes_to_where_the_camera_was_when_it_took_the_color(name: str | None) -> None:
    camera = PINHOLE if name is None else distorted(name)
    T_cam_cam_at_depth = se3.exp(np.array([0.03, -0.02, 0.05, 0.02, -0.01, 0.03]))
    rays = camera.undistortion_map.astype(np.float64)
    T_cam_at_depth_cam = se3.inverse(T_cam_cam_at_depth)
    images = Rectifier(camera)(frame_of(camera, plane_depth(rays)), T_cam_cam_at_depth)
    expected = plane_depth(pinhole_rays(), T_cam_at_depth_cam)
    seen = images.depth > 0
    error = np.abs(images.depth_m - expected)[seen]
    assert (error <= PIXEL * slope_m(expected)[seen] + HALF_UNIT_M).all()
    assert seen[8:-8, 8:-8].mean() > 0.98


def test_what_moves_before_something_else_hides_it() -> None:
    depth_m = np.full((PINHOLE.height, PINHOLE.width), 2.0, np.float32)
    depth_m[20:50, 30:50] = 0.5
    shift_px = 16  # of the near one; the far one goes a quarter of it
    T = np.eye(4)
    T[0, 3] = shift_px * 0.5 / PINHOLE.fx
    images = Rectifier(PINHOLE)(frame_of(PINHOLE, depth_m), T)
    near = np.abs(images.depth_m - 0.5) < HALF_UNIT_M
    expected = np.zeros_like(near)
    expected[20:50, 30 + shift_px : 50 + shift_px] = True
    np.testing.assert_array_equal(near, expected)
    assert not images.depth[30, 35:45].any()  # what it uncovers was not measured


NEARER = np.eye(4)  # pixels move apart by a third
NEARER[2, 3] = -0.4
SPREAD = 1.5 / 1.1


def test_gaps_that_resampling_leaves_in_a_surface_are_closed() -> None:
    depth_m = np.full((PINHOLE.height, PINHOLE.width), 1.5, np.float32)
    images = Rectifier(PINHOLE)(frame_of(PINHOLE, depth_m), NEARER)
    inner = images.depth_m[1:-1, 1:-1]
    assert np.abs(inner - 1.1).max() <= HALF_UNIT_M


def test_holes_in_the_depth_stay_holes() -> None:
    depth_m = np.full((PINHOLE.height, PINHOLE.width), 1.5, np.float32)
    depth_m[30:40, 40:60] = 0
    images = Rectifier(PINHOLE)(frame_of(PINHOLE, depth_m), NEARER)
    center = np.array([PINHOLE.cy, PINHOLE.cx])
    low, high = (SPREAD * (np.array(corner) - center) + center for corner in ((30, 40), (39, 59)))
    (v0, u0), (v1, u1) = low.astype(int), high.astype(int) + 1
    assert not images.depth[v0 + 1 : v1 - 1, u0 + 1 : u1 - 1].any()
    seen = images.depth > 0
    assert np.abs(images.depth_m[seen] - 1.1).max() <= HALF_UNIT_M


@pytest.mark.parametrize('given', [None, np.eye(4)])
@pytest.mark.parametrize('useless', [0.0, np.nan, np.inf, -np.inf, -1.0, 32.8, 1e9, 1e-5])
def test_depth_that_is_none_or_too_far_becomes_none(
    useless: float, given: NDArray[np.float64] | None
) -> None:
    depth_m = np.full((PINHOLE.height, PINHOLE.width), 2.0, np.float32)
    depth_m[20:30, 40:60] = useless
    images = Rectifier(PINHOLE)(frame_of(PINHOLE, depth_m), given)
    none = images.depth == 0
    assert none[20:30, 40:60].all() and none.sum() == 10 * 20


def test_depth_is_kept_to_half_a_unit_up_to_the_limit() -> None:
    rng = RNG(0)
    depth_m = rng.uniform(0.001, 32.7, (PINHOLE.height, PINHOLE.width)).astype(np.float32)
    depth_m[0, :5] = (32.7674, 32.767, 0.0005, 0.0003, 10.0)
    images = Rectifier(PINHOLE)(frame_of(PINHOLE, depth_m))
    assert np.abs(images.depth_m - depth_m).max() <= HALF_UNIT_M + 2e-6
    assert images.depth.dtype == np.uint16 and images.depth_m.dtype == np.float32


def test_grey_is_the_same_in_all_channels() -> None:
    frame = frame_of(PINHOLE)
    grey = RgbdFrame(0, 0, np.ascontiguousarray(frame.color[..., 1]), frame.depth_m)
    for camera in (PINHOLE, distorted('barrel')):
        color = Rectifier(camera)(grey).color
        assert color.shape == (*grey.color.shape, 3) and color.dtype == np.uint8
        np.testing.assert_array_equal(color, color[..., :1].repeat(3, axis=2))
    np.testing.assert_array_equal(Rectifier(PINHOLE)(grey).color[..., 0], grey.color)


def test_compressing_keeps_the_depth_and_most_of_the_color() -> None:
    smooth = Rectifier(PINHOLE)(frame_of(PINHOLE))
    noise = RNG(1).integers(0, 1 << 16, smooth.depth.shape, dtype=np.uint16)
    images = Images(smooth.color, noise)
    view = view_of(images)
    before, encoded = view.bytes, view.encoded
    assert view.images is images
    assert before == images.color.nbytes + images.depth.nbytes
    view.compress()
    np.testing.assert_array_equal(view.images.depth, noise)
    assert view.images.depth.dtype == np.uint16 and view.images.color.dtype == np.uint8
    error = view.images.color.astype(float) - images.color
    assert 10 * np.log10(255**2 / np.mean(error**2)) > PSNR_DB
    assert np.abs(error.mean(axis=(0, 1))).max() < 1  # red is still red
    assert view.encoded == encoded and view.bytes == sum(map(len, encoded))
    view.compress()
    assert view.encoded == encoded


def test_compressing_takes_less_memory() -> None:
    view = view_of(Rectifier(PINHOLE)(frame_of(PINHOLE)))
    before = view.bytes
    view.compress()
    assert view.bytes < before / 2


@pytest.mark.parametrize('shrink', [1, 2])
@pytest.mark.parametrize('size', [(64, 48), (37, 53)])
def test_a_target_has_mean_colors_and_is_valid_where_all_its_pixels_are(
    size: tuple[int, int], shrink: int
) -> None:
    width, height = size
    images, valid = random_images(2, width, height), RNG(3).random((height, width)) < 0.8
    target = view_of(images).target(valid, shrink, WORKERS)
    h, w = height // shrink, width // shrink

    def cells(array: NDArray[Any]) -> NDArray[Any]:
        """(h, w, shrink^2, ...) the pixels of each."""
        cut = array[: h * shrink, : w * shrink]
        split = cut.reshape(h, shrink, w, shrink, *array.shape[2:]).swapaxes(1, 2)
        return split.reshape(h, w, shrink * shrink, *array.shape[2:])

    expected = cells(images.color / 255.0).mean(axis=2)
    np.testing.assert_allclose(np.moveaxis(target.color, 0, -1), expected, atol=1e-6)
    np.testing.assert_array_equal(target.valid, cells(valid).all(axis=2))
    of_cell = np.abs(cells(images.depth_m) - target.depth_m[..., None]).min(axis=2)
    assert of_cell.max() < 1e-6  # one of its own, not a mean over an edge


def test_a_target_is_the_same_with_any_threads_and_compressed_depth() -> None:
    images, valid = random_images(4), np.ones((48, 64), np.bool_)
    view = view_of(images)
    first = view.target(valid, 2, WORKERS)
    with closing(Workers(3)) as workers:
        again = view.target(valid, 2, workers)
    np.testing.assert_array_equal(again.color, first.color)
    view.compress()
    np.testing.assert_array_equal(view.target(valid, 2, WORKERS).depth_m, first.depth_m)


def test_a_view_begins_with_what_the_last_one_was_corrected_by() -> None:
    rng = RNG(5)
    T, T_next, C = (se3.exp(size * rng.normal(size=6)) for size in (1, 1, 0.02))
    first = view_of(random_images(6), T)
    np.testing.assert_array_equal(first.T_world_cam, T)
    np.testing.assert_array_equal(first.exposure.gain, 1)
    np.testing.assert_array_equal(first.exposure.offset, 0)
    first.T_world_cam = T @ C
    first.exposure = Exposure(np.full(3, 1.2, np.float32), np.full(3, 0.1, np.float32))
    np.testing.assert_allclose(first.correction, C, atol=1e-12)
    second = view_of(random_images(7), T_next, first)
    np.testing.assert_allclose(second.T_world_cam, T_next @ C, atol=1e-12)
    np.testing.assert_array_equal(second.T_tracked, T_next)
    assert second.exposure is first.exposure


RATES = np.repeat([3e-3, 1.5e-3], 3)


def test_the_first_turn_goes_against_the_gradient_by_the_rates() -> None:
    T = se3.exp(RNG(8).normal(size=6))
    view = view_of(random_images(9), T)
    gradient = np.array([1e-6, -3.0, 1e4, -1e-6, 0.0, 7.0])
    view.turn(gradient, RATES)
    xi = se3.log(se3.inverse(T) @ view.T_world_cam)
    np.testing.assert_allclose(xi, -RATES * np.sign(gradient), rtol=2e-6, atol=1e-12)
    np.testing.assert_array_equal(view.T_tracked, T)


def test_turns_descend_to_the_bottom_of_a_bowl() -> None:
    rng = RNG(10)
    T, off = se3.exp(rng.normal(size=6)), 0.02 * rng.normal(size=6)
    view = view_of(random_images(11), T @ se3.exp(off))
    stiffness = 10.0 ** rng.uniform(-4, 2, 6)
    distances = []
    for k in range(300):
        xi = se3.log(se3.inverse(T) @ view.T_world_cam)
        distances.append(np.linalg.norm(xi))
        view.turn(stiffness * xi, RATES * 0.99**k)
    assert distances[-1] < 0.02 * distances[0]
    R = view.T_world_cam[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize('garbage', [np.nan, np.inf, -np.inf])
def test_a_gradient_that_is_not_finite_is_no_turn_at_all(garbage: float) -> None:
    rng = RNG(12)
    views = [view_of(random_images(13)) for _ in range(2)]
    for k in range(6):
        gradient = rng.normal(size=6)
        if k == 3:
            bad = gradient.copy()
            bad[k] = garbage
            views[1].turn(bad, RATES)
        for view in views:
            view.turn(gradient, RATES)
    np.testing.assert_array_equal(views[0].T_world_cam, views[1].T_world_cam)


REFINED = se3.exp(np.array([0.02, -0.01, 0.0, 0.0, 0.01, 0.0]))
ANYWHERE = se3.exp(np.array([0.4, -0.3, 0.2, 0.3, -0.5, 0.2]))


def view_at(T_tracked: NDArray[np.float64]) -> KeyframeView:
    images = Images(np.zeros((4, 4, 3), np.uint8), np.ones((4, 4), np.uint16))
    view = KeyframeView.of(0, 5, T_tracked, images, None)
    view.T_world_cam = T_tracked @ REFINED
    return view


@pytest.mark.parametrize(
    ('share', 'bent', 'kept'), [(3.0, 1.0, False), (0.5, 1.0, True), (3.0, 0.0, True)]
)
def test_a_larger_motion_takes_the_place_of_what_was_refined(
    share: float, bent: float, kept: bool
) -> None:
    """Unless all views move as one: then they were right to each other."""
    view = view_at(ANYWHERE)
    before = view.T_world_cam
    apart = se3.exp(share * np.array([-0.02, 0.01, 0.0, 0.0, -0.01, 0.0]))
    motion = ANYWHERE @ apart @ se3.inverse(ANYWHERE)
    in_map = view.move(motion, bent)
    np.testing.assert_allclose(view.T_tracked, ANYWHERE @ apart, atol=1e-12)
    np.testing.assert_allclose(view.correction, REFINED if kept else np.eye(4), atol=1e-12)
    np.testing.assert_allclose(in_map @ before, view.T_world_cam, atol=1e-12)
    if kept:
        np.testing.assert_allclose(in_map, motion, atol=1e-12)


def test_views_that_move_as_one_do_not_bend() -> None:
    views = [view_at(np.eye(4)), view_at(ANYWHERE)]
    rigid = np.array([ANYWHERE, ANYWHERE])
    assert bend(views, rigid) == pytest.approx(0.0, abs=1e-12)
    apart = ANYWHERE @ REFINED @ se3.inverse(ANYWHERE)
    size = float(np.linalg.norm(se3.log(REFINED)))
    assert bend(views, np.array([np.eye(4), apart])) == pytest.approx(size)
