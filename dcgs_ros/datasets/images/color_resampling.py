# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Colour images on the pixels of a coarser depth image, both seen from one place."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.camera import PinholeCamera
from ...core.errors import FrameError
from ..source import SourceError
from .depth_registration import register_depth
from .sequence import Images

_MAX_MISFIT = 4.0  # of the images' sizes at one scale: beyond, the intrinsics are of another size


@dataclass(frozen=True)
class ColorResampling:
    """A step for `ImageSequence.register`: colour as a camera like the depth camera sees it."""

    depth_camera: PinholeCamera
    color_size: tuple[int, int]  # width and height as stored
    scaled_size: tuple[int, int]  # the same at the depth image's scale
    A_scaled_depth: NDArray[np.float64]  # (2, 3) pixels of depth to those of the scaled colour
    visible: tuple[slice, slice]  # rows and columns of the depth image that have colour
    T_colorcam_depthcam: NDArray[np.float64] | None  # (4, 4); None for the identity

    def __call__(self, color: NDArray[np.uint8], depth_m: NDArray[np.float32]) -> Images:
        """Colour (h, w, 3) and depth (h, w), which ends where colour does; or `FrameError`."""
        if (found := (color.shape[1], color.shape[0])) != self.color_size:
            raise FrameError(
                f'colour is {found[0]}x{found[1]} pixels, '
                f'the other images are {self.color_size[0]}x{self.color_size[1]}'
            )
        camera = self.depth_camera
        if self.T_colorcam_depthcam is not None:
            depth_m = register_depth(depth_m, camera, self.T_colorcam_depthcam, camera)
        colored = np.zeros_like(depth_m)
        colored[self.visible] = depth_m[self.visible]
        # Averaged to the scale first: an interpolation alone would skip pixels.
        scaled = cv2.resize(color, self.scaled_size, interpolation=cv2.INTER_AREA)
        resampled = cv2.warpAffine(
            scaled,
            self.A_scaled_depth,
            (camera.width, camera.height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        return resampled.astype(np.uint8, copy=False), colored


def color_resampling(
    color_camera: PinholeCamera,
    depth_camera: PinholeCamera,
    T_colorcam_depthcam: NDArray[np.float64],
) -> ColorResampling:
    """Resample colour so that the pixel u of depth shows K_color K_depth^-1 u.

    Raises `SourceError` where the two cameras' scales and sizes do not belong together.
    """
    color, depth = color_camera, depth_camera
    across = _axis(color.width, color.fx, color.cx, depth.width, depth.fx, depth.cx)
    down = _axis(color.height, color.fy, color.cy, depth.height, depth.fy, depth.cy)
    moved = not np.array_equal(T_colorcam_depthcam, np.eye(4))
    return ColorResampling(
        depth,
        (color.width, color.height),
        (across[0], down[0]),
        np.array([[across[1], 0.0, across[2]], [0.0, down[1], down[2]]]),
        (down[3], across[3]),
        T_colorcam_depthcam if moved else None,
    )


def _axis(
    size: int,
    focal: float,
    center: float,
    depth_size: int,
    depth_focal: float,
    depth_center: float,
) -> tuple[int, float, float, slice]:
    """Along one axis: the scaled size, factor and shift to it, and depth pixels with colour."""
    factor = focal / depth_focal
    shift = center - factor * depth_center
    misfit = size / (factor * depth_size)
    first = max(0, math.ceil((-0.5 - shift) / factor))
    last = min(depth_size - 1, math.floor((size - 0.5 - shift) / factor))
    if not (1 / _MAX_MISFIT <= misfit <= _MAX_MISFIT and first <= last):
        raise SourceError(
            f'colour of {size} pixels with focal length {focal:.6g} and centre {center:.6g} does '
            f'not show what depth of {depth_size} pixels with {depth_focal:.6g} and '
            f'{depth_center:.6g} does'
        )
    scaled = max(1, round(size / factor))
    scale = scaled / size
    # Sizes scale the images' edges, which lie half a pixel outside the first and last centre.
    return scaled, factor * scale, (shift + 0.5) * scale - 0.5, slice(first, last + 1)
