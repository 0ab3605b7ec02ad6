# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Cameras of any lens: against OpenCV and the formula, rectified, or refused with numbers."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from dcgs_ros.core.camera import CameraError, LensError, PinholeCamera
from dcgs_ros.core.lens_camera import LensCamera, border_rays, make_camera

PIXEL = 1e-3
SIZE, K = (640, 480), (400.0, 401.0, 317.0, 244.0)
RATIONAL = (0.45, -2.5, 8e-4, -2e-4, 1.46, 0.33, -2.3, 1.4)
PRISM = (*RATIONAL, 1e-3, -2e-4, 5e-4, 1e-4)
TILTED = (*PRISM, 0.02, -0.01)
FISHEYE = (-0.006, 0.043, -0.041, 0.008)  # a T265's
FOLDED = (-0.5, 0.0, 0.0, 0.0)


def test_twelve_and_fourteen_coefficients_are_opencv() -> None:
    rays = np.random.default_rng(0).uniform((-0.5, -0.5, 1.0), (0.5, 0.5, 2.0), (100, 3))
    matrix = np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]])
    for distortion in (PRISM, TILTED):
        expected, _ = cv2.projectPoints(
            rays, np.zeros(3), np.zeros(3), matrix, np.array(distortion)
        )
        camera = LensCamera(*SIZE, *K, distortion)
        np.testing.assert_allclose(camera.project(rays), expected.reshape(-1, 2), atol=PIXEL)


def test_a_fisheye_is_its_polynomial_of_the_angle() -> None:
    camera = LensCamera(*SIZE, 180.0, 181.0, 317.0, 244.0, FISHEYE, fisheye=True)
    angles, turns = np.linspace(0.01, 1.5, 50), np.linspace(0.0, 6.0, 50)
    across = np.column_stack([np.cos(turns), np.sin(turns)])
    rays = np.column_stack([np.sin(angles)[:, None] * across, np.cos(angles)])
    powers = sum(k * angles ** (2 * n + 3) for n, k in enumerate(FISHEYE))
    expected = (angles + powers)[:, None] * across * (180.0, 181.0) + (317.0, 244.0)
    np.testing.assert_allclose(camera.project(rays), expected, atol=PIXEL)


@pytest.mark.parametrize(
    ('distortion', 'fisheye', 'kind'),
    [
        ((), False, PinholeCamera),
        (RATIONAL, False, PinholeCamera),
        ((*RATIONAL, 0, 0, 0, 0), False, PinholeCamera),
        ((*RATIONAL, *[0.0] * 6), False, PinholeCamera),
        (PRISM, False, LensCamera),
        (TILTED, False, LensCamera),
        (FISHEYE, True, LensCamera),
        ((*FISHEYE, 0.0), True, LensCamera),
        ((-0.3, 0.1, 0.0, 0.0), False, LensCamera),  # the fixed-point iteration does not converge
    ],
)
def test_what_the_tracker_models_is_not_resampled(
    distortion: tuple[float, ...], fisheye: bool, kind: type
) -> None:
    intrinsics = (300.0, 300.0, 317.0, 244.0) if kind is LensCamera else K
    assert isinstance(make_camera(SIZE, intrinsics, distortion, fisheye), kind)


@pytest.mark.parametrize('cx', [319.5, 250.0])
@pytest.mark.parametrize(('distortion', 'fisheye'), [(TILTED, False), (FISHEYE, True)])
def test_the_lens_sees_every_rectified_pixel(
    cx: float, distortion: tuple[float, ...], fisheye: bool
) -> None:
    camera = LensCamera(640, 480, 300.0, 300.0, cx, 239.5, distortion, fisheye)
    pinhole = camera.pinhole
    assert not pinhole.distortion and (pinhole.width, pinhole.height) == (640, 480)
    assert (pinhole.cx, pinhole.cy) == (cx, 239.5) and 300.0 <= pinhole.fx < 400.0
    seen = camera.project(border_rays(pinhole))
    assert (seen >= -0.5).all() and (seen <= (639.5, 479.5)).all()


def test_border_rays_meet_the_border() -> None:
    camera = PinholeCamera(*SIZE, *K, RATIONAL)
    u, v = camera.project(border_rays(camera)).T
    on_it = np.minimum.reduce([abs(u), abs(u - 639), abs(v), abs(v - 479)])
    assert on_it.max() < PIXEL and u.max() > 638 and v.max() > 478


@pytest.mark.parametrize(
    ('distortion', 'fisheye', 'turns_px'),
    # r (1 + k r^2) turns back at r = (-3k)^-1/2, and likewise the fisheye's angle.
    [
        (FOLDED, False, 300.0 * (2 / 3) * (1.5**-0.5)),
        ((*FOLDED, 0.0, 0.0, 0.0, 0.0, 1e-9, 0.0, 0.0, 0.0), False, 300 * (2 / 3) * 1.5**-0.5),
        (FOLDED, True, 300.0 * (2 / 3) * (1.5**-0.5)),
    ],
)
def test_a_lens_that_turns_back_in_the_image_is_refused_with_the_radius(
    distortion: tuple[float, ...], fisheye: bool, turns_px: float
) -> None:
    with pytest.raises(CameraError, match=rf'turns back {turns_px:.0f} px .* 400 px away'):
        make_camera(SIZE, (300.0, 300.0, 320.0, 240.0), distortion, fisheye)


def test_a_pinhole_camera_with_a_lens_that_cannot_be_inverted_is_refused() -> None:
    with pytest.raises(LensError, match=r'pixel .* of 640x480 comes back .* px away'):
        PinholeCamera(640, 480, 525.0, 525.0, 319.5, 239.5, (-1.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ('size', 'intrinsics', 'distortion', 'fisheye', 'named'),
    [
        (SIZE, (0.0, 400.0, 320.0, 240.0), TILTED, False, 'not usable'),
        (SIZE, K, FISHEYE[:3], True, '3 numbers'),
        (SIZE, K, (0.1,) * 5, True, '5 numbers'),
        (SIZE, K, (0.1,) * 9, False, '9 numbers'),
        (SIZE, K, (0.1,) * 15, False, '15 numbers'),
        (SIZE, K, (*PRISM[:-1], np.nan), False, 'nan'),
        (SIZE, K, (np.inf, 0.0, 0.0, 0.0), True, 'inf'),
        ((8, 8), K, FISHEYE, True, '8x8'),
        (SIZE, (400.0, 400.0, -900.0, 240.0), FISHEYE, True, 'centre is'),
    ],
)
def test_numbers_that_are_no_camera_are_refused(
    size: tuple[int, int],
    intrinsics: tuple[float, float, float, float],
    distortion: tuple[float, ...],
    fisheye: bool,
    named: str,
) -> None:
    with pytest.raises(CameraError, match=named):
        make_camera(size, intrinsics, distortion, fisheye)
