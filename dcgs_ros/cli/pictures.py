# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Rendered views written as numbered images or as a video."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.errors import DcgsError
from ..core.render.renderer import Rendering

CODECS = {'.mp4': 'mp4v', '.avi': 'MJPG'}
_MAX_TRANSMITTANCE = 0.5  # of a pixel that has a depth
_MM_PER_M, _MM_MAX = 1000.0, 65535


class PictureError(DcgsError):
    """An image or a video cannot be written."""


class Pictures(Protocol):
    """Writes views one after the other."""

    path: Path

    def add(self, rendering: Rendering) -> None:
        """Write the next view."""
        ...

    def close(self) -> None:
        """Finish the files."""
        ...


class ImageFolder:
    """Writes 000000.png, 000001.png, ..., and 000000_depth.png, ... into a folder that exists."""

    def __init__(self, path: Path, depth: bool) -> None:
        """Write depth images too if `depth`."""
        self.path, self._depth, self._count = path, depth, 0

    def add(self, rendering: Rendering) -> None:
        """Write the next view."""
        name = f'{self._count:06d}'
        self._write(f'{name}.png', _bgr(rendering))
        if self._depth:
            self._write(f'{name}_depth.png', _depth_mm(rendering))
        self._count += 1

    def _write(self, name: str, image: NDArray[Any]) -> None:
        _, data = cv2.imencode('.png', image)
        (self.path / name).write_bytes(data.tobytes())

    def close(self) -> None:
        """Do nothing: the files are complete."""


class Video:
    """Writes a video file; its suffix is one of `CODECS`."""

    def __init__(self, path: Path, rate_hz: float) -> None:
        """Write nothing yet: the first view sets the size."""
        self.path, self._rate_hz = path, rate_hz
        self._writer: Any = None

    def add(self, rendering: Rendering) -> None:
        """Write the next view. Raises `PictureError` if OpenCV cannot write the file."""
        image = _bgr(rendering)
        if self._writer is None:
            codec = cv2.VideoWriter_fourcc(*CODECS[self.path.suffix.lower()])
            size = image.shape[1::-1]
            self._writer = cv2.VideoWriter(str(self.path), codec, self._rate_hz, size)
            if not self._writer.isOpened():
                raise PictureError(f'{self.path}: OpenCV cannot write this video')
        self._writer.write(image)

    def close(self) -> None:
        """Finish the file."""
        if self._writer is not None:
            self._writer.release()


def _bgr(rendering: Rendering) -> NDArray[np.uint8]:
    """Return the colours (H, W, 3) in OpenCV's order."""
    rgb = np.rint(255 * np.clip(rendering.color, 0, 1)).astype(np.uint8)
    return np.ascontiguousarray(np.moveaxis(rgb, 0, -1)[..., ::-1])


def _depth_mm(rendering: Rendering) -> NDArray[np.uint16]:
    """Return the mean depth (H, W) of the opaque part, millimetres; 0 where little is seen."""
    opacity = 1 - rendering.transmittance
    depth_m = rendering.depth / np.maximum(opacity, 1 - _MAX_TRANSMITTANCE)
    depth_mm = np.minimum(np.rint(_MM_PER_M * depth_m), _MM_MAX)
    return np.where(rendering.transmittance < _MAX_TRANSMITTANCE, depth_mm, 0).astype(np.uint16)
