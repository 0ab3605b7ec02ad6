# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""An uncalibrated Kinect: its bias, its registration and its holes."""

import cv2
import numpy as np
import pytest
from walls import SHAPE, wall  # type: ignore[import-not-found]

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.sensor import SensorNoise
from dcgs_ros.datasets.synthetic.sensors.depth_camera import Shot
from dcgs_ros.datasets.synthetic.sensors.uncalibrated_light import UncalibratedLight
from dcgs_ros.datasets.synthetic.source import SyntheticSource

CAMERA = PinholeCamera(640, 480, 525.0, 525.0, 319.5, 239.5)
SEEDS = range(5)


@pytest.mark.parametrize('seed', SEEDS)
def test_depth_is_biased_smoothly_and_for_ever(seed):
    """The mean of many frames shows the map: 1 to 3 % at most, no steps, the same every time."""
    camera = UncalibratedLight(seed)
    depths = [camera.measure(wall(1.5), CAMERA, Shot(seed, index, 4.0)) for index in range(12)]
    assert (depths[0] > 0).mean() > 0.98
    relative = np.mean(depths, axis=0) / 1.5 - 1
    found = cv2.blur(np.where(np.min(depths, axis=0) > 0, relative, camera.bias(*SHAPE)), (31, 31))
    assert np.abs(found - camera.bias(*SHAPE))[20:-20, 20:-20].max() < 0.002
    assert 0.01 < np.abs(camera.bias(*SHAPE)).max() <= 0.03
    assert max(np.abs(np.diff(camera.bias(*SHAPE), axis=k)).max() for k in (0, 1)) < 0.0005
    assert np.abs(camera.bias(*SHAPE).mean()) < 0.001
    assert np.array_equal(UncalibratedLight(seed).bias(*SHAPE), camera.bias(*SHAPE))
    assert not np.array_equal(UncalibratedLight(seed + 1).bias(*SHAPE), camera.bias(*SHAPE))


@pytest.mark.parametrize('seed', SEEDS)
def test_depth_is_registered_beside_colour(seed):
    """Edges of depth lie 1 to 2 pixels from where the same scene's true depth has them."""
    source = SyntheticSource.from_address(f'synthetic:room?sensor=kinect_measured&seed={seed}')
    shift = source._depth_camera.shift_px
    assert 1 <= np.hypot(*shift) <= 2
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float32)
    steps = np.arange(-2.5, 2.6, 0.5)
    cost = np.zeros((len(steps), len(steps)))
    for index in (0, 60, 160):
        _, stamp_ns = source._stamps_ns(index)
        true_ns = stamp_ns + round(source.colour_depth_offset_ms * 1e6)
        true = source._cast(source.camera, true_ns, color=False).depth_m
        measured = source._depth(index) / (1 + source._depth_camera.bias(*SHAPE))
        for i, dy in enumerate(steps):
            for j, dx in enumerate(steps):
                there = x - np.float32(dx), y - np.float32(dy)
                error = np.abs(cv2.remap(true, *there, cv2.INTER_NEAREST) - measured)
                cost[i, j] += np.minimum(error, 0.1)[measured > 0].mean()
    best = np.unravel_index(cost.argmin(), cost.shape)
    assert np.hypot(steps[best[1]] - shift[0], steps[best[0]] - shift[1]) < 0.8


def test_what_is_dark_far_or_grazing_is_lost():
    """Each of them decides between a full image and an empty one."""

    def share(**properties):
        shot = Shot(0, 0, 4.0)
        depth_m = properties.pop('depth_m', 2.0)
        depth = UncalibratedLight(0).measure(wall(depth_m, 0.0, **properties), CAMERA, shot)
        return (depth > 0).mean()

    assert share(brightness=160.0) > 0.95
    assert share(brightness=20.0) < 0.05
    assert share(brightness=160.0, depth_m=5.0) < 0.05
    assert share(brightness=160.0, cosine=0.17) < 0.05


def test_it_is_tracked_as_a_real_kinect_is():
    assert UncalibratedLight(0).noise.depth_bias == SensorNoise.kinect().depth_bias > 0
