# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Motion blur, noise and auto-exposure against their laws."""

import numpy as np
import pytest

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.datasets.synthetic.color_camera import AutoExposure, expose
from dcgs_ros.datasets.synthetic.raycast import SceneView

CAMERA = PinholeCamera(320, 240, 262.0, 262.0, 159.5, 119.5)
DEPTH_M = 2.0


def view_of(radiance):
    """A wall at constant depth."""
    shape = radiance.shape[:2]
    return SceneView(np.full(shape, DEPTH_M, np.float32), np.ones(shape, np.float32), radiance)


def striped(period_px):
    """Vertical sine stripes (H, W, 3) of amplitude 80 about 120."""
    row = 120 + 80 * np.sin(2 * np.pi * np.arange(CAMERA.width) / period_px)
    image = np.broadcast_to(row[None, :, None], (CAMERA.height, CAMERA.width, 3))
    return np.ascontiguousarray(image, np.float32)


@pytest.mark.parametrize('half_travel_px', [0.0, 1.0, 3.0, 5.0])
def test_sideways_motion_blurs_like_a_sinc(half_travel_px):
    """Moving by +-d pixels damps a sine of angular frequency w by sin(w d) / (w d)."""
    period = 24.0
    motion = np.eye(4)
    motion[0, 3] = half_travel_px * DEPTH_M / CAMERA.fx
    image = expose(view_of(striped(period)), CAMERA, motion, 1.0, 0, 0).astype(float)
    inner = image[:, 24:-24].mean(axis=(0, 2))
    columns = np.arange(CAMERA.width)[24:-24]
    wave = np.exp(2j * np.pi * columns / period)
    whole = len(columns) // 24 * 24
    amplitude = 2 * abs((inner * wave)[:whole].mean())
    expected = 80 * np.sinc(2 * half_travel_px / period)
    assert amplitude == pytest.approx(expected, rel=0.06)


def test_noise_follows_read_and_shot_noise():
    """Variance is g^2 1.44 + g 0.02 level, plus a little from rounding."""
    for level, gain in ((50.0, 1.0), (100.0, 1.0), (60.0, 2.0)):
        flat = np.full((CAMERA.height, CAMERA.width, 3), level, np.float32)
        image = expose(view_of(flat), CAMERA, np.eye(4), gain, 1, 2).astype(float)
        assert image.mean() == pytest.approx(gain * level, abs=0.1)
        variance = 1.44 * gain**2 + 0.02 * gain * (gain * level) + 1 / 12
        assert image.var() == pytest.approx(variance, rel=0.03)


def test_exposure_reaches_its_target_with_lag():
    """A step of brightness is corrected in about 1 / response frames."""
    exposure, dim = AutoExposure(), np.full((64, 64, 3), 60.0, np.float32)
    exposure.react(dim)
    assert 60 * exposure.gain < 0.7 * AutoExposure.target
    for _ in range(100):
        exposure.react(dim)
    assert 60 * exposure.gain == pytest.approx(AutoExposure.target, rel=0.01)
