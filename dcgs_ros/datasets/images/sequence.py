# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Sequences that are folders of colour and depth images, whatever the files are called."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.camera import PinholeCamera
from ...core.errors import FrameError
from ...core.frame import RgbdFrame
from ...core.sensor import SensorNoise
from ...core.trajectory import Trajectory
from ...io.images.decoding import read_color_file, read_depth_file
from ..camera_presets import CameraPreset
from ..source import BadFrame, ImuSample, SourceError, sequence_name
from .association import StampPair
from .registration import SizeRegistration, same_shape

# Colour (H, W, 3) RGB, depth (H, W) in metres.
ColorDepth = tuple[NDArray[np.uint8], NDArray[np.float32]]


def already_registered(color: NDArray[np.uint8], depth_m: NDArray[np.float32]) -> ColorDepth:
    """Return images whose depth is registered to colour as they are."""
    return color, depth_m


@dataclass(frozen=True)
class ImageSequence:
    """Pairs of image files, read one by one.

    `register` turns the two stored images into those of one camera: colour and depth of its size,
    aligned pixel by pixel. It may raise `FrameError`.
    """

    name: str
    folder: Path
    pairs: Sequence[StampPair]  # in order of their colour stamps; paths relative to the folder
    camera: PinholeCamera
    sensor: SensorNoise
    depth_per_metre: float  # raw value of a depth of one metre
    groundtruth: Trajectory | None = None
    register: Callable[[NDArray[np.uint8], NDArray[np.float32]], ColorDepth] = already_registered
    notes: Sequence[str] = ()

    @classmethod
    def from_preset(
        cls,
        folder: Path,
        pairs: Sequence[StampPair],
        preset: CameraPreset,
        groundtruth: Trajectory | None,
        register: Callable[
            [NDArray[np.uint8], NDArray[np.float32]], ColorDepth
        ] = already_registered,
        notes: Sequence[str] = (),
    ) -> ImageSequence:
        """Make a sequence with the preset's camera, noise and unit, named after its folder.

        Depth that is smaller or larger than colour, of the same shape, is scaled to it.
        """
        camera, sensor, unit = preset.camera, preset.sensor, preset.depth_per_metre
        if register is already_registered:
            by_size = _by_size(folder, pairs, camera)
            if by_size is not None:
                camera, register = by_size.camera, by_size
                width, height = by_size.depth_size
                notes = (*notes, f'depth of {width}x{height} pixels is scaled to those of colour')
        name = sequence_name(folder)
        return cls(name, folder, pairs, camera, sensor, unit, groundtruth, register, notes)

    def __len__(self) -> int:
        """Return the number of pairs, readable or not."""
        return len(self.pairs)

    def __iter__(self) -> Iterator[RgbdFrame | BadFrame]:
        """Read the frames one by one; an unreadable one is a `BadFrame`."""
        for number, pair in enumerate(self.pairs, start=1):
            try:
                frame: RgbdFrame | BadFrame = self._read(pair)
            except FrameError as error:
                name = f'frame {number} of {len(self)} ({pair.color.path})'
                frame = BadFrame(name, str(error))
            yield frame

    def imu(self) -> Iterator[ImuSample]:
        """Return nothing: image folders have no IMU."""
        return iter(())

    def _read(self, pair: StampPair) -> RgbdFrame:
        color = read_color_file(self.folder, pair.color.path)
        depth = read_depth_file(self.folder, pair.depth.path)
        if not depth.any():
            raise FrameError(f'{pair.depth.path} is zero in all {depth.size} pixels')
        depth_m = depth.astype(np.float32) / np.float32(self.depth_per_metre)
        color, depth_m = self.register(color, depth_m)
        size = (self.camera.height, self.camera.width)
        for path, image in ((pair.color.path, color), (pair.depth.path, depth_m)):
            if image.shape[:2] != size:
                raise FrameError(
                    f'{path} is {image.shape[1]}x{image.shape[0]} pixels, '
                    f"the camera's images are {size[1]}x{size[0]}"
                )
        return RgbdFrame(pair.color.stamp_ns, pair.depth.stamp_ns, color, depth_m)


def _by_size(
    folder: Path, pairs: Sequence[StampPair], camera: PinholeCamera
) -> SizeRegistration | None:
    """Return what scales depth to the size of colour, if it has another one."""
    size = camera.width, camera.height
    try:
        found = depth_size(folder, (pair.depth.path for pair in pairs))
        if found == size or not same_shape(found, size) or color_size(folder, pairs) != size:
            return None
    except SourceError:  # said of each frame
        return None
    return SizeRegistration(camera, found)


def color_size(folder: Path, pairs: Sequence[StampPair]) -> tuple[int, int]:
    """Return width and height of the first readable colour image; raises `SourceError`."""
    return _first_size(folder, (pair.color.path for pair in pairs), 'colour', read_color_file)


def depth_size(folder: Path, paths: Iterable[str]) -> tuple[int, int]:
    """Return width and height of the first readable depth image; raises `SourceError`."""
    return _first_size(folder, paths, 'depth', read_depth_file)


def _first_size(
    folder: Path, paths: Iterable[str], what: str, read: Callable[[Path, str], NDArray[Any]]
) -> tuple[int, int]:
    reason: object = 'there are no images'
    for path in paths:
        try:
            height, width = read(folder, path).shape[:2]
        except FrameError as error:
            reason = error
        else:
            return width, height
    raise SourceError(f'{folder}: no readable {what} image tells its size: {reason}')
