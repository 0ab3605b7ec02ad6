# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What faults do to the images of one frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.sensor import SensorNoise

_WALL_M, _WALL_TILT_RAD = 1.0, 0.25
_BLOCK_M = 0.03  # side of the squares of a wall's texture
_BOX_M, _BOX_SLOPE_M = 0.55, 0.1  # depth of a box at its middle, and its change to either side
_BOX_SIDES = (0.4, 0.83)  # of the image's width and height: a third of its area
_BOX_PERIOD_S = 2.0
_SQUARES_PX = 16  # side of the squares of a box's texture
_HOLE_PX = 24  # about the size of a hole
_NOISE_GREY = 2.0
_GREY = 150


@dataclass(frozen=True)
class Images:
    """The images of one frame."""

    color: NDArray[np.uint8]  # (H, W, 3) or (H, W)
    depth_m: NDArray[np.float32]  # (H, W)


@dataclass(frozen=True)
class Window:
    """A sequence, and the frames of it that a fault changes: from `begin` until before `end`."""

    images: Sequence[Images]
    T_world_cam: Sequence[NDArray[np.float64]]  # (4, 4) each, true
    times_s: NDArray[np.float64]  # (N,)
    camera: PinholeCamera
    sensor: SensorNoise
    begin: int
    end: int


Change = Callable[[Window, int, np.random.Generator], Images]  # of one frame, with its random bits


def lens_covered(window: Window, k: int, rng: np.random.Generator) -> Images:
    """Return black colour, and noise near the camera in 5 % of the depth image."""
    depth_m = rng.uniform(0.3, 0.5, window.images[k].depth_m.shape).astype(np.float32)
    depth_m[rng.random(depth_m.shape) >= 0.05] = 0.0
    return Images(color_black(window, k, rng).color, depth_m)


def color_black(window: Window, k: int, rng: np.random.Generator) -> Images:
    """Return black colour with a little noise."""
    color = rng.integers(0, 4, window.images[k].color.shape, np.uint8)
    return replace(window.images[k], color=color)


def depth_zero(window: Window, k: int, rng: np.random.Generator) -> Images:
    """Return no depth."""
    return replace(window.images[k], depth_m=np.zeros_like(window.images[k].depth_m))


def depth_almost_zero(window: Window, k: int, rng: np.random.Generator) -> Images:
    """Return the depth of 50 pixels."""
    depth_m = window.images[k].depth_m
    chosen = rng.choice(np.flatnonzero(depth_m > 0), 50, replace=False)
    left = np.zeros_like(depth_m)
    left.flat[chosen] = depth_m.flat[chosen]
    return replace(window.images[k], depth_m=left)


def depth_scaled(factor: float) -> Change:
    """Return the fault of a wrong scale."""

    def change(window: Window, k: int, rng: np.random.Generator) -> Images:
        images = window.images[k]
        return replace(images, depth_m=images.depth_m * np.float32(factor))

    return change


def holes(window: Window, k: int, rng: np.random.Generator) -> Images:
    """Return depth without half of its pixels, in patches that change from frame to frame."""
    images = window.images[k]
    height, width = images.depth_m.shape
    small = rng.standard_normal((height // _HOLE_PX, width // _HOLE_PX)).astype(np.float32)
    smooth = cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
    kept = smooth > np.median(smooth)
    return replace(images, depth_m=np.where(kept, images.depth_m, np.float32(0)))


def depth_not_finite(window: Window, k: int, rng: np.random.Generator) -> Images:
    """Return depth of which a fifth is no number, infinite or negative."""
    depth_m = window.images[k].depth_m.copy()
    bad = rng.random(depth_m.shape) < 0.2
    values = np.array([np.nan, np.inf, -np.inf, -1.0], np.float32)
    depth_m[bad] = rng.choice(values, int(bad.sum()))
    return replace(window.images[k], depth_m=depth_m)


def salt_and_pepper(window: Window, k: int, rng: np.random.Generator) -> Images:
    """Return colour of which a fifth is black or white."""
    color = window.images[k].color.copy()
    bad = rng.random(color.shape[:2])
    color[bad < 0.1] = 0
    color[bad > 0.9] = 255
    return replace(window.images[k], color=color)


def depth_outliers(window: Window, k: int, rng: np.random.Generator) -> Images:
    """Return depth of which a fifth is arbitrary."""
    depth_m = window.images[k].depth_m.copy()
    bad = rng.random(depth_m.shape) < 0.2
    depth_m[bad] = rng.uniform(0.0, window.sensor.depth_max_m, int(bad.sum()))
    return replace(window.images[k], depth_m=depth_m)


def _third(shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Return the middle of the image's three columns."""
    return slice(None), slice(shape[1] // 3, 2 * shape[1] // 3)


def dead_block(window: Window, k: int, rng: np.random.Generator) -> Images:
    """Return no depth in a third of the image."""
    depth_m = window.images[k].depth_m.copy()
    depth_m[_third(depth_m.shape)] = 0.0
    return replace(window.images[k], depth_m=depth_m)


def stuck_block(window: Window, k: int, rng: np.random.Generator) -> Images:
    """Return depth of which a third is that of the last frame before the fault."""
    depth_m = window.images[k].depth_m.copy()
    block = _third(depth_m.shape)
    depth_m[block] = window.images[window.begin - 1].depth_m[block]
    return replace(window.images[k], depth_m=depth_m)


def frozen(window: Window, k: int, rng: np.random.Generator) -> Images:
    """Return the last images before the fault."""
    return window.images[window.begin - 1]


def blurred(window: Window, k: int, rng: np.random.Generator) -> Images:
    """Return colour that is blurred over 25 pixels of a row."""
    images = window.images[k]
    return replace(images, color=np.asarray(cv2.blur(images.color, (25, 1)), np.uint8))


def exposed(factor: float) -> Change:
    """Return the fault of another exposure."""
    levels = np.clip(np.arange(256) * factor + 0.5, 0, 255).astype(np.uint8)

    def change(window: Window, k: int, rng: np.random.Generator) -> Images:
        return replace(window.images[k], color=levels[window.images[k].color])

    return change


def wall(textured: bool) -> Change:
    """Return the fault of a wall that stands still before the camera, and hides everything."""

    def change(window: Window, k: int, rng: np.random.Generator) -> Images:
        T_wall_cam = _T_wall_world(window) @ window.T_world_cam[k]
        depth_m, across = _plane_seen(T_wall_cam, window.camera)
        level = np.full(depth_m.shape, _GREY, np.float32)
        if textured:  # the squares are the same in every frame
            squares = np.random.default_rng(window.begin).integers(40, 216, (64, 64))
            cells = np.floor(across / _BLOCK_M).astype(np.int64) % 64
            level = squares[cells[..., 1], cells[..., 0]].astype(np.float32)
            level = np.asarray(cv2.GaussianBlur(level, (3, 3), 0.8))
        grey = level + _NOISE_GREY * rng.standard_normal(level.shape)
        depth_m[depth_m > window.sensor.depth_max_m] = 0.0
        noise_m = window.sensor.sigma(depth_m) * rng.standard_normal(depth_m.shape)
        color = np.clip(grey, 0, 255).astype(np.uint8)
        if window.images[k].color.ndim == 3:
            color = np.repeat(color[..., None], 3, axis=2)
        return Images(color, np.where(depth_m > 0, depth_m + noise_m, 0).astype(np.float32))

    return change


def _T_wall_world(window: Window) -> NDArray[np.float64]:
    """Return where a wall stands (4, 4): before the first camera of the fault, z its normal."""
    T_cam_wall = se3.exp(np.array([0, 0, 0, _WALL_TILT_RAD, 0.5 * _WALL_TILT_RAD, 0]))
    T_cam_wall[2, 3] = _WALL_M
    return se3.inverse(window.T_world_cam[window.begin] @ T_cam_wall)


def _plane_seen(
    T_wall_cam: NDArray[np.float64], camera: PinholeCamera
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return depth (H, W) of the plane z = 0 of a wall, inf where none, and x, y (H, W, 2)."""
    rays = np.dstack([camera.undistortion_map, np.ones((camera.height, camera.width))])
    turned = rays @ T_wall_cam[:3, :3].T
    origin = T_wall_cam[:3, 3]
    with np.errstate(divide='ignore'):
        depth_m = -origin[2] / turned[..., 2]
    depth_m[depth_m <= 0] = np.inf
    reach = np.where(np.isfinite(depth_m), depth_m, 0.0)
    return depth_m, origin[:2] + turned[..., :2] * reach[..., None]


def box(moving: bool) -> Change:
    """Return the fault of a near box, which covers a third of the image."""

    def change(window: Window, k: int, rng: np.random.Generator) -> Images:
        images = window.images[k]
        color, depth_m = images.color.copy(), images.depth_m.copy()
        height, width = depth_m.shape
        w, h = round(_BOX_SIDES[0] * width), round(_BOX_SIDES[1] * height)
        phase = (window.times_s[k] - window.times_s[window.begin]) / _BOX_PERIOD_S
        share = 0.5 - 0.5 * np.cos(2 * np.pi * phase) if moving else 0.5
        x, y = round(share * (width - w)), height - h
        squares = np.random.default_rng(window.begin).integers(0, 256, (32, 32), np.uint8)
        texture = squares.repeat(_SQUARES_PX, 0).repeat(_SQUARES_PX, 1)[:h, :w]
        area = (slice(y, y + h), slice(x, x + w))
        color[area] = texture if color.ndim == 2 else texture[..., None]
        near_m = _BOX_M + _BOX_SLOPE_M * np.linspace(-1, 1, w)
        noise_m = window.sensor.sigma(near_m) * rng.standard_normal((h, w))
        depth_m[area] = (near_m + noise_m).astype(np.float32)
        return Images(color, depth_m)

    return change


def zoomed(factor: float) -> Change:
    """Return the fault of a focal length that differs from the camera's by a factor above 1."""

    def change(window: Window, k: int, rng: np.random.Generator) -> Images:
        images, camera = window.images[k], window.camera
        centre = np.array([camera.cx, camera.cy])
        M = np.column_stack([factor * np.eye(2), (1 - factor) * centre])
        size = (camera.width, camera.height)
        color = cv2.warpAffine(images.color, M, size, flags=cv2.INTER_LINEAR)
        depth_m = cv2.warpAffine(images.depth_m, M, size, flags=cv2.INTER_NEAREST)
        return Images(np.asarray(color, np.uint8), np.asarray(depth_m, np.float32))

    return change


def depth_late(frames: int) -> Change:
    """Return the fault of depth that belongs to an earlier frame."""

    def change(window: Window, k: int, rng: np.random.Generator) -> Images:
        return replace(window.images[k], depth_m=window.images[k - frames].depth_m)

    return change


def color_of_the_beginning(window: Window, k: int, rng: np.random.Generator) -> Images:
    """Return colour from as long after the beginning as the frame is after the fault's."""
    return replace(window.images[k], color=window.images[k - window.begin].color)


def color_mirrored(window: Window, k: int, rng: np.random.Generator) -> Images:
    """Return colour with left and right exchanged."""
    color = np.ascontiguousarray(window.images[k].color[:, ::-1])
    return replace(window.images[k], color=color)
