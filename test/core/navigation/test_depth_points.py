# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Tests of depth as points."""

from __future__ import annotations

import numpy as np

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.navigation.depth_points import depth_points
from dcgs_ros.core.sensor import SensorNoise

CAMERA = PinholeCamera(640, 480, 500.0, 510.0, 320.0, 240.0)


def test_points_are_of_every_fourth_pixel_in_range_at_colours_instant() -> None:
    """They project back to the pixels that they come from."""
    depth_m = np.full((480, 640), 2.0, np.float32)
    depth_m[:240], depth_m[0, 0], depth_m[4, 4] = 0.0, 9.0, np.nan
    T = se3.exp(np.array([0.01, 0.02, -0.03, 0.01, 0.0, 0.02]))
    points = depth_points(depth_m, CAMERA, SensorNoise(), T)
    assert points.dtype == np.float32
    back = se3.transform(se3.inverse(T), points)
    np.testing.assert_allclose(back[:, 2], 2.0, atol=1e-6)
    u, v = np.meshgrid(np.arange(0, 640, 4), np.arange(240, 480, 4))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    np.testing.assert_allclose(CAMERA.project(back), pixels, atol=1e-3)


def test_image_without_depth_has_no_points() -> None:
    """The cloud is empty then, which clears nothing and marks nothing."""
    none = np.zeros((480, 640), np.float32)
    assert depth_points(none, CAMERA, SensorNoise(), np.eye(4)).shape == (0, 3)
