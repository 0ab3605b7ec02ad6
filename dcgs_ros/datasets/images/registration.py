# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Whether a camera's depth is registered to its colour, and what makes frames of both."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core.camera import PinholeCamera
from ...core.config.presets import RegistrationChoice
from ...core.errors import DcgsError
from ...core.lens_camera import Camera, LensCamera
from .depth_registration import register_depth
from .resampling import moved_px, resample_color, resample_depth, scaled

AS_RECORDED = 'as recorded'  # the reason where nothing is to be said

_REGISTERED = re.compile('(?<!un)(aligned|registered|depth_?(to|2)_?(rgb|color))')
_SAME_PX = 1.0  # intrinsics that move no pixel farther are those of registered depth
_SAME_PLACE_M, _SAME_PLACE_RAD = 1e-4, 1e-4  # of a transform that moves nothing
_SAME_SHAPE = 0.02  # of the ratio of width to height
_COARSER = 1.5  # angle of a pixel of depth to one of colour, from which on colour is shrunk ...
_LEAST_WIDTH = 640  # ... but not below this: landmarks need more pixels than depth


class RegistrationError(DcgsError):
    """Depth is not registered to colour, and what would register it is missing."""


class Stream(NamedTuple):
    """What is known of the colour or the depth images of a camera."""

    topic: str
    frame: str  # '' if unknown
    size: tuple[int, int]  # width and height of an image
    camera: Camera | None  # as its CameraInfo says; None if unknown


@dataclass(frozen=True)
class Registration:
    """Makes colour and depth of one pinhole camera, pixel by pixel, of what a camera sends."""

    camera: PinholeCamera  # of the frames
    T_colorcam_depthcam: NDArray[np.float64] | None  # (4, 4) metres; None: seen from one place
    by_size: bool  # depth shows what colour does, at its own size
    reason: str

    @property
    def as_recorded(self) -> bool:
        """Whether depth shows what colour does, be it at another size."""
        return self.by_size and self.T_colorcam_depthcam is None

    def __call__(
        self,
        color: NDArray[np.uint8],
        depth_m: NDArray[np.float32],
        color_camera: Camera,
        depth_camera: Camera | None,
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return colour (H, W, 3) or (H, W) and depth (H, W), metres, of `camera`.

        The cameras are those of these very images; depth's is not needed `by_size`. Raises
        `FrameError` for an image that is not of its camera's size.
        """
        if self.by_size or depth_camera is None:
            depth_camera = scaled(color_camera, *depth_m.shape[::-1])
        if self.T_colorcam_depthcam is None:
            depth_m = resample_depth(depth_m, depth_camera, self.camera)
        else:
            even = _no_coarser(rectified(depth_camera), self.camera)
            depth_m = resample_depth(depth_m, depth_camera, even)
            depth_m = register_depth(depth_m, even, self.T_colorcam_depthcam, self.camera)
        return resample_color(color, color_camera, self.camera), depth_m


@dataclass(frozen=True)
class SizeRegistration:
    """Registers depth that shows what colour does, at its own size; `ImageSequence.register`."""

    color_camera: PinholeCamera
    depth_size: tuple[int, int]  # width and height

    @cached_property
    def depth_camera(self) -> PinholeCamera:
        """Camera of the depth images."""
        return scaled(self.color_camera, *self.depth_size)

    @cached_property
    def camera(self) -> PinholeCamera:
        """Camera of the frames: colour's, shrunk if depth is much coarser."""
        return _shrunk(self.color_camera, self.depth_camera)

    def __call__(
        self, color: NDArray[np.uint8], depth_m: NDArray[np.float32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return colour and depth of `camera`; raises `FrameError` for images of other sizes."""
        depth_m = resample_depth(depth_m, self.depth_camera, self.camera)
        return resample_color(color, self.color_camera, self.camera), depth_m


def rectified(camera: Camera) -> PinholeCamera:
    """Return the camera of the rectified images; itself where these need not be rectified."""
    return camera.pinhole if isinstance(camera, LensCamera) else camera


def find_registration(
    asked: RegistrationChoice,
    color: Stream,
    color_camera: Camera,
    depth: Stream,
    extrinsics: Callable[[], NDArray[np.float64] | None],
) -> Registration:
    """Return how frames are made of the images of a camera.

    With `asked` auto, depth is registered already where it is in colour's frame, where its topic's
    name says so and its intrinsics do not contradict, or where these are colour's but for a scale:
    drivers leave the depth camera's frame in registered images. Else `extrinsics` returns
    T_colorcam_depthcam (4, 4), metres. Raises `RegistrationError` where that or more is missing.
    """
    if depth.camera is not None and (depth.camera.width, depth.camera.height) != depth.size:
        depth = depth._replace(camera=None)  # a copy of colour's
    same_K = None
    if depth.camera is not None:
        expected = scaled(color_camera, depth.camera.width, depth.camera.height)
        same_K = moved_px(_bare(expected), _bare(depth.camera)) < _SAME_PX
    reason = _registered(asked, color, depth, same_K)
    T = None
    if reason is None:
        T = extrinsics()
        if T is None and asked == 'auto' and _says_registered(depth):
            reason = ', as its name says, by its own intrinsics'
    by_size = depth.camera is None or bool(same_K and moved_px(expected, depth.camera) < _SAME_PX)
    if reason is not None:
        _check_shape(color, depth, by_size)
        if by_size and depth.size != color.size:
            reason = f', by its size of {depth.size[0]}x{depth.size[1]}{reason}'
        target = _target(color_camera, depth, by_size)
        return Registration(target, None, by_size, AS_RECORDED + reason)
    if T is None or depth.camera is None:
        missing = 'extrinsics' if T is None else 'CameraInfo'
        raise RegistrationError(
            f'{depth.topic} is in frame {depth.frame[:60]!r}, {color.topic} in '
            f'{color.frame[:60]!r}: depth is not registered to colour, and no {missing} to do it '
            'is known; set align_depth.enable:=true (rs_launch.py of realsense2_camera) or, if it '
            'is registered after all, depth_registration=none'
        )
    apart_m = float(np.linalg.norm(T[:3, 3]))
    moves = apart_m > _SAME_PLACE_M or np.abs(T[:3, :3] - np.eye(3)).max() > _SAME_PLACE_RAD
    reason = f'here, by the recorded extrinsics: {1e3 * apart_m:.1f} mm apart'
    return Registration(_target(color_camera, depth, False), T if moves else None, False, reason)


def _registered(
    asked: RegistrationChoice, color: Stream, depth: Stream, same_K: bool | None
) -> str | None:
    """Return why depth is taken as registered to colour, '' where nothing speaks against it."""
    if asked != 'auto':
        return ', as you say' if asked == 'none' else None
    frames = color.frame.lstrip('/'), depth.frame.lstrip('/')
    if frames[0] == frames[1] or not all(frames):
        return ''
    if _says_registered(depth) and same_K is not False:
        return f', as its name says, though in frame {frames[1]}'
    if same_K:
        return f', as it has the intrinsics of colour, though in frame {frames[1]}'
    return None


def _says_registered(depth: Stream) -> bool:
    return _REGISTERED.search(depth.topic.lower()) is not None


def _bare(camera: Camera) -> PinholeCamera:
    """Return the camera without its lens, to compare the intrinsics alone."""
    return PinholeCamera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)


def same_shape(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Return whether images of two widths and heights may show the same view."""
    return abs(one[0] * other[1] / (one[1] * other[0]) - 1.0) < _SAME_SHAPE


def _check_shape(color: Stream, depth: Stream, by_size: bool) -> None:
    """Raise `RegistrationError` where depth cannot show what colour does, only scaled."""
    if by_size and not same_shape(color.size, depth.size):
        raise RegistrationError(
            f'depth is {depth.size[0]}x{depth.size[1]} pixels, colour {color.size[0]}x'
            f'{color.size[1]}, of another shape, and no CameraInfo of {depth.topic} tells which '
            'part of it depth shows'
        )


def _target(color: Camera, depth: Stream, by_size: bool) -> PinholeCamera:
    """Return the camera of the frames."""
    camera = rectified(color)
    if by_size or depth.camera is None:
        return _shrunk(camera, scaled(camera, *depth.size))
    return _shrunk(camera, depth.camera)


def _shrunk(camera: PinholeCamera, coarse: Camera) -> PinholeCamera:
    """Return colour's camera, shrunk if depth is much coarser."""
    factor = max(coarse.fx / camera.fx, _LEAST_WIDTH / camera.width)
    if factor * _COARSER > 1.0:
        return camera
    return scaled(camera, round(factor * camera.width), round(factor * camera.height))


def _no_coarser(depth: PinholeCamera, color: PinholeCamera) -> PinholeCamera:
    """Return the depth camera with more pixels where these would be drawn as large blocks."""
    factor = color.fx / depth.fx
    if factor < _COARSER:
        return depth
    return scaled(depth, round(factor * depth.width), round(factor * depth.height))
