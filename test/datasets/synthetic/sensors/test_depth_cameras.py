# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Depth cameras against the laws they model."""

from dataclasses import replace

import numpy as np
import pytest

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.datasets.synthetic.raycast import SceneView
from dcgs_ros.datasets.synthetic.sensors.active_stereo import ActiveStereo
from dcgs_ros.datasets.synthetic.sensors.depth_camera import Shot
from dcgs_ros.datasets.synthetic.sensors.structured_light import StructuredLight

CAMERA = PinholeCamera(640, 480, 525.0, 525.0, 319.5, 239.5)
SHAPE = (480, 640)
SHOT = Shot(seed=0, index=0, pattern=4.0)


def wall(depth_m, contrast=40.0):
    """A wall (or any depth image) seen straight on, with white-noise texture."""
    depth = np.broadcast_to(np.float32(depth_m), SHAPE).copy()
    grey = 120 + contrast * np.random.default_rng(0).standard_normal((*SHAPE, 1))
    radiance = np.repeat(np.clip(grey, 0, 255), 3, axis=2).astype(np.float32)
    return SceneView(depth, np.ones(SHAPE, np.float32), radiance)


def autocorrelation(error, shift):
    """Pearson's coefficient of an image with itself, shifted sideways."""
    return np.corrcoef(error[:, shift:].ravel(), error[:, :-shift].ravel())[0, 1]


@pytest.mark.parametrize('z', [0.8, 1.5, 2.5, 3.5])
def test_kinect_noise_follows_its_law(z):
    """Nguyen 2012: 0.0012 + 0.0019 (z - 0.4)^2 metres, without bias."""
    view = wall(np.linspace(z - 0.02, z + 0.02, SHAPE[1]))  # a slope: no one disparity step rules
    error = StructuredLight().measure(view, CAMERA, SHOT) - view.depth_m
    law = 0.0012 + 0.0019 * (z - 0.4) ** 2
    assert error.std() == pytest.approx(law, rel=0.12)
    assert abs(error.mean()) < 0.002 * z


def test_kinect_disparity_comes_in_eighths():
    """580 px * 0.075 m / z is a multiple of 1/8 pixel."""
    depth = StructuredLight().measure(wall(2.0), CAMERA, SHOT)
    eighths = 8 * 580 * 0.075 / depth[depth > 0]
    assert np.abs(eighths - np.round(eighths)).max() < 1e-3


def test_kinect_casts_shadows_and_has_a_range():
    """A step hides fb (1/near - 1/far) pixels on one side; 0.4 to 6 m count."""
    depth = np.where(np.arange(640) < 320, 1.0, 2.0)
    measured = StructuredLight().measure(wall(depth), CAMERA, SHOT)
    hidden = (measured[:, 300:400] == 0).mean(axis=0).sum()
    assert hidden == pytest.approx(580 * 0.075 * 0.5, abs=3)
    for z in (0.3, 6.6):
        assert not StructuredLight().measure(wall(z), CAMERA, SHOT).any()


def test_stereo_noise_is_that_of_disparity():
    """sigma_z = z^2 / (f b) sigma_d with sigma_d close to 0.08 px on good texture."""
    for z in (0.8, 1.6, 2.4):
        view = wall(z)
        measured = ActiveStereo().measure(view, CAMERA, SHOT)
        valid = measured > 0
        assert valid.mean() > 0.97
        disparity = 385 * 0.05 / measured[valid]
        assert np.std(disparity) == pytest.approx(0.08, rel=0.2)
        millimetres = measured[valid] * 1000
        assert np.abs(millimetres - np.round(millimetres)).max() < 1e-3


def test_stereo_noise_comes_in_blobs_that_flicker():
    """Correlated over 5-10 pixels within a frame, independent from frame to frame."""
    view = wall(1.5)
    camera = ActiveStereo()
    first, second = (camera.measure(view, CAMERA, replace(SHOT, index=k)) - 1.5 for k in (0, 1))
    halves = [s for s in range(1, 20) if autocorrelation(first, s) < 0.5]
    assert 5 <= 2 * halves[0] <= 10  # the blobs' full width at half maximum
    assert autocorrelation(first, 1) > 0.7
    assert abs(autocorrelation(first, 30)) < 0.05
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.05


def test_stereo_fattens_the_nearer_surface():
    """The foreground grows by half a matching window, 3 to 5 pixels."""
    depth = np.full(SHAPE, 2.0)
    depth[120:360, 220:420] = 1.0
    measured = ActiveStereo().measure(wall(depth), CAMERA, SHOT)
    # Left of it no shadow falls; the widths are means over the rows of the side.
    grown = (np.abs(measured[140:340, 200:220] - 1.0) < 0.2).sum(axis=1)
    assert 3 <= grown.mean() <= 5
    assert set(np.unique(grown)) <= {2, 3, 4, 5}


def test_stereo_needs_texture_light_or_pattern():
    """A plain wall is lost without the pattern, found with it close by, darkness is lost."""
    camera = ActiveStereo()
    plain, dark = wall(1.0, contrast=0.5), wall(1.0, contrast=0.5)
    dark.radiance[...] *= 0.05
    assert (camera.measure(plain, CAMERA, replace(SHOT, pattern=0.0)) > 0).mean() < 0.1
    assert (camera.measure(plain, CAMERA, replace(SHOT, pattern=16.0)) > 0).mean() > 0.9
    assert (camera.measure(dark, CAMERA, replace(SHOT, pattern=16.0)) > 0).mean() < 0.1


def test_stereo_cuts_near_and_is_wild_far():
    """Nothing nearer than 0.28 m; beyond 4 m errors exceed the law several times."""
    camera = ActiveStereo()
    assert not camera.measure(wall(0.27), CAMERA, SHOT).any()
    measured = camera.measure(wall(4.5), CAMERA, SHOT)
    law = camera.noise.sigma(4.5)
    assert measured[measured > 0].std() > 2 * law
