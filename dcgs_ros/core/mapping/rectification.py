# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Undistortion of a frame's images, and its depth moved to the colour's instant."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera import PinholeCamera
from ..frame import RgbdFrame
from ..kernels.jit import kernel

DEPTH_UNIT_M = 5e-4  # of the 16 bits that a depth is stored in
_DEPTH_LIMIT_M = 65535 * DEPTH_UNIT_M
_CRACK = 0.02  # of the depth: if both sides of a gap differ by less, they are one surface


@dataclass(frozen=True)
class Images:
    """Colour and depth of a pinhole camera without distortion."""

    color: NDArray[np.uint8]  # (H, W, 3)
    depth: NDArray[np.uint16]  # (H, W) in units of DEPTH_UNIT_M, 0 = no depth

    @property
    def depth_m(self) -> NDArray[np.float32]:
        """(H, W) metres."""
        return self.depth * np.float32(DEPTH_UNIT_M)


class Rectifier:
    """Removes the distortion of images by resampling; the intrinsics stay the same.

    `valid` (H, W) are the pixels of the undistorted image that the distorted one covers,
    but for the robot's own parts.
    """

    def __init__(self, camera: PinholeCamera, covered: NDArray[np.bool_] | None = None) -> None:
        """Compute the map of pixels, if the camera has distortion.

        `covered` (H, W) are pixels of the distorted image that show the robot itself.
        """
        self._camera = camera
        self._maps: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
        self.valid = np.ones((camera.height, camera.width), np.bool_)
        if covered is not None:
            self.valid = ~covered
        if not any(camera.distortion):
            return
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)]
        pixels = camera.project(np.stack(rays, axis=-1).reshape(-1, 3)).reshape(*u.shape, 2)
        self._maps = np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1])
        limits = np.array([camera.width - 1, camera.height - 1])
        there = np.all((pixels >= 0) & (pixels <= limits), axis=-1)
        valid = cv2.remap(self.valid.astype(np.uint8), *self._maps, cv2.INTER_NEAREST)
        self.valid = there & (valid > 0)

    def __call__(
        self, frame: RgbdFrame, T_cam_cam_at_depth: NDArray[np.float64] | None = None
    ) -> Images:
        """Return the undistorted images, with the depth at the colour's instant.

        Colour is interpolated bilinearly, (0, 0, 0) where the image has none. Each depth pixel is
        a point that `T_cam_cam_at_depth` (4, 4) moves to the camera at the colour's instant and
        that is projected there; the nearest point of each pixel wins.
        """
        color = frame.color
        if color.ndim == 2:
            color = np.repeat(color[..., None], 3, axis=2)
        if self._maps is not None:
            color = np.asarray(cv2.remap(color, *self._maps, cv2.INTER_LINEAR))
        T = np.eye(4) if T_cam_cam_at_depth is None else T_cam_cam_at_depth
        depth_m = np.zeros_like(frame.depth_m)
        rays, intrinsics = self._camera.undistortion_map, self._camera.parameters[:4]
        _reproject(frame.depth_m, rays, T, intrinsics, _DEPTH_LIMIT_M, depth_m)
        if self._maps is not None or T_cam_cam_at_depth is not None:
            depth_m = _without_cracks(depth_m)
        depth = depth_m / np.float32(DEPTH_UNIT_M) + np.float32(0.5)
        return Images(np.ascontiguousarray(color), depth.astype(np.uint16))


@kernel
def _reproject(depth_m, rays, T, intrinsics, limit_m, out):
    """Move the points of a depth image by T and write their depths into `out` (H, W), metres.

    `depth_m` (H, W) metres, `rays` (H, W, 2) undistorted x/z and y/z, `T` (4, 4), `intrinsics`
    (4,) fx fy cx cy, pixels. `out` starts as zeros and has no distortion.
    """
    height, width = out.shape
    for v in range(height):
        for u in range(width):
            z = depth_m[v, u]
            if not 0 < z < limit_m:  # also where it is NaN
                continue
            x, y = rays[v, u, 0] * z, rays[v, u, 1] * z
            there_z = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            if not 0 < there_z < limit_m:
                continue
            there_x = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            there_y = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            to_u = math.floor(intrinsics[0] * there_x / there_z + intrinsics[2] + 0.5)
            to_v = math.floor(intrinsics[1] * there_y / there_z + intrinsics[3] + 0.5)
            if 0 <= to_u < width and 0 <= to_v < height:
                before = out[to_v, to_u]
                if before == 0 or there_z < before:
                    out[to_v, to_u] = there_z


@kernel
def _without_cracks(depth_m):
    """Return a depth image (H, W), metres, with gaps of one pixel in a surface closed.

    Resampling leaves such gaps in `depth_m` (H, W).
    """
    out = depth_m.copy()
    height, width = depth_m.shape
    for axis in range(2):  # where gaps cross, the second pass uses what the first filled
        dv, du = axis, 1 - axis
        for v in range(dv, height - dv):
            for u in range(du, width - du):
                a, b = out[v - dv, u - du], out[v + dv, u + du]
                if out[v, u] == 0 and a > 0 and b > 0 and abs(a - b) < _CRACK * a:
                    out[v, u] = np.float32(0.5) * (a + b)
    return out
