# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Stray Scanner's exports: an iPhone's LiDAR depth and a video of colour.

Frames are those of the depth camera, 256x192: colour is resampled to them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.camera import PinholeCamera
from ..core.errors import FrameError
from ..core.frame import RgbdFrame
from ..core.sensor import SensorNoise
from ..core.trajectory import Trajectory
from ..io.images.decoding import read_depth_file, read_grey_file
from ..io.trajectory import data_rows, parse_pose, parse_stamp_ns, read_tum, trajectory_of
from .images.color_resampling import ColorResampling
from .images.indexed_frames import stamp_of_index
from .images.sequence import depth_size
from .options import AS_STORED, SourceOptions
from .parsing.intrinsics import MAX_PIXELS
from .parsing.pose_matrices import read_matrix
from .scannet.calibration import make_depth_camera, make_resampling
from .source import BadFrame, ImuSample, SourceError, sequence_name

LAYOUT = 'rgb.mp4, depth/000000.png ..., odometry.csv and camera_matrix.csv (Stray Scanner)'

_VIDEO, _ODOMETRY, _CAMERA = 'rgb.mp4', 'odometry.csv', 'camera_matrix.csv'
_POSE_AT = 2  # column of odometry.csv: timestamp, frame, x, y, z, qx, qy, qz, qw
_DEPTH_PER_METRE = 1000.0
_NO_CONFIDENCE = 0  # of 0, 1, 2: depth that the LiDAR did not measure
_SENSOR = SensorNoise(a_m=0.003, b_per_m=0.002, depth_min_m=0.2, depth_max_m=5.0)


def is_stray_scanner(path: Path) -> bool:
    """Return whether the path is such a folder."""
    return all((path / name).is_file() for name in (_VIDEO, _ODOMETRY, _CAMERA))


def open_stray_scanner(
    path: Path | str,
    camera: str | None = None,
    groundtruth: Path | str | None = None,
    options: SourceOptions = AS_STORED,
) -> StrayScannerSource:
    """Open an exported folder.

    `camera` is a preset or intrinsics for the depth camera instead of `camera_matrix.csv`'s,
    scaled. The ground truth is the phone's own odometry, unless `groundtruth` is given. Raises a
    `DcgsError` that names the file.
    """
    folder = Path(path)
    notes: list[str] = []
    stamps_ns, odometry = _read_odometry(folder / _ODOMETRY, options.rate_hz, notes)
    truth = odometry if groundtruth is None else read_tum(groundtruth, notes)
    with closing(_Video(folder / _VIDEO)) as video:
        color_size = video.size
    K_color = read_matrix(folder / _CAMERA, side=3)
    size = depth_size(folder, map(_depth_path, stamps_ns))
    scale = np.array([size[0] / color_size[0], size[1] / color_size[1], 1.0])
    K_depth = K_color[:3, :3] * scale[:, None]
    K_depth[:2, 2] += (scale[:2] - 1) / 2  # edges are scaled, centres lie half a pixel inside
    depth = make_depth_camera(folder / _CAMERA, camera, K_depth, size)
    register = make_resampling(folder / _CAMERA, K_color, color_size, depth, np.eye(4), np.eye(4))
    unit = options.depth_per_metre or _DEPTH_PER_METRE
    name = sequence_name(folder)
    return StrayScannerSource(name, folder, stamps_ns, depth, truth, unit, register, notes)


@dataclass(frozen=True)
class StrayScannerSource:
    """The frames of an export, read one by one."""

    name: str
    folder: Path
    stamps_ns: dict[int, int]  # of the frames, by their number in the video
    camera: PinholeCamera
    groundtruth: Trajectory | None
    depth_per_metre: float
    register: ColorResampling
    notes: Sequence[str] = ()
    sensor: SensorNoise = _SENSOR

    def __len__(self) -> int:
        """Return the number of frames, readable or not."""
        return len(self.stamps_ns)

    def __iter__(self) -> Iterator[RgbdFrame | BadFrame]:
        """Read the frames one by one; an unreadable one is a `BadFrame`."""
        with closing(_Video(self.folder / _VIDEO)) as video:
            for number, stamp_ns in self.stamps_ns.items():
                try:
                    images = self.register(video.read(number), self._depth_m(number))
                    item: RgbdFrame | BadFrame = RgbdFrame(stamp_ns, stamp_ns, *images)
                except FrameError as error:
                    item = BadFrame(f'frame {number} of {self.name}', str(error))
                yield item

    def imu(self) -> Iterator[ImuSample]:
        """Return nothing: the unit and frame of imu.csv are not documented."""
        return iter(())

    def _depth_m(self, number: int) -> NDArray[np.float32]:
        depth = read_depth_file(self.folder, _depth_path(number))
        confidence = f'confidence/{number:06d}.png'
        if (self.folder / confidence).exists():
            grey = read_grey_file(self.folder, confidence)
            if grey.shape != depth.shape:
                raise FrameError(f'{confidence} is {grey.shape}, depth {depth.shape} pixels')
            depth[grey == _NO_CONFIDENCE] = 0
        return depth.astype(np.float32) / np.float32(self.depth_per_metre)


class _Video:
    """Colour images of a video, read in their order."""

    def __init__(self, path: Path) -> None:
        """Raise `SourceError` if it cannot be read."""
        self._capture = cv2.VideoCapture(str(path))
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        sides = (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        width, height = (int(self._capture.get(side)) for side in sides)
        if not (self._capture.isOpened() and 0 < width * height <= MAX_PIXELS):
            raise SourceError(f'{path}: cannot be read as a video')
        self.size = width, height
        self._next = 0

    def read(self, number: int) -> NDArray[np.uint8]:
        """Return image `number` (H, W, 3) RGB; numbers increase. Raises `FrameError`."""
        while self._next < number and self._capture.grab():
            self._next += 1
        there, image = self._capture.read() if self._next == number else (False, None)
        if not there or image is None:
            raise FrameError(f'{_VIDEO} ends after {self._next} images')
        self._next += 1
        color: NDArray[np.uint8] = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        return color

    def close(self) -> None:
        self._capture.release()


def _depth_path(number: int) -> str:
    return f'depth/{number:06d}.png'


def _read_odometry(
    path: Path, rate_hz: float | None, notes: list[str]
) -> tuple[dict[int, int], Trajectory | None]:
    """Return the stamps of the frames by their numbers, and the poses that can be used."""
    stamps_ns: dict[int, int] = {}
    poses: dict[int, list[float]] = {}
    faults: list[str] = []
    for line, words in data_rows(path):
        try:
            number = int(words[1])
            stamp_ns = parse_stamp_ns(words[0])
            if stamps_ns and (number <= max(stamps_ns) or stamp_ns <= max(stamps_ns.values())):
                raise ValueError(f'frame {number} is not after the one before')
            stamps_ns[number] = stamp_ns if rate_hz is None else stamp_of_index(number, rate_hz)
            poses[stamps_ns[number]] = parse_pose([words[0], *words[_POSE_AT : _POSE_AT + 7]])[1]
        except (ValueError, IndexError) as error:
            faults.append(f'{path}:{line}: {error}')
    if not stamps_ns:
        raise SourceError(faults[0] if faults else f'{path}: holds no frame')
    if faults:
        notes.append(f'{len(faults)} lines have no usable pose; the first: {faults[0]}')
    return stamps_ns, trajectory_of(poses) if poses else None
