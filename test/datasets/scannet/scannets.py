# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Small ScanNet scenes: .sens files and exported folders."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera

COLOR_SIZE, DEPTH_SIZE = (130, 97), (64, 48)
# As ScanNet's: depth has a little less than half of colour's scale, and sees a little farther.
K_COLOR = np.array([[117.0, 0, 64.8, 0], [0, 117.2, 48.4, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
K_DEPTH = np.array([[57.1, 0, 31.9, 0], [0, 57.2, 24.3, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
IDENTITY = np.eye(4)
START_US, INTERVAL_US, DEPTH_LAG_US = 7_000_000, 33_400, 1_500
RAW, PNG, JPEG, ZLIB, OCCI = 0, 1, 2, 1, 2


class Frame(NamedTuple):
    """A frame before it is compressed."""

    color: NDArray[np.uint8]  # (97, 130, 3) RGB
    depth: NDArray[np.uint16]  # (48, 64) millimetres
    pose: NDArray[np.float64]  # (4, 4) camera to world
    color_us: int
    depth_us: int


def frames_of(count: int) -> list[Frame]:
    """Return frames with noise as colour, depth from 1 to 3 m, and a moving camera."""
    frames = []
    for k in range(count):
        rng = np.random.default_rng(k)
        stamp_us = START_US + k * INTERVAL_US
        frames.append(
            Frame(
                rng.integers(0, 256, (COLOR_SIZE[1], COLOR_SIZE[0], 3), np.uint8),
                rng.integers(1000, 3000, (DEPTH_SIZE[1], DEPTH_SIZE[0])).astype(np.uint16),
                se3.exp(np.array([0.1 * k, 0, 0, 0, 0.2 * k, 0])),
                stamp_us,
                stamp_us + DEPTH_LAG_US,
            )
        )
    return frames


def small_camera(size: tuple[int, int], K: NDArray[np.float64]) -> PinholeCamera:
    """Return the camera of images of that width and height, with K (4, 4)."""
    return PinholeCamera(*size, K[0, 0], K[1, 1], K[0, 2], K[1, 2])


def sens_bytes(
    frames: Iterable[Frame],
    color_type: int = PNG,
    depth_type: int = ZLIB,
    extrinsic_depth: NDArray[np.float64] = IDENTITY,
    imu: Sequence[tuple[float, int]] = (),
    count: int | None = None,
) -> bytes:
    """Return the bytes of a .sens file; `imu` are rotation rates about z and their stamps."""
    name = b'StructureSensor'
    frames = list(frames)
    parts = [struct.pack('<IQ', 4, len(name)), name]
    for matrix in (K_COLOR, IDENTITY, K_DEPTH, extrinsic_depth):
        parts.append(matrix.astype('<f4').tobytes())
    count = len(frames) if count is None else count
    parts.append(
        struct.pack('<iiIIIIfQ', color_type, depth_type, *COLOR_SIZE, *DEPTH_SIZE, 1000.0, count)
    )
    for frame in frames:
        color, depth = _color(frame.color, color_type), frame.depth.astype('<u2').tobytes()
        depth = zlib.compress(depth, 1) if depth_type == ZLIB else depth
        parts.append(frame.pose.astype('<f4').tobytes())
        parts.append(struct.pack('<QQQQ', frame.color_us, frame.depth_us, len(color), len(depth)))
        parts += [color, depth]
    parts.append(struct.pack('<Q', len(imu)))
    for rate, stamp_us in imu:
        values = np.zeros(15)
        values[2] = rate
        parts.append(struct.pack('<15dQ', *values, stamp_us))
    return b''.join(parts)


def write_folder(
    folder: Path, frames: Sequence[Frame], extrinsic_depth: NDArray[np.float64] | None = None
) -> Path:
    """Write a folder as ScanNet's tools do, whose names do not sort as their numbers."""
    for kind in ('color', 'depth', 'pose', 'intrinsic'):
        (folder / kind).mkdir(parents=True)
    for k, frame in enumerate(frames):
        (folder / f'color/{k}.jpg').write_bytes(_color(frame.color, JPEG))
        (folder / f'depth/{k}.png').write_bytes(_encoded('.png', frame.depth))
        np.savetxt(folder / f'pose/{k}.txt', frame.pose, fmt='%f')
    np.savetxt(folder / 'intrinsic/intrinsic_color.txt', K_COLOR, fmt='%f')
    np.savetxt(folder / 'intrinsic/intrinsic_depth.txt', K_DEPTH, fmt='%f')
    if extrinsic_depth is not None:
        np.savetxt(folder / 'intrinsic/extrinsic_depth.txt', extrinsic_depth, fmt='%f')
    return folder


def _color(color: NDArray[np.uint8], kind: int) -> bytes:
    if kind == RAW:
        return color.tobytes()
    return _encoded('.png' if kind == PNG else '.jpg', color[..., ::-1])


def _encoded(suffix: str, image: NDArray[Any]) -> bytes:
    return cv2.imencode(suffix, np.ascontiguousarray(image))[1].tobytes()
