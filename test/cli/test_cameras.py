# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""`dcgs run` on what phones, fisheyes and focusing cameras record is as good as on a plain one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip('rosbags')

from bags import (  # type: ignore[import-not-found]
    COLOR,
    Entry,
    depth_entry,
    image_entry,
    info_entry,
    write_bag,
)
from lens_views import rays_of  # type: ignore[import-not-found]
from realsense_bags import pose_entry  # type: ignore[import-not-found]
from running import Run, run_into  # type: ignore[import-not-found]

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.lens_camera import Camera, LensCamera
from dcgs_ros.datasets.images.resampling import resample_color, resample_depth, scaled
from dcgs_ros.datasets.synthetic.source import SyntheticSource
from dcgs_ros.io.ros_images import in_millimetres

pytestmark = pytest.mark.slow

FRAMES = 20
GOOD_CM = 0.6
SOURCE = SyntheticSource.from_address(f'synthetic:room?frames={FRAMES}&sensor=ideal')
PLAIN = SOURCE.camera
FISHEYE = LensCamera(*(640, 480, 610.0, 610.0, 319.5, 239.5), (-0.006, 0.043, -0.041, 0.008), True)
Seen = Callable[[int], tuple[Camera, Camera]]


def zooming(k: int) -> tuple[Camera, Camera]:
    zoom = 1.0 + 0.03 * k / FRAMES
    now = replace(PLAIN, fx=zoom * PLAIN.fx, fy=zoom * PLAIN.fy)
    return now, now


def phone(k: int) -> tuple[Camera, Camera]:
    return scaled(PLAIN, 1280, 960), scaled(PLAIN, 256, 192)


def fisheye(k: int) -> tuple[Camera, Camera]:
    return FISHEYE, FISHEYE


def images(frame: RgbdFrame, color: Camera, depth: Camera) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return colour and depth in metres as two cameras at the place of `PLAIN` see them."""
    if isinstance(color, PinholeCamera) and isinstance(depth, PinholeCamera):
        seen = resample_color(frame.color, PLAIN, color)
        return seen, resample_depth(frame.depth_m, PLAIN, depth)
    rays = rays_of(color).reshape(-1, 2)
    pixels = PLAIN.project(np.column_stack([rays, np.ones(len(rays))])).reshape(480, 640, 2)
    seen = np.asarray(cv2.remap(frame.color, pixels, None, cv2.INTER_LINEAR))
    return seen, np.asarray(cv2.remap(frame.depth_m, pixels, None, cv2.INTER_NEAREST))


def entries(seen: Seen) -> Iterator[Entry]:
    for k, frame in enumerate(SOURCE):
        color, depth = seen(k)
        at, depth_at = frame.stamp_ns, frame.depth_stamp_ns
        yield pose_entry(at, SOURCE.pose(at))
        yield info_entry(at, color)
        rgb, depth_m = images(frame, color, depth)
        yield image_entry(COLOR, at, 'rgb8', rgb)
        yield depth_entry(depth_at, in_millimetres(depth_m))


@pytest.mark.parametrize('seen', [zooming, phone, fisheye])
def test_it_is_tracked_as_well(seen: Seen, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / 'bag', entries(seen))
    run: Run = run_into(tmp_path / 'run', str(bag), '--no-mapping')
    assert run.status == 0, run.err
    report = run.report()
    assert report['tracked'] == FRAMES
    assert report['ate']['rmse_cm'] < GOOD_CM
