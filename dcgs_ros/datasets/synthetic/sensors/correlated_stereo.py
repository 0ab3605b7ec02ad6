# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Simulated active stereo with the errors that a real D435i was measured to have."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from ....core.camera import PinholeCamera
from ...camera_presets import PRESETS
from ..noise import smoothed, white_noise
from ..raycast import SceneView
from .active_stereo import ActiveStereo, local_texture
from .depth_camera import DEPTH_NOISE, Shot
from .disparity_noise import disparity_noise

_NEAREST_M, _FARTHEST_M = 0.28, 10.0
_IMAGER_BASELINE = ActiveStereo.depth_focal_px * ActiveStereo.baseline_m  # pixels times metres
_LONGER = 4.0  # exposure of the imagers in dim light: then shot noise is what light costs
_GRAZING = 0.17  # cosine, 80 degrees from the normal
_WRONG_MATCH = 12.0  # times the noise, where a match is all but refused


class CorrelatedStereo:
    """D435i as measured: noise that neighbours share, holes by texture, light and angle."""

    noise = PRESETS['d435i'].sensor  # what the product takes a D435i for
    lag_ms = ActiveStereo.lag_ms
    offset_ms = ActiveStereo.offset_ms
    sees_texture = True
    shift_px = (0.0, 0.0)

    def measure(self, view: SceneView, camera: PinholeCamera, shot: Shot) -> NDArray[np.float32]:
        """Match by a window that prefers the nearer surface; disparity errs by the same anywhere.

        Matching needs contrast, of texture in the ambient light or of the projected dots, above
        the imagers' noise. Whole millimetres, as the camera sends them.
        """
        shape = (view.depth_m.shape[0], view.depth_m.shape[1])
        flicker = smoothed(white_noise(shot.seed, shot.index, DEPTH_NOISE, (1, *shape))[0], 4.0)
        z, seen = _matched(view.depth_m, flicker, camera.focal)
        margin = _margin(view, z, shot) + np.float32(0.35) * flicker
        seen &= (margin > 0) & (view.cosine > _GRAZING + np.float32(0.05) * flicker)
        error = disparity_noise(shot.seed, shot.index, shot.travel_px, shape)
        error[margin < np.float32(0.06)] *= np.float32(_WRONG_MATCH)
        focal_baseline = np.float32(camera.focal * ActiveStereo.baseline_m)
        disparity = focal_baseline / np.where(seen, z, np.float32(1.0)) + error
        millimetres = np.round(focal_baseline / disparity * np.float32(1000.0))
        seen &= (disparity * np.float32(_FARTHEST_M) > focal_baseline) & (z > _NEAREST_M)
        return np.where(seen, millimetres * np.float32(0.001), np.float32(0.0))


def _matched(
    depth_m: NDArray[np.float32], flicker: NDArray[np.float32], focal_px: float
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the depth (H, W) of the surface that a window matches, and where both imagers see it.

    Objects grow by half a window; what they hide from the second imager is not seen.
    """
    near = [cv2.erode(depth_m, np.ones((k, k), np.uint8)) for k in (7, 11)]
    front = np.where(flicker < 0, *near)
    seen = front > 0
    front, back = (np.where(seen, plane, np.float32(1.0)) for plane in (front, depth_m))
    baseline = np.float32(_IMAGER_BASELINE)
    fattened = baseline / front - baseline / back > 1
    z = np.where(fattened, front, back)
    zoom = np.float32(focal_px / ActiveStereo.depth_focal_px)
    shift = zoom * baseline / z + np.arange(z.shape[1], dtype=np.float32)
    reach = np.maximum.accumulate(shift, axis=1)
    seen[:, 1:] &= (reach[:, :-1] <= shift[:, 1:] + 1) | fattened[:, 1:]
    return z, seen


def _margin(view: SceneView, z: NDArray[np.float32], shot: Shot) -> NDArray[np.float32]:
    """Return the logarithm (H, W) of contrast to the imagers' noise; matching needs 0."""
    contrast, brightness = local_texture(view.radiance)
    ambient = np.float32(math.sqrt(min(1.0, _LONGER * shot.light)))
    dots = np.float32(shot.pattern / 200) * brightness * view.cosine / (z * z)
    grain = np.float32(2.0) + np.float32(60.0) / (ambient * brightness + np.float32(10.0))
    margin: NDArray[np.float32] = np.log((ambient * contrast + dots) / grain + np.float32(1e-3))
    return margin
