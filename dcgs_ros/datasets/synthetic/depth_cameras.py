# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Simulated depth cameras: structured light (Kinect v1) and active stereo (D435i)."""

from __future__ import annotations

import math
from typing import Protocol

import cv2
import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from ...core.camera import PinholeCamera
from ...core.sensor import SensorNoise
from .color_camera import LUMA
from .noise import smoothed, white_noise
from .raycast import SceneView

_NOISE_STREAM = 20
_WINDOW = (13, 13)  # 9 pixels of the depth imager


class DepthCamera(Protocol):
    """One kind of depth camera."""

    noise: SensorNoise
    lag_ms: tuple[float, float]  # least and most by which a depth stamp precedes colour's
    offset_ms: float  # true time of depth less its stamp
    sees_texture: bool  # whether `measure` wants the view's radiance

    def measure(
        self, view: SceneView, camera: PinholeCamera, pattern: float, seed: int, index: int
    ) -> NDArray[np.float32]:
        """Return measured depth (H, W) in metres, 0 = none; `pattern` is `Scenario.pattern`."""
        ...


class IdealDepth:
    """True depth at the instant of colour."""

    noise = SensorNoise.floor(0.001)
    lag_ms = (0.0, 0.0)
    offset_ms = 0.0
    sees_texture = False

    def measure(
        self, view: SceneView, camera: PinholeCamera, pattern: float, seed: int, index: int
    ) -> NDArray[np.float32]:
        """Return the true depth."""
        return view.depth_m


class StructuredLight:
    """Kinect v1: noise after Nguyen 2012, disparity in 1/8 px, shadows, ragged edges."""

    noise = SensorNoise.structured_light()
    lag_ms = (0.0, 25.0)
    offset_ms = -10.0
    sees_texture = False

    def measure(
        self, view: SceneView, camera: PinholeCamera, pattern: float, seed: int, index: int
    ) -> NDArray[np.float32]:
        """Measure with a total noise, quantisation included, of 0.0012 + 0.0019 (z - 0.4)^2 m."""
        white = white_noise(seed, index, _NOISE_STREAM, (5, *view.depth_m.shape))
        smooth = np.stack([smoothed(plane, 1.2) for plane in white[1:]])
        window = np.ones((5, 5), np.uint8)
        step = cv2.dilate(view.depth_m, window) - cv2.erode(view.depth_m, window)
        measured = np.empty_like(view.depth_m)
        _structured_light(view.depth_m, view.cosine, step, white[0], smooth, measured)
        return measured


class ActiveStereo:
    """D435i: window matching with correlated noise, fattened edges, holes without texture."""

    depth_focal_px = 385.0
    baseline_m = 0.05
    subpixel_px = 0.08
    noise = SensorNoise.stereo(depth_focal_px, baseline_m, subpixel_px)
    lag_ms = (2.0, 18.0)
    offset_ms = 6.0
    sees_texture = True

    def measure(
        self, view: SceneView, camera: PinholeCamera, pattern: float, seed: int, index: int
    ) -> NDArray[np.float32]:
        """Match by a window that prefers the nearer surface and needs contrast to match."""
        white = white_noise(seed, index, _NOISE_STREAM, (3, *view.depth_m.shape))
        disparity_blobs = smoothed(white[1], 2.4)
        flicker = smoothed(white[2], 4.0)
        contrast, brightness = _local_texture(view.radiance)
        nearer = np.stack([cv2.erode(view.depth_m, np.ones((k, k), np.uint8)) for k in (7, 11)])
        measured = np.empty_like(view.depth_m)
        _active_stereo(
            view.depth_m,
            view.cosine,
            nearer,
            contrast,
            brightness,
            np.float32(pattern),
            white[0],
            disparity_blobs,
            flicker,
            np.float32(self.depth_focal_px * self.baseline_m),
            np.float32(self.subpixel_px),
            np.float32(camera.focal / self.depth_focal_px),
            measured,
        )
        return measured


def _local_texture(
    radiance: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return deviation and mean (H, W) of grey levels over the matching window of 13 pixels."""
    luma = cv2.transform(radiance, LUMA[None])
    mean = cv2.boxFilter(luma, -1, _WINDOW)
    square = cv2.sqrBoxFilter(luma, cv2.CV_32F, _WINDOW)
    return np.sqrt(np.maximum(square - mean * mean, 0)), mean


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
