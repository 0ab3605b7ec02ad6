# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Compiles the kernels, or loads them, before the first frame has to wait for it."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera import PinholeCamera
from ..config.schema import override
from ..config.stages import Config
from ..frame import RgbdFrame
from ..sensor import SensorNoise
from .depth_bias import TERMS, DepthBias
from .tracker import Tracker

_FRAMES = 4
_FRAME_NS = 33_333_333
_DEPTH_LAG_NS = 5_000_000  # unequal stamps: the first frame is opened twice then
_STEP_M = 0.004  # sideways, a frame
_DISTANCE_M = 1.2  # to the plane, where the sensor reaches so far
_NORMAL = np.array([0.28, 0.2, 0.94])  # of the plane, camera frame
_TEXELS_PER_M = 400.0
EVERY_FRAME = {
    'keyframes.translation_m': 1e-6,
    'keyframes.rotation_rad': 1e-6,
    'keyframes.min_interval_s': 0.0,
}


# Kernels are compiled for types, not for sizes: a node need not wait for its camera.
ANY_CAMERA = PinholeCamera(640, 480, 525.0, 525.0, 319.5, 239.5, (0.01, 0.0, 0.0, 0.0, 0.0))


def warm_up(camera: PinholeCamera, config: Config) -> None:
    """Track a few frames of a textured, slanted plane as `config` says, all of them keyframes.

    Every kernel of `Tracker.track` and `Tracker.correct` has run afterwards with the types it will
    see, and the camera's undistortion map is computed. Takes a fraction of a second once the
    kernels are in the cache on disk, a minute or so where they have to be compiled.
    """
    tracker = Tracker(camera, override(config, EVERY_FRAME))
    for frame in frames(camera, config.sensor):
        tracker.track(frame)
    warm_up_now_and_then(tracker)


def warm_up_now_and_then(tracker: Tracker) -> None:
    """Run the kernels that a few frames do not come to; the tracker has a keyframe."""
    tracker.correct(tracker.corrected_poses)
    DepthBias(tracker.camera, 0.0).correct_by(np.zeros(TERMS))


def frames(camera: PinholeCamera, sensor: SensorNoise) -> Iterator[RgbdFrame]:
    """Yield a few frames of the plane."""
    texture = _texture()
    for index in range(_FRAMES):
        yield _frame(camera, sensor, texture, index)


def _frame(
    camera: PinholeCamera, sensor: SensorNoise, texture: NDArray[np.uint8], index: int
) -> RgbdFrame:
    """See the plane n . X = d from (index * step, 0, 0) without turning."""
    shift_m = index * _STEP_M
    distance_m = float(np.clip(_DISTANCE_M, 1.2 * sensor.depth_min_m, 0.8 * sensor.depth_max_m))
    rays = camera.undistortion_map
    facing = rays @ _NORMAL[:2].astype(np.float32) + np.float32(_NORMAL[2])
    depth_m = (distance_m - _NORMAL[0] * shift_m) / np.maximum(facing, 0.1)
    texels = [_TEXELS_PER_M * (rays[..., 0] * depth_m + shift_m)]
    texels.append(_TEXELS_PER_M * rays[..., 1] * depth_m)
    u, v = (np.mod(t, texture.shape[0]).astype(np.float32) for t in texels)
    grey = cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    stamp_ns = (index + 1) * _FRAME_NS
    color = np.repeat(np.asarray(grey, np.uint8)[..., None], 3, axis=2)
    return RgbdFrame(stamp_ns, stamp_ns - _DEPTH_LAG_NS, color, depth_m.astype(np.float32))


def _texture() -> NDArray[np.uint8]:
    """Blobs of random grey a few pixels wide: corners everywhere, gradients without steps."""
    coarse = np.random.default_rng(0).integers(0, 256, (64, 64), dtype=np.uint8)
    return np.asarray(cv2.resize(coarse, (1024, 1024), interpolation=cv2.INTER_LINEAR), np.uint8)
