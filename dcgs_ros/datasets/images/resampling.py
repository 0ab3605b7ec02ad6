# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Images of one camera as another one at the same place would take them."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.camera import PinholeCamera
from ...core.errors import FrameError
from ...core.kernels.jit import strict_kernel
from ...core.lens_camera import Camera

NOISE_PX = 0.1  # intrinsics that move no pixel farther are the same
_AVERAGED = 1.25  # pixels of the source on one of the target, from which on they are averaged
_ONE_SURFACE = 0.05  # of the depth: neighbours that differ by less are interpolated between

AnyCamera = TypeVar('AnyCamera', PinholeCamera, Camera)


def resample_color(
    color: NDArray[np.uint8], source: Camera, target: PinholeCamera
) -> NDArray[np.uint8]:
    """Return colour (h, w[, 3]) of `source` as `target` sees it, unchanged if that is the same.

    Raises `FrameError` if it is not of the source's size.
    """
    _check_size('colour', color, source)
    if target.fx * _AVERAGED < source.fx:  # an interpolation alone would skip pixels
        factor = target.fx / source.fx
        size = round(source.width * factor), round(source.height * factor)
        color = np.asarray(cv2.resize(color, size, interpolation=cv2.INTER_AREA), np.uint8)
        source = scaled(source, *size)
    if is_same(source, target):
        return color
    u, v = _pixels(source, target)
    resampled = cv2.remap(color, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(resampled, np.uint8)


def resample_depth(
    depth_m: NDArray[np.float32], source: Camera, target: PinholeCamera
) -> NDArray[np.float32]:
    """Return depth (h, w) in metres of `source` as `target` sees it, unchanged if it is the same.

    Within a surface inverse depth, linear on a plane, is interpolated; elsewhere the nearest pixel
    counts. 0 = no measurement. Raises `FrameError` if depth is not of the source's size.
    """
    _check_size('depth', depth_m, source)
    if is_same(source, target):
        return depth_m
    out = np.zeros((target.height, target.width), np.float32)
    _interpolate(np.ascontiguousarray(depth_m, np.float32), *_pixels(source, target), out)
    return out


def scaled(camera: AnyCamera, width: int, height: int) -> AnyCamera:
    """Return the camera whose images are the same ones at another size."""
    if (width, height) == (camera.width, camera.height):
        return camera
    x, y = width / camera.width, height / camera.height
    # The images' edges coincide, half a pixel outside the outermost pixels' centres.
    return replace(
        camera, width=width, height=height, fx=x * camera.fx, fy=y * camera.fy,
        cx=x * (camera.cx + 0.5) - 0.5, cy=y * (camera.cy + 0.5) - 0.5,
    )  # fmt: skip


def moved_px(one: Camera, other: Camera) -> float:
    """Return how far apart two cameras of one size show what is seen at the image's border."""
    u, v = np.meshgrid(*(np.linspace(0.0, size - 1, 3) for size in (one.width, one.height)))
    rays = np.stack([(u - one.cx) / one.fx, (v - one.cy) / one.fy, np.ones(u.shape)], axis=-1)
    apart = one.project(rays.reshape(-1, 3)) - other.project(rays.reshape(-1, 3))
    return float(np.nan_to_num(np.abs(apart).max(), nan=np.inf))


@lru_cache(maxsize=8)
def is_same(source: Camera, target: Camera) -> bool:
    """Return whether both show everything at the same pixels, but for noise of the intrinsics."""
    sizes = (source.width, source.height) == (target.width, target.height)
    return sizes and (source == target or moved_px(source, target) < NOISE_PX)


@lru_cache(maxsize=4)
def _pixels(source: Camera, target: PinholeCamera) -> tuple[NDArray[np.float32], ...]:
    """Return where the source shows what the target shows at each pixel: u and v (H, W)."""
    pixels, shape = source.project(_rays(target)), (target.height, target.width)
    return tuple(np.ascontiguousarray(pixels[:, axis]).reshape(shape) for axis in (0, 1))


@lru_cache(maxsize=2)
def _rays(target: PinholeCamera) -> NDArray[np.float64]:
    """Return points (H * W, 3), z = 1, on the rays through all pixels."""
    rays = target.undistortion_map.reshape(-1, 2)
    return np.column_stack([rays, np.ones(len(rays))]).astype(np.float64)


def _check_size(what: str, image: NDArray[np.generic], camera: Camera) -> None:
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise FrameError(
            f"{what} is {width}x{height} pixels, but the camera's images are "
            f'{camera.width}x{camera.height}'
        )


@strict_kernel
def _interpolate(depth_m, u, v, out):
    """Write depth (h, w), metres, at the pixels `u`, `v` (H, W) into `out` (H, W), zeros before.

    Between four pixels of one surface inverse depth is interpolated, else the nearest is taken.
    """
    height, width = depth_m.shape
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            x, y = u[row, column], v[row, column]
            if not (-0.5 <= x < width - 0.5 and -0.5 <= y < height - 0.5):
                continue
            nearest = depth_m[int(y + 0.5), int(x + 0.5)]
            if not 0.0 < nearest < np.inf:
                continue
            left, top = int(min(max(x, 0.0), width - 2.0)), int(min(max(y, 0.0), height - 2.0))
            right, low = x - left, y - top
            least, most, inverse = np.inf, 0.0, 0.0
            for corner in range(4):
                across, down = corner % 2, corner // 2
                z = depth_m[top + down, left + across]
                least, most = min(least, z), max(most, z)
                if z > 0.0:
                    weight = (right if across else 1.0 - right) * (low if down else 1.0 - low)
                    inverse += weight / z
            one_surface = least > 0.0 and most - least < _ONE_SURFACE * nearest
            out[row, column] = np.float32(1.0 / inverse) if one_surface else nearest
