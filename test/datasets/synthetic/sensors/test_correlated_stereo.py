# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The measured D435i against the statistics that were measured."""

from dataclasses import replace

import numpy as np
import pytest
from walls import (  # type: ignore[import-not-found]
    SHAPE,
    correlation,
    plane_residual,
    wall,
)

from dcgs_ros.datasets.camera_presets import PRESETS
from dcgs_ros.datasets.synthetic.sensors.correlated_stereo import CorrelatedStereo
from dcgs_ros.datasets.synthetic.sensors.depth_camera import Shot
from dcgs_ros.datasets.synthetic.sensors.disparity_noise import disparity_noise

CAMERA = PRESETS['d435i'].camera
FOCAL_BASELINE = 615 * 0.05
SHOT = Shot(seed=0, index=0, pattern=4.0)
SEEDS = range(6)


def disparity_error(z, shot=SHOT):
    """Pixels of disparity (H, W) by which a textured wall at z metres is measured wrong."""
    depth = CorrelatedStereo().measure(wall(z), CAMERA, shot)
    assert (depth > 0).mean() > 0.99
    return FOCAL_BASELINE / np.where(depth > 0, depth, z) - FOCAL_BASELINE / z


@pytest.mark.parametrize('z', [1.2, 1.8, 2.5])
def test_noise_is_smooth_over_tens_of_pixels_at_any_distance(z):
    """Measured: 0.014 px within 5 pixels, 0.03 within 11, 0.06 within 21, 0.08 within 41."""
    errors = [disparity_error(z, replace(SHOT, seed=seed)) for seed in SEEDS]
    for size, law in ((5, 0.014), (11, 0.03), (21, 0.06), (41, 0.08)):
        found = np.sqrt(np.mean([plane_residual(error, size, 80) ** 2 for error in errors]))
        assert found == pytest.approx(law, rel=0.15)


def test_neighbours_share_their_noise():
    """Measured on residuals of a tracker: 0.38, 0.14, 0.05 at 8-15, 25-40, 60-100 pixels."""
    found = []
    for shifts in (range(8, 16, 2), range(25, 41, 5), range(60, 101, 10), range(200, 261, 20)):
        images = (disparity_noise(seed, 0, 0.0, SHAPE) for seed in range(20))
        found.append(np.mean([correlation(image, shifts) for image in images]))
    assert 0.38 < found[0] < 0.65 and 0.14 <= found[1] < 0.3
    assert 0.0 < found[2] < 0.12 and abs(found[3]) < 0.05


def test_noise_matches_what_the_preset_claims():
    """Overall it is the 0.08 px at f = 385 that the preset of a D435i takes."""
    images = np.stack([disparity_noise(seed, 0, 0.0, SHAPE) for seed in range(20)])
    assert images.std() * 385 / 615 == pytest.approx(0.08, rel=0.1)
    assert CorrelatedStereo.noise == PRESETS['d435i'].sensor


@pytest.mark.parametrize(
    ('travel_px', 'low', 'high'), [(0.0, 0.7, 0.8), (10.0, 0.45, 0.6), (40.0, -0.1, 0.1)]
)
def test_noise_stays_while_the_camera_does(travel_px, low, high):
    """At rest the next frame has three quarters of it; 40 pixels further it has none."""
    found = []
    for seed in range(10):
        first = disparity_noise(seed, 0, 0.0, SHAPE)
        later = disparity_noise(seed, 1, travel_px, SHAPE)
        assert later.std() == pytest.approx(0.123, rel=0.25)
        found.append(np.corrcoef(first.ravel(), later.ravel())[0, 1])
    assert low < np.mean(found) < high


def share(shot=SHOT, **properties):
    """Share of a wall's pixels that have depth."""
    depth_m = properties.pop('depth_m', 1.2)
    depth = CorrelatedStereo().measure(wall(depth_m, **properties), CAMERA, shot)
    return (depth > 0).mean()


def test_depth_needs_texture_light_or_pattern_and_an_angle():
    """Each of them alone decides between a full image and an empty one."""
    assert share(contrast=30.0) > 0.99
    assert share(contrast=0.5, depth_m=2.5) < 0.01
    assert share(replace(SHOT, pattern=16.0), contrast=0.5) > 0.99
    dim = replace(SHOT, light=0.02, pattern=0.5)
    assert share(dim, contrast=8.0) < 0.3 < 0.9 < share(replace(dim, light=1.0), contrast=8.0)
    assert share(cosine=0.4) > 0.99 and share(cosine=0.05) < 0.05


def test_depth_has_the_cameras_format():
    """Whole millimetres, as the preset's depth unit; nothing nearer than 0.28 m."""
    depth = CorrelatedStereo().measure(wall(1.0), CAMERA, SHOT)
    millimetres = depth * 1000
    assert depth.dtype == np.float32 and np.abs(millimetres - np.round(millimetres)).max() < 1e-3
    assert not CorrelatedStereo().measure(wall(0.27), CAMERA, SHOT).any()


def test_the_nearer_surface_grows_and_casts_a_shadow():
    """By half a matching window, and by the difference of disparities."""
    depth = np.full(SHAPE, 2.0)
    depth[120:360, 220:420] = 1.0
    measured = CorrelatedStereo().measure(wall(depth), CAMERA, SHOT)
    grown = (np.abs(measured[140:340, 200:220] - 1.0) < 0.2).sum(axis=1)
    assert 3 <= grown.mean() <= 5
    hidden = (measured[140:340, 420:460] == 0).sum(axis=1)
    assert hidden.mean() == pytest.approx(FOCAL_BASELINE * 0.5, abs=2)
