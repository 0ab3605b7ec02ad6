# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Simulated structured light: Kinect v1."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from ....core.camera import PinholeCamera
from ....core.sensor import SensorNoise
from ..noise import smoothed, white_noise
from ..raycast import SceneView
from .depth_camera import DEPTH_NOISE, Shot


class StructuredLight:
    """Kinect v1: noise after Nguyen 2012, disparity in 1/8 px, shadows, ragged edges."""

    noise = SensorNoise.structured_light()
    lag_ms = (0.0, 25.0)
    offset_ms = -10.0
    sees_texture = False
    shift_px = (0.0, 0.0)

    def measure(self, view: SceneView, camera: PinholeCamera, shot: Shot) -> NDArray[np.float32]:
        """Measure with a total noise, quantisation included, of 0.0012 + 0.0019 (z - 0.4)^2 m."""
        white = white_noise(shot.seed, shot.index, DEPTH_NOISE, (5, *view.depth_m.shape))
        smooth = np.stack([smoothed(plane, 1.2) for plane in white[1:]])
        window = np.ones((5, 5), np.uint8)
        step = cv2.dilate(view.depth_m, window) - cv2.erode(view.depth_m, window)
        measured = np.empty_like(view.depth_m)
        _structured_light(view.depth_m, view.cosine, step, white[0], smooth, measured)
        return measured


@njit(cache=True, nogil=True, parallel=True)
def _structured_light(
    depth,  # (H, W) metres
    cosine,  # (H, W) between ray and normal
    step,  # (H, W) range of depth over 5x5 pixels, metres
    white,  # (H, W) standard normal
    smooth,  # (4, H, W) standard normal, correlated over 3 pixels: depth, x, y, dropout
    out,  # (H, W) metres, 0 = none
):
    """Write the depth `out` (H, W) that a structured-light camera measures; all are float32."""
    fb = np.float32(580.0 * 0.075)  # pixels times metres
    height, width = depth.shape
    for y in prange(height):
        reach = np.float32(-1e9)
        for x in range(width):
            out[y, x] = 0
            z = depth[y, x]
            if z <= 0:
                continue
            # The projector is beside the camera: a nearer surface to the left shadows the pixels
            # that its disparity spans.
            shift = fb / z + np.float32(x)
            hidden = reach > shift + np.float32(1.0)
            reach = max(reach, shift)
            slant = cosine[y, x]
            grazing = slant < np.float32(0.15) + np.float32(0.06) * smooth[3, y, x]
            edge = step[y, x] > np.float32(0.04) + np.float32(0.03) * z / max(
                slant, np.float32(0.2)
            )
            if hidden or grazing or (edge and smooth[3, y, x] > np.float32(0.7)):
                continue
            if edge:
                row = min(max(y + int(round(smooth[2, y, x])), 0), height - 1)
                column = min(max(x + int(round(smooth[1, y, x])), 0), width - 1)
                z = depth[row, column]
            if z < np.float32(0.4) or z > np.float32(6.0):
                continue
            sigma = np.float32(0.0012) + np.float32(0.0019) * (z - np.float32(0.4)) ** 2
            rounding = z * z / (np.float32(8.0) * fb)
            sigma = math.sqrt(max(sigma * sigma - rounding * rounding / np.float32(12.0), 1e-8))
            mixed = np.float32(0.6) * white[y, x] + np.float32(0.8) * smooth[0, y, x]
            disparity = fb / (z + np.float32(sigma) * mixed)
            z = fb / (np.float32(round(disparity * np.float32(8.0))) / np.float32(8.0))
            out[y, x] = z if z < np.float32(6.5) else np.float32(0.0)
