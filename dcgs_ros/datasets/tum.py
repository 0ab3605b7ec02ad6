# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Sequences in the folder layout of TUM's RGB-D benchmark."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.camera import PinholeCamera
from ..core.errors import FrameError
from ..core.frame import RgbdFrame
from ..core.sensor import SensorNoise
from ..core.trajectory import Trajectory
from ..io.trajectory import read_tum
from .cameras import PRESETS, TUM_DEPTH_PER_METRE, parse_intrinsics
from .source import BadFrame, SourceError
from .tum_index import Pair, read_pairs

_COLOR_FLAGS = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
# How an image file ends, by how it starts: decoders fill what is missing with grey or zeros.
_END_OF_IMAGE = {b'\x89PNG': b'IEND', b'\xff\xd8': b'\xff\xd9'}


class TumSource:
    """A folder with `rgb.txt` and `depth.txt`, or `associations.txt`, and the images they name.

    `camera` is a preset (`fr1`, `fr2`, `fr3`, `d435i`) or `fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]` in
    pixels (then with TUM's 5000 per metre and structured-light noise); None takes it from the
    folder's name. `groundtruth` defaults to the folder's `groundtruth.txt` where there is one.

    Everything but the images is read and checked here: raises `SourceError` (or
    `TrajectoryFileError` for the ground truth) naming the file and the line.
    """

    camera: PinholeCamera
    sensor: SensorNoise
    groundtruth: Trajectory | None

    def __init__(
        self, folder: Path | str, camera: str | None = None, groundtruth: Path | str | None = None
    ) -> None:
        """Read the index files, the camera and the ground truth."""
        self._folder = Path(folder)
        self.name = os.path.basename(os.path.abspath(folder))
        if not self._folder.is_dir():
            raise SourceError(f'{folder}: no such folder')
        self._pairs = read_pairs(self._folder)
        self._set_camera(camera or self._infer_camera())
        default = self._folder / 'groundtruth.txt'
        if groundtruth is None and default.exists():
            groundtruth = default
        self.groundtruth = None if groundtruth is None else read_tum(groundtruth)

    def __len__(self) -> int:
        """Count the pairs of colour and depth, readable or not."""
        return len(self._pairs)

    def __iter__(self) -> Iterator[RgbdFrame | BadFrame]:
        """Read the frames one by one; an unreadable one comes as a `BadFrame`."""
        for number, pair in enumerate(self._pairs, start=1):
            try:
                frame: RgbdFrame | BadFrame = self._read(pair)
            except FrameError as error:
                name = f'frame {number} of {len(self)} ({pair.color.path})'
                frame = BadFrame(name, str(error))
            yield frame

    def _infer_camera(self) -> str:
        match = re.search(r'(?:freiburg|fr)([123])(?!\d)', self.name.lower())
        if match is None:
            raise SourceError(
                f'{self.name}: the name does not tell the camera (fr1, fr2 or fr3); '
                'give --camera fr1|fr2|fr3|d435i or --camera fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]'
            )
        return f'fr{match[1]}'

    def _set_camera(self, text: str) -> None:
        preset = PRESETS.get(text)
        if preset is not None:
            self.camera, self.sensor = preset.camera, preset.sensor
            self._depth_per_metre = preset.depth_per_metre
            return
        parse_intrinsics(text, 640, 480)  # complain about the text before looking for an image
        height, width = self._first_color_shape()
        self.camera = parse_intrinsics(text, width, height)
        self.sensor = SensorNoise.structured_light()
        self._depth_per_metre = TUM_DEPTH_PER_METRE

    def _first_color_shape(self) -> tuple[int, int]:
        """Height and width of the first readable colour image."""
        for pair in self._pairs:
            try:
                height, width = _decode(self._folder, pair.color.path, _COLOR_FLAGS).shape[:2]
            except FrameError as error:
                reason = error
            else:
                return height, width
        raise SourceError(f'{self.name}: no readable colour image tells its size: {reason}')

    def _read(self, pair: Pair) -> RgbdFrame:
        color = _decode(self._folder, pair.color.path, _COLOR_FLAGS)
        depth = _decode(self._folder, pair.depth.path, cv2.IMREAD_UNCHANGED)
        if depth.dtype != np.uint16 or depth.ndim != 2:
            channels = 1 if depth.ndim == 2 else depth.shape[2]
            raise FrameError(
                f'{pair.depth.path} has {channels} channel(s) of {8 * depth.itemsize} bits, '
                'not one of 16'
            )
        size = (self.camera.height, self.camera.width)
        for path, image in ((pair.color.path, color), (pair.depth.path, depth)):
            if image.shape[:2] != size:
                raise FrameError(
                    f'{path} is {image.shape[1]}x{image.shape[0]} pixels, '
                    f"the camera's images are {size[1]}x{size[0]}"
                )
        if not depth.any():
            raise FrameError(f'{pair.depth.path} is zero in all {depth.size} pixels')
        return RgbdFrame(
            stamp_ns=pair.color.stamp_ns,
            depth_stamp_ns=pair.depth.stamp_ns,
            color=cv2.cvtColor(color, cv2.COLOR_BGR2RGB),
            depth_m=depth.astype(np.float32) / np.float32(self._depth_per_metre),
        )


def _decode(folder: Path, path: str, flags: int) -> NDArray:
    """Read an image, or raise `FrameError` saying why not."""
    try:
        data = (folder / path).read_bytes()
    except OSError as error:
        raise FrameError(f'{path}: {error.strerror}') from error
    for start, end in _END_OF_IMAGE.items():
        if data.startswith(start) and end not in data[-4096:]:
            raise FrameError(f'{path} is cut off after {len(data)} bytes')
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise FrameError(f'{path} ({len(data)} bytes) is no image that can be decoded')
    return image
