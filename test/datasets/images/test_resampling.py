# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A resampled image is what the other camera sees: of a plane, with a smooth texture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from lens_views import plane_m, texture  # type: ignore[import-not-found]

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.errors import FrameError
from dcgs_ros.core.lens_camera import Camera, LensCamera
from dcgs_ros.datasets.images.resampling import (
    NOISE_PX,
    is_same,
    moved_px,
    resample_color,
    resample_depth,
    scaled,
)

CAMERA = PinholeCamera(160, 120, 131.0, 132.0, 79.0, 60.0)
CURVED = replace(CAMERA, distortion=(0.1, -0.2, 0.001, 0.002, 0.05))
FISHEYE = LensCamera(200, 160, 110.0, 111.0, 99.0, 80.0, (-0.006, 0.043, -0.041, 0.008), True)
TILTED = LensCamera(
    160, 120, 131.0, 132.0, 79.0, 60.0,
    (0.45, -0.5, 8e-4, -2e-4, 0.3, 0.33, -0.4, 0.2, 1e-3, -2e-4, 5e-4, 1e-4, 0.02, -0.01),
)  # fmt: skip
EXACT_M = 1e-4
GREY = 1.0


SOURCES = {
    'focal length': replace(CAMERA, fx=134.0, fy=135.0, cx=79.5),
    'lens': CURVED,
    'fisheye': FISHEYE,
    'tilted': TILTED,
    'larger': scaled(CAMERA, 400, 300),
    'smaller': scaled(CAMERA, 64, 48),
}


@pytest.mark.parametrize('source', SOURCES.values(), ids=list(SOURCES))
@pytest.mark.parametrize('target', [CAMERA, CURVED])
def test_the_target_sees_the_same_plane_and_texture(source: Camera, target: PinholeCamera) -> None:
    depth_m = resample_depth(plane_m(source), source, target)
    seen = depth_m > 0
    assert seen[8:-8, 8:-8].all()
    np.testing.assert_allclose(depth_m[seen], plane_m(target)[seen], atol=EXACT_M)
    color = resample_color(texture(source), source, target)
    off = np.abs(color.astype(float) - texture(target))[8:-8, 8:-8]
    assert off.mean() < GREY and off.max() < 6 * GREY


def test_colour_is_averaged_where_it_is_shrunk() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    shrunk = resample_color(noise, scaled(CAMERA, 640, 480), CAMERA)
    means = noise.reshape(120, 4, 160, 4, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(shrunk, means, atol=0.51)


def test_grey_is_resampled_as_well() -> None:
    grey = texture(CURVED)[..., 0]
    expected = resample_color(texture(CURVED), CURVED, CAMERA)[..., 0]
    np.testing.assert_array_equal(resample_color(grey, CURVED, CAMERA), expected)


def test_noise_of_the_intrinsics_leaves_the_images_themselves() -> None:
    noisy = replace(CURVED, fx=CURVED.fx + 1e-9, cx=CURVED.cx + 0.5 * NOISE_PX)
    color, depth_m = texture(CAMERA), plane_m(CAMERA)
    assert resample_color(color, noisy, CURVED) is color
    assert resample_depth(depth_m, noisy, CURVED) is depth_m
    assert not is_same(replace(noisy, cx=CURVED.cx + 2 * NOISE_PX), CURVED)
    assert moved_px(replace(CAMERA, fx=1.03 * CAMERA.fx), CAMERA) == pytest.approx(0.03 * 80, 0.05)


def test_depth_is_not_interpolated_across_an_edge_or_a_hole() -> None:
    coarse = scaled(CAMERA, 40, 30)
    depth_m = np.full((30, 40), 1.0, np.float32)
    depth_m[:, 20:] = 3.0
    depth_m[10:20, 5:10] = 0.0
    fine = resample_depth(depth_m, coarse, CAMERA)
    assert set(np.unique(fine)) == {0.0, 1.0, 3.0}
    assert (fine[:, :80] != 3.0).all() and (fine[:, 80:] == 3.0).all()
    assert (fine == 0.0).sum() == 16 * 50


@pytest.mark.parametrize('value', [np.nan, np.inf, -1.0])
def test_what_is_no_measurement_is_none(value: float) -> None:
    depth_m = plane_m(CAMERA)
    depth_m[50, 60] = value
    resampled = resample_depth(depth_m, CAMERA, CURVED)
    assert np.isfinite(resampled).all() and (resampled >= 0).all()
    np.testing.assert_allclose(resampled[resampled > 0], plane_m(CURVED)[resampled > 0], rtol=0.05)


def test_an_image_of_another_size_is_refused() -> None:
    with pytest.raises(FrameError, match=r'depth is 40x30 pixels.*160x120'):
        resample_depth(np.ones((30, 40), np.float32), CAMERA, CURVED)
    with pytest.raises(FrameError, match=r'colour is 40x30 pixels.*160x120'):
        resample_color(np.ones((30, 40, 3), np.uint8), CAMERA, CURVED)
