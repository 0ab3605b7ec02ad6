# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Header, Image and CameraInfo from arrays; `io.ros_images` reads them."""

from __future__ import annotations

import array
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from ...core.camera import PinholeCamera
from ...io.ros_images import MessageError, camera_fields, exact_pixels, in_metres, in_millimetres

_SEC_LIMIT = 2**31  # Time.sec is an int32


def time_message(ns: int) -> Time:
    """Return nanoseconds as Time; raise `MessageError` where the seconds do not fit 32 bits."""
    sec, nanosec = divmod(int(ns), 1_000_000_000)
    if not -_SEC_LIMIT <= sec < _SEC_LIMIT:
        raise MessageError(f'stamp of {sec} s does not fit 32 bits')
    return Time(sec=sec, nanosec=nanosec)


def header(stamp_ns: int, frame_id: str) -> Header:
    """Return a Header; raise `MessageError` where the stamp does not fit."""
    return Header(stamp=time_message(stamp_ns), frame_id=frame_id)


def write_color(color: NDArray[np.uint8], header: Header) -> Image:
    """Return colour (H, W, 3) RGB as rgb8 or (H, W) grey as mono8.

    Raises `MessageError` for any other shape or type.
    """
    if color.dtype != np.uint8 or color.ndim not in (2, 3) or color.shape[2:] not in ((), (3,)):
        raise MessageError(f'colour is {color.dtype} {color.shape}, not uint8 (H, W, 3) or (H, W)')
    return _image(color, 'mono8' if color.ndim == 2 else 'rgb8', header)


def write_depth_mm(depth_m: NDArray[np.float32], header: Header) -> Image:
    """Return depth (H, W) in metres as 16UC1, rounded to millimetres; 0 beyond 65.535 m."""
    return _image(in_millimetres(depth_m).astype('<u2'), '16UC1', header)


def write_depth(depth_m: NDArray[np.float32], header: Header) -> Image:
    """Return depth (H, W) in metres as 32FC1, NaN where there is none (REP 118)."""
    return _image(in_metres(depth_m), '32FC1', header)


def write_exact_depth(depth_m: NDArray[np.float32], header: Header) -> Image:
    """Return depth (H, W) in metres as 16UC1 where millimetres are exact, else as 32FC1."""
    encoding, pixels = exact_pixels(depth_m)
    return _image(pixels, encoding, header)


def write_camera(camera: PinholeCamera, header: Header) -> CameraInfo:
    """Return intrinsics and distortion; P is K, without rectification."""
    info = CameraInfo(header=header, width=camera.width, height=camera.height)
    info.distortion_model, D, info.k, info.r, info.p = camera_fields(camera)
    info.d = array.array('d', D)
    return info


def array_of(values: NDArray[Any] | bytes | bytearray | memoryview) -> array.array[int]:
    """Return the bytes of an array in C order, as the type whose items rclpy does not check."""
    if isinstance(values, np.ndarray):
        values = np.ascontiguousarray(values).reshape(-1).view(np.uint8).data
    out = array.array('B')
    out.frombytes(values)
    return out


def _image(pixels: NDArray[Any], encoding: str, header: Header) -> Image:
    """Return pixels (H, W) or (H, W, C) as an Image."""
    height, width = pixels.shape[:2]
    message = Image(header=header, height=height, width=width, encoding=encoding)
    message.step = pixels.nbytes // height
    message.data = array_of(pixels)
    return message
