# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Simulated colour camera: lens, motion blur and noise."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from ....core.camera import PinholeCamera
from ..noise import white_noise
from ..raycast import SceneView
from .exposure import Exposure

LUMA = np.array([0.299, 0.587, 0.114], np.float32)
_NOISE_STREAM = 10
_LENS_SIGMA_PX = 0.5  # also smooths the ray caster's aliased silhouettes


def through_lens(radiance: NDArray[np.float32]) -> NDArray[np.float32]:
    """Blur (H, W, 3) by the lens' point spread function."""
    return cv2.GaussianBlur(radiance, (3, 3), _LENS_SIGMA_PX)


def ideal_image(view: SceneView) -> NDArray[np.uint8]:
    """Return RGB (H, W, 3) without blur, noise or gain."""
    return np.minimum(view.radiance + np.float32(0.5), np.float32(255)).astype(np.uint8)


def expose(
    view: SceneView,
    camera: PinholeCamera,
    T_later_now: NDArray[np.float64],
    exposure: Exposure,
    seed: int,
    index: int,
) -> NDArray[np.uint8]:
    """Return an RGB image (H, W, 3) with motion blur, gain and noise.

    `T_later_now` (4, 4) maps the camera's frame at the middle of the exposure to that at its end.
    The image is averaged along each pixel's path to its place at the end, and equally far back.
    """
    height, width = view.depth_m.shape
    noise = white_noise(seed, index, _NOISE_STREAM, (3, height, width))
    image = np.empty((height, width, 3), np.uint8)
    intrinsics = camera.parameters[:4].astype(np.float32)
    motion = T_later_now[:3].astype(np.float32)
    _expose(
        view.radiance,
        view.depth_m,
        intrinsics,
        motion,
        np.float32(exposure.light),
        np.float32(exposure.gain),
        exposure.most_taps,
        noise,
        image,
    )
    return image


# Without fast-math: the compiler may then neither reorder nor fuse operations, which it did in one
# way in the process that compiles the kernels and in another for those that load them.
@njit(cache=True, nogil=True, error_model='numpy')
def _displacement(x, y, z, intrinsics, motion):
    """Return by how many pixels the point at pixel (x, y), depth z m, moves until the end.

    `intrinsics` (4,) fx fy cx cy and `motion` (3, 4), both float32, are those of `_expose`.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    px, py = (x - cx) / fx * z, (y - cy) / fy * z
    qx = motion[0, 0] * px + motion[0, 1] * py + motion[0, 2] * z + motion[0, 3]
    qy = motion[1, 0] * px + motion[1, 1] * py + motion[1, 2] * z + motion[1, 3]
    qz = motion[2, 0] * px + motion[2, 1] * py + motion[2, 2] * z + motion[2, 3]
    inverse = np.float32(1.0) / max(qz, np.float32(0.05))
    return fx * qx * inverse + cx - x, fy * qy * inverse + cy - y


@njit(cache=True, nogil=True, error_model='numpy', parallel=True)
def _expose(
    radiance,  # (H, W, 3) grey levels
    depth,  # (H, W) metres
    intrinsics,  # (4,) fx fy cx cy
    motion,  # (3, 4) T_later_now
    light,  # collected, per unit of radiance
    gain,  # by which it is amplified
    most_taps,  # integer
    noise,  # (3, H, W) standard normal
    image,  # (H, W, 3) uint8 out
):
    """Write `image`, blurred along the motion, amplified and noisy; all else is float32."""
    height, width = depth.shape
    for y in prange(height):
        total = np.empty(3, np.float32)
        for x in range(width):
            z = depth[y, x] if depth[y, x] > 0 else np.float32(10.0)
            dx, dy = _displacement(np.float32(x), np.float32(y), z, intrinsics, motion)
            # One tap per 1.5 pixels of motion, which the lens' blur covers.
            taps = min(most_taps, 1 + int(np.float32(1.34) * math.sqrt(dx * dx + dy * dy)))
            total[0] = total[1] = total[2] = np.float32(0.0)
            for k in range(taps):
                share = np.float32((2 * k + 1 - taps) / taps)
                u = min(max(x + share * dx, np.float32(0.0)), np.float32(width - 1.01))
                v = min(max(y + share * dy, np.float32(0.0)), np.float32(height - 1.01))
                u0, v0 = int(u), int(v)
                fu, fv = np.float32(u - u0), np.float32(v - v0)
                gu, gv = np.float32(1.0) - fu, np.float32(1.0) - fv
                for c in range(3):
                    top = gu * radiance[v0, u0, c] + fu * radiance[v0, u0 + 1, c]
                    low = gu * radiance[v0 + 1, u0, c] + fu * radiance[v0 + 1, u0 + 1, c]
                    total[c] += gv * top + fv * low
            for c in range(3):
                level = gain * (light * total[c] / np.float32(taps))
                # Read noise of 1.2 grey levels and shot noise, both amplified.
                variance = gain * (np.float32(1.44) * gain + np.float32(0.02) * level)
                level += math.sqrt(variance) * noise[c, y, x] + np.float32(0.5)
                image[y, x, c] = np.uint8(min(max(level, np.float32(0.0)), np.float32(255.0)))
