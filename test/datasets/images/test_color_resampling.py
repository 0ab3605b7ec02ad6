# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Resampled colour is the colour on the rays of the depth camera's pixels."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scannets import (  # type: ignore[import-not-found]
    COLOR_SIZE,
    DEPTH_SIZE,
    K_COLOR,
    K_DEPTH,
    small_camera,
)

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.datasets.images.color_resampling import color_resampling

GREY_STEP = 1.0
SHIFT_PX = 0.02

SCANNET_COLOR = PinholeCamera(1296, 968, 1170.19, 1170.19, 647.75, 483.75)
SCANNET_DEPTH = PinholeCamera(640, 480, 571.62, 571.62, 319.5, 239.5)


def gradient(camera: PinholeCamera) -> NDArray[np.uint8]:
    """Return ramps (H, W, 3) of the pixels' position: across, down, along the diagonal."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    across, down = u * 200.0 / camera.width + 20, v * 200.0 / camera.height + 20
    return np.rint(np.stack([across, down, (across + down) / 2], axis=2)).astype(np.uint8)


def seen(
    color: PinholeCamera, depth: PinholeCamera
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Return colour's pixels, u and v (h, w), on the rays of depth's pixels."""
    u, v = np.meshgrid(np.arange(depth.width), np.arange(depth.height))
    return (
        (u - depth.cx) / depth.fx * color.fx + color.cx,
        (v - depth.cy) / depth.fy * color.fy + color.cy,
    )


def errors_of(color: PinholeCamera, depth: PinholeCamera) -> NDArray[np.float64]:
    """Return errors (N, 3), grey levels, of the resampled ramps inside the image's border."""
    full = np.ones((depth.height, depth.width), np.float32)
    resampled, _ = color_resampling(color, depth, np.eye(4))(gradient(color), full)
    u, v = seen(color, depth)
    across, down = u * 200.0 / color.width + 20, v * 200.0 / color.height + 20
    exact = np.stack([across, down, (across + down) / 2], axis=2)
    interior = (u > 3) & (u < color.width - 4) & (v > 3) & (v < color.height - 4)
    assert interior.mean() > 0.7
    return (resampled - exact)[interior]


@pytest.mark.parametrize(
    'depth',
    [
        SCANNET_DEPTH,
        PinholeCamera(640, 480, 577.59, 578.73, 318.9, 242.68),
        PinholeCamera(640, 480, 500.0, 510.0, 300.0, 250.0),
    ],
)
def test_each_depth_pixel_shows_the_color_on_its_ray(depth: PinholeCamera) -> None:
    assert np.abs(errors_of(SCANNET_COLOR, depth)).max() < GREY_STEP


def test_nothing_is_shifted_by_a_part_of_a_pixel() -> None:
    color, depth = small_camera(COLOR_SIZE, K_COLOR), small_camera(DEPTH_SIZE, K_DEPTH)
    levels_per_px = 200.0 * np.array([color.fx / color.width, color.fy / color.height])
    levels_per_px /= (depth.fx, depth.fy)  # steep: four levels
    shift_px = errors_of(color, depth)[:, :2].mean(axis=0) / levels_per_px
    assert np.abs(shift_px).max() < SHIFT_PX


@pytest.mark.parametrize('depth', [SCANNET_DEPTH, PinholeCamera(640, 480, 400, 700, 200, 100)])
def test_depth_ends_where_color_does(depth: PinholeCamera) -> None:
    full = np.ones((depth.height, depth.width), np.float32)
    resample = color_resampling(SCANNET_COLOR, depth, np.eye(4))
    _, depth_m = resample(gradient(SCANNET_COLOR), full)
    u, v = seen(SCANNET_COLOR, depth)
    inside = (u >= -0.5) & (u <= SCANNET_COLOR.width - 0.5)
    inside &= (v >= -0.5) & (v <= SCANNET_COLOR.height - 0.5)
    np.testing.assert_array_equal(depth_m > 0, inside)


def test_one_camera_for_both_leaves_them_as_they_are() -> None:
    image = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    depth = np.random.default_rng(1).uniform(1, 2, (480, 640)).astype(np.float32)
    color, depth_m = color_resampling(SCANNET_DEPTH, SCANNET_DEPTH, np.eye(4))(image, depth)
    np.testing.assert_array_equal(color, image)
    np.testing.assert_array_equal(depth_m, depth)
