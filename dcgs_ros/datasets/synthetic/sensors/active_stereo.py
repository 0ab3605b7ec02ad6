# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Simulated active stereo: D435i."""

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
from .color_camera import LUMA
from .depth_camera import DEPTH_NOISE, Shot

_WINDOW = (13, 13)  # 9 pixels of the depth imager


class ActiveStereo:
    """D435i: window matching with correlated noise, fattened edges, holes without texture."""

    depth_focal_px = 385.0
    baseline_m = 0.05
    subpixel_px = 0.08
    noise = SensorNoise.stereo(depth_focal_px, baseline_m, subpixel_px)
    lag_ms = (2.0, 18.0)
    offset_ms = 6.0
    sees_texture = True
    shift_px = (0.0, 0.0)

    def measure(self, view: SceneView, camera: PinholeCamera, shot: Shot) -> NDArray[np.float32]:
        """Match by a window that prefers the nearer surface and needs contrast to match."""
        white = white_noise(shot.seed, shot.index, DEPTH_NOISE, (3, *view.depth_m.shape))
        disparity_blobs = smoothed(white[1], 2.4)
        flicker = smoothed(white[2], 4.0)
        contrast, brightness = local_texture(view.radiance)
        nearer = np.stack([cv2.erode(view.depth_m, np.ones((k, k), np.uint8)) for k in (7, 11)])
        measured = np.empty_like(view.depth_m)
        _active_stereo(
            view.depth_m,
            view.cosine,
            nearer,
            contrast,
            brightness,
            np.float32(shot.pattern),
            white[0],
            disparity_blobs,
            flicker,
            np.float32(self.depth_focal_px * self.baseline_m),
            np.float32(self.subpixel_px),
            np.float32(camera.focal / self.depth_focal_px),
            measured,
        )
        return measured


def local_texture(
    radiance: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return deviation and mean (H, W) of grey levels over the matching window of 13 pixels."""
    luma = cv2.transform(radiance, LUMA[None])
    mean = cv2.boxFilter(luma, -1, _WINDOW)
    square = cv2.sqrBoxFilter(luma, cv2.CV_32F, _WINDOW)
    return np.sqrt(np.maximum(square - mean * mean, 0)), mean


@njit(cache=True, nogil=True, parallel=True)
def _active_stereo(
    depth,  # (H, W) metres
    cosine,  # (H, W) between ray and normal
    nearer,  # (2, H, W) least depth over two matching windows, metres
    contrast,  # (H, W) grey levels
    brightness,  # (H, W) grey levels
    pattern,  # contrast of the projected dots on white at 1 m, grey levels
    white,  # (H, W) standard normal
    blobs,  # (H, W) standard normal, correlated over the matching window
    flicker,  # (H, W) standard normal, wider blobs
    fb,  # focal length times baseline of the depth imagers, pixels times metres
    subpixel,  # sigma of the disparity, pixels
    zoom,  # pixels of the image per pixel of the depth imagers
    out,  # (H, W) metres, 0 = none
):
    """Write the depth `out` (H, W) that an active stereo camera measures; all are float32."""
    height, width = depth.shape
    for y in prange(height):
        reach = np.float32(-1e9)
        for x in range(width):
            out[y, x] = 0
            z = depth[y, x]
            if z <= 0:
                continue
            # The window matches at the nearer surface's disparity: objects grow by half a window.
            front = nearer[0 if flicker[y, x] < 0 else 1, y, x]
            fattened = front > 0 and fb / front - fb / z > np.float32(1.0)
            if fattened:
                z = front
            shift = zoom * fb / z + np.float32(x)
            hidden = reach > shift + np.float32(1.0) and not fattened
            reach = max(reach, shift)
            dots = pattern * brightness[y, x] / np.float32(200.0) * cosine[y, x] / (z * z)
            # Texture must exceed the imagers' own noise, which is worse in the dark.
            grain = np.float32(2.0) + np.float32(60.0) / (brightness[y, x] + np.float32(10.0))
            quality = math.log((contrast[y, x] + dots) / grain + np.float32(1e-3))
            margin = np.float32(quality) + np.float32(0.35) * flicker[y, x]
            if hidden or margin < 0 or z < np.float32(0.28):
                continue
            sigma = subpixel * max(np.float32(0.9), np.float32(1.8) - np.float32(0.6) * margin)
            if z > np.float32(4.0):
                sigma *= np.float32(3.0)
            error = sigma * (np.float32(0.95) * blobs[y, x] + np.float32(0.31) * white[y, x])
            if margin < np.float32(0.06):  # a wrong match
                error += np.float32(1.5) * blobs[y, x]
            disparity = fb / z + error
            disparity = np.float32(round(disparity * np.float32(32.0))) / np.float32(32.0)
            if disparity * np.float32(10.0) < fb:
                continue
            out[y, x] = np.float32(round(fb / disparity * np.float32(1000.0))) * np.float32(0.001)
