# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Header, Image, CameraInfo and DiagnosticArray; the way back is `io.ros_images`."""

from __future__ import annotations

import array
from collections.abc import Iterable, Mapping

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from ...core.camera import PinholeCamera
from ...io.ros_images import MessageError, camera_fields, exact_pixels, in_metres, in_millimetres


def array_of(values: NDArray | bytes | bytearray | memoryview) -> array.array[int]:
    """Bytes of an array in C order, in the one type a message takes without a look at each."""
    if isinstance(values, np.ndarray):
        values = np.ascontiguousarray(values).reshape(-1).view(np.uint8).data
    out = array.array('B')
    out.frombytes(values)
    return out


def write_color(color: NDArray[np.uint8], header: Header) -> Image:
    """Colour (H, W, 3) RGB as rgb8, (H, W) grey as mono8; raises `MessageError` for another."""
    if color.dtype != np.uint8 or color.ndim not in (2, 3) or color.shape[2:] not in ((), (3,)):
        raise MessageError(f'colour is {color.dtype} {color.shape}, not uint8 (H, W, 3) or (H, W)')
    return _image(color, 'mono8' if color.ndim == 2 else 'rgb8', header)


def write_depth_mm(depth_m: NDArray[np.float32], header: Header) -> Image:
    """Depth (H, W) in metres as 16UC1, rounded to millimetres; beyond 65.535 m it is none: 0."""
    return _image(in_millimetres(depth_m).astype('<u2'), '16UC1', header)


def write_depth(depth_m: NDArray[np.float32], header: Header) -> Image:
    """Depth (H, W) in metres as 32FC1, where none is NaN (REP 118)."""
    return _image(in_metres(depth_m), '32FC1', header)


def write_exact_depth(depth_m: NDArray[np.float32], header: Header) -> Image:
    """Depth (H, W) in metres as 16UC1 where millimetres tell all, else as 32FC1."""
    encoding, pixels = exact_pixels(depth_m)
    return _image(pixels, encoding, header)


def _image(pixels: NDArray, encoding: str, header: Header) -> Image:
    """Fill in the geometry."""
    height, width = pixels.shape[:2]
    message = Image(header=header, height=height, width=width, encoding=encoding)
    message.step = pixels.nbytes // height
    message.data = array_of(pixels)
    return message


_SEC_LIMIT = 2**31  # seconds are an int32 on the wire


def time_message(ns: int) -> Time:
    """Nanoseconds as Time; raises `MessageError` beyond the 68 years around zero it can say."""
    sec, nanosec = divmod(int(ns), 1_000_000_000)
    if not -_SEC_LIMIT <= sec < _SEC_LIMIT:
        raise MessageError(f'stamp of {sec} s does not fit 32 bits')
    return Time(sec=sec, nanosec=nanosec)


def header(stamp_ns: int, frame_id: str) -> Header:
    """Header of that instant and frame; raises `MessageError` as `time_message`."""
    return Header(stamp=time_message(stamp_ns), frame_id=frame_id)


def write_camera(camera: PinholeCamera, header: Header) -> CameraInfo:
    """Intrinsics and distortion; the projection is the camera's own, without rectification."""
    info = CameraInfo(header=header, width=camera.width, height=camera.height)
    info.distortion_model, D, info.k, info.r, info.p = camera_fields(camera)
    info.d = array.array('d', D)
    return info


def status(
    level: bytes, name: str, message: str, values: Mapping[str, object]
) -> DiagnosticStatus:
    """One status; `level` is one of DiagnosticStatus's, floats are shown with four digits."""
    shown = [KeyValue(key=key, value=_text(value)) for key, value in values.items()]
    return DiagnosticStatus(level=level, name=name, message=message, values=shown)


def diagnostics(stamp: Time, statuses: Iterable[DiagnosticStatus]) -> DiagnosticArray:
    """Statuses of one instant."""
    return DiagnosticArray(header=Header(stamp=stamp), status=list(statuses))


def _text(value: object) -> str:
    """Write a value for people."""
    return f'{value:.4g}' if isinstance(value, float) else str(value)
