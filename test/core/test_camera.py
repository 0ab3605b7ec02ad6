# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Pinhole camera and its lens, against OpenCV and by round trip."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core.camera import CameraError, PinholeCamera
from dcgs_ros.core.kernels import lens

PIXEL = 1e-3  # float32 pixels of an image this size, and OpenCV's own rounding
RAY = 1e-6  # of x/z, y/z in float32
CAMERAS = {
    'none': PinholeCamera(640, 480, 535.4, 539.2, 320.1, 247.6),
    'fr1': PinholeCamera(
        640, 480, 517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    ),
    'fr2': PinholeCamera(
        640, 480, 520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)
    ),
    'barrel': PinholeCamera(640, 480, 400.0, 401.0, 317.0, 244.0, (-0.28, 0.07, 2e-4, 2e-5)),
    'rational': PinholeCamera(
        640, 480, 505.0, 504.8, 321.5, 237.9,
        (0.45, -2.5, 8e-4, -2e-4, 1.46, 0.33, -2.3, 1.4),
    ),
}  # fmt: skip


@pytest.fixture(params=CAMERAS.values(), ids=list(CAMERAS))
def camera(request: pytest.FixtureRequest) -> PinholeCamera:
    """One lens after the other."""
    model: PinholeCamera = request.param
    return model


def points_in_view(camera: PinholeCamera, seed: int) -> NDArray[np.float64]:
    """Points (500, 3) over the whole image and its margin."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform((0, 0), (camera.width, camera.height), (500, 2))
    rays = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    return np.column_stack([rays, np.ones(500)]) * rng.uniform(0.3, 5.0, (500, 1))


def opencv_pixels(camera: PinholeCamera, points: NDArray[np.floating]) -> NDArray[np.float64]:
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    distortion = np.array(camera.distortion or (0.0, 0.0, 0.0, 0.0))
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, distortion)
    return pixels.reshape(-1, 2)


def test_project_is_opencv(camera: PinholeCamera) -> None:
    points = points_in_view(camera, seed=1)
    np.testing.assert_allclose(camera.project(points), opencv_pixels(camera, points), atol=PIXEL)


def test_undistort_undoes_opencv(camera: PinholeCamera) -> None:
    points = points_in_view(camera, seed=2)
    rays = camera.undistort(opencv_pixels(camera, points))
    np.testing.assert_allclose(rays, points[:, :2] / points[:, 2:], atol=RAY)


def test_project_undoes_undistort(camera: PinholeCamera) -> None:
    u, v = np.meshgrid(np.arange(0.0, camera.width, 7), np.arange(0.0, camera.height, 5))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2)
    rays = camera.undistort(pixels)
    lifted = 2.5 * np.column_stack([rays, np.ones(len(rays))])
    np.testing.assert_allclose(camera.project(lifted), pixels, atol=PIXEL)


def test_undistortion_map_is_undistort_of_every_pixel(camera: PinholeCamera) -> None:
    rays = camera.undistortion_map
    assert rays.shape == (camera.height, camera.width, 2) and rays.dtype == np.float32
    rng = np.random.default_rng(3)
    u, v = rng.integers(camera.width, size=200), rng.integers(camera.height, size=200)
    np.testing.assert_array_equal(rays[v, u], camera.undistort(np.column_stack([u, v])))


def test_without_distortion_it_is_the_pinhole() -> None:
    camera = CAMERAS['none']
    pixels = np.random.default_rng(4).uniform((0, 0), (640, 480), (100, 2))
    expected = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    np.testing.assert_allclose(camera.undistort(pixels), expected, atol=RAY)
    assert camera.focal == pytest.approx(0.5 * (camera.fx + camera.fy))


def test_principal_point_is_the_optical_axis(camera: PinholeCamera) -> None:
    np.testing.assert_allclose(
        camera.project(np.array([[0.0, 0.0, 1.7]])), [[camera.cx, camera.cy]], atol=PIXEL
    )


def test_short_distortion_is_padded_with_zeros() -> None:
    """Four coefficients mean the same as those four and zeros."""
    four = PinholeCamera(640, 480, 500.0, 500.0, 320.0, 240.0, (0.1, -0.2, 0.001, -0.002))
    eight = PinholeCamera(640, 480, 500.0, 500.0, 320.0, 240.0, (*four.distortion, *[0.0] * 4))
    points = points_in_view(four, seed=5)
    np.testing.assert_array_equal(four.project(points), eight.project(points))
    np.testing.assert_array_equal(lens.project(four.parameters, points), four.project(points))


def test_no_points_give_no_pixels(camera: PinholeCamera) -> None:
    assert camera.project(np.empty((0, 3))).shape == (0, 2)
    assert camera.undistort(np.empty((0, 2))).shape == (0, 2)


@pytest.mark.parametrize(
    ('arguments', 'named'),
    [
        ((8, 480, 500.0, 500.0, 320.0, 240.0), '8x480'),
        ((640, 0, 500.0, 500.0, 320.0, 240.0), '640x0'),
        ((640, 480, 0.0, 500.0, 320.0, 240.0), 'not usable'),
        ((640, 480, 500.0, -1.0, 320.0, 240.0), 'not usable'),
        ((640, 480, 500.0, 500.0, np.nan, 240.0), 'nan'),
        ((640, 480, 500.0, 500.0, 320.0, np.inf), 'inf'),
        ((640, 480, 500.0, 500.0, 320.0, 240.0, (0.1, 0.2)), '2 numbers'),
        ((640, 480, 500.0, 500.0, 320.0, 240.0, (0.1,) * 6), '6 numbers'),
        ((640, 480, 500.0, 500.0, 320.0, 240.0, (0.1, np.nan, 0.0, 0.0)), 'nan'),
    ],
)
def test_unusable_intrinsics_are_refused(arguments: tuple[Any, ...], named: str) -> None:
    with pytest.raises(CameraError, match=named):
        PinholeCamera(*arguments)
