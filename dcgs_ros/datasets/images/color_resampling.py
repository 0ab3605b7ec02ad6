# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Resampling colour images onto the pixels of a coarser depth image beside them."""

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
from .sequence import ColorDepth

_MAX_MISFIT = 4.0  # ratio of the images' fields of view: more means intrinsics of another size


@dataclass(frozen=True)
class ColorResampling:
    """Resamples colour to the depth camera's pixels; an `ImageSequence.register`."""

    depth_camera: PinholeCamera
    color_size: tuple[int, int]  # width and height of the stored images
    scaled_size: tuple[int, int]  # width and height at the depth image's scale
    A_scaled_depth: NDArray[np.float64]  # (2, 3) maps pixels of depth to those of scaled colour
    visible: tuple[slice, slice]  # rows and columns of the depth image that have colour
    T_colorcam_depthcam: NDArray[np.float64] | None  # (4, 4); None for the identity

    def __call__(self, color: NDArray[np.uint8], depth_m: NDArray[np.float32]) -> ColorDepth:
        """Return colour (h, w, 3) and depth (h, w), with depth 0 where there is no colour.

        Raises `FrameError` if colour is of another size.
        """
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
        # Averaged to the scale first, as an interpolation alone would skip pixels.
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
    """Return the resampling that shows colour's pixel K_color K_depth^-1 u at depth's pixel u.

    Depth is first moved by `T_colorcam_depthcam` (4, 4). Raises `SourceError` if the intrinsics do
    not fit the images' sizes.
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
    """Return an axis' scaled size, factor and shift to it, and the depth pixels with colour."""
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
    # The scale is that of the images' edges, half a pixel outside the outermost pixel centres.
    return scaled, factor * scale, (shift + 0.5) * scale - 0.5, slice(first, last + 1)
