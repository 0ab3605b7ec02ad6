# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Motion blur, noise and auto-exposure against their laws."""

import os
import subprocess
import sys

import numpy as np
import pytest

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.datasets.synthetic.raycast import SceneView
from dcgs_ros.datasets.synthetic.sensors.color_camera import expose
from dcgs_ros.datasets.synthetic.sensors.exposure import (
    AutoExposure,
    FixedExposure,
    MeteredExposure,
)

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
    image = expose(view_of(striped(period)), CAMERA, motion, FixedExposure(), 0, 0).astype(float)
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
        exposure = AutoExposure()
        exposure.gain = gain
        image = expose(view_of(flat), CAMERA, np.eye(4), exposure, 1, 2).astype(float)
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


def flat(level):
    """An even image (H, W, 3)."""
    return np.full((CAMERA.height, CAMERA.width, 3), level, np.float32)


@pytest.mark.parametrize(
    ('level', 'time_ms', 'gain'),
    [
        (448.0, 2.5, 1.0),
        (112.0, 10.0, 1.0),
        (40.0, 28.0, 1.0),
        (11.2, 33.0, 3.03),
        (1.0, 33.0, 8.0),
    ],
)
def test_dim_light_is_first_collected_for_longer_then_amplified(level, time_ms, gain):
    """Time times gain brings the mean to 112 grey levels, as far as 33 ms and a gain of 8 do."""
    exposure = MeteredExposure(flat(level))
    assert 1e3 * exposure.time_s == pytest.approx(time_ms, rel=1e-3)
    assert exposure.gain == pytest.approx(gain, rel=2e-3)
    image = expose(view_of(flat(level)), CAMERA, np.eye(4), exposure, 0, 0)
    assert image.mean() == pytest.approx(min(112.0, 26.4 * level), abs=0.5)


def test_noise_grows_as_light_fails():
    """A gain of g: the variance of 3.7 grey levels^2 at 112 becomes 1.44 g^2 + 2.24 g."""
    for level in (112.0, 11.2):
        exposure = MeteredExposure(flat(level))
        image = expose(view_of(flat(level)), CAMERA, np.eye(4), exposure, 0, 0).astype(float)
        gain = exposure.gain
        assert image.var() == pytest.approx(1.44 * gain**2 + 2.24 * gain + 1 / 12, rel=0.04)


def test_metering_lags():
    """Where the light goes out, the image is dark at first and recovers in about a second."""
    exposure = MeteredExposure(flat(112.0))
    exposure.react(flat(20.0))
    assert 20 * exposure.light * exposure.gain < 30
    for _ in range(30):
        exposure.react(flat(20.0))
    assert 20 * exposure.light * exposure.gain == pytest.approx(112, rel=0.1)


@pytest.mark.parametrize('half_travel_px', [10.0, 25.0])
def test_long_blur_is_even(half_travel_px):
    """A bright line becomes a band of 2 d pixels, without stripes between samples."""
    exposure, motion = MeteredExposure(flat(60.0)), np.eye(4)
    motion[0, 3] = half_travel_px * DEPTH_M / CAMERA.fx
    line = flat(0.0)
    line[:, 159:162] = 1500
    row = expose(view_of(line), CAMERA, motion, exposure, 0, 0).mean(axis=(0, 2))
    columns = np.arange(320)[row > 0.5 * row.max()]
    assert len(columns) == pytest.approx(2 * half_travel_px, abs=2)
    band = row[columns[3:-3]]
    assert band.std() < 0.1 * band.mean()


def test_bytes_do_not_depend_on_who_compiled(tmp_path):
    """The process that compiles the kernel and those that load it write the same image."""
    script = (
        'import hashlib, numpy as np\n'
        'from dcgs_ros.core.camera import PinholeCamera\n'
        'from dcgs_ros.datasets.synthetic.raycast import SceneView\n'
        'from dcgs_ros.datasets.synthetic.sensors.color_camera import expose\n'
        'from dcgs_ros.datasets.synthetic.sensors.exposure import FixedExposure\n'
        'rng = np.random.default_rng(0)\n'
        'depth = rng.uniform(1, 3, (480, 640)).astype(np.float32)\n'
        'radiance = rng.uniform(0, 255, (480, 640, 3)).astype(np.float32)\n'
        'motion = np.eye(4)\n'
        'motion[:3, 3] = 0.02, 0.01, 0.03\n'
        'camera = PinholeCamera(640, 480, 525.0, 525.0, 319.5, 239.5)\n'
        'view = SceneView(depth, depth, radiance)\n'
        'image = expose(view, camera, motion, FixedExposure(), 0, 0)\n'
        'print(hashlib.sha256(image).hexdigest())\n'
    )
    environment = {**os.environ, 'NUMBA_CACHE_DIR': str(tmp_path)}
    found = [
        subprocess.run(
            [sys.executable, '-c', script],
            env=environment,
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        for _ in range(2)
    ]
    assert found[0] == found[1] != ''
