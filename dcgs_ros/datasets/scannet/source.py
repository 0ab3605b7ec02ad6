# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""ScanNet: a scene's .sens file, or the folder that ScanNet's tools export.

Frames are those of the depth camera: colour is resampled to depth's pixels.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ...core.camera import PinholeCamera
from ...core.errors import FrameError
from ...core.frame import RgbdFrame
from ...core.sensor import SensorNoise
from ...core.trajectory import Trajectory
from ...io.trajectory import read_tum
from ..camera_presets import PRESETS
from ..images.color_resampling import ColorResampling
from ..images.indexed_frames import pair_by_index
from ..images.sequence import ImageSequence, color_size, depth_size
from ..options import AS_STORED, SourceOptions
from ..parsing.pose_matrices import read_matrix, read_pose, rigid_trajectory
from ..source import BadFrame, ImuSample, Source, SourceError, sequence_name
from .calibration import make_depth_camera, make_resampling
from .sens import SensFile, open_binary, read_sens

LAYOUT = 'a .sens, or color/N.jpg (or .png), depth/N.png, pose/N.txt and intrinsic/*.txt (ScanNet)'

_PRESET = PRESETS['scannet']


def is_scannet(path: Path) -> bool:
    """Return whether the path is a .sens file or such a folder."""
    if path.is_dir():
        return _exported(path) is not None
    return path.suffix == '.sens' and path.exists()


def open_scannet(
    path: Path | str,
    camera: str | None = None,
    groundtruth: Path | str | None = None,
    options: SourceOptions = AS_STORED,
) -> Source:
    """Open a .sens file, or an exported folder.

    `camera` is a preset or intrinsics for the depth camera instead of the scene's own;
    `groundtruth` a trajectory file instead of the scene's poses. Raises a `DcgsError` that names
    the file.
    """
    path = Path(path)
    notes: list[str] = []
    truth = None if groundtruth is None else read_tum(groundtruth, notes)
    open_ = _open_folder if path.is_dir() else _open_sens
    return open_(path, camera, truth, options, notes)


@dataclass(frozen=True)
class SensSource:
    """The frames of a .sens file, read one by one."""

    name: str
    file: SensFile
    camera: PinholeCamera
    sensor: SensorNoise
    groundtruth: Trajectory | None
    register: ColorResampling
    notes: Sequence[str] = ()

    @property
    def depth_per_metre(self) -> float:
        """Value of a depth pixel at one metre."""
        return self.file.depth_per_metre

    def __len__(self) -> int:
        """Return the number of complete frames, plus one if some are lost."""
        return len(self.file.frames) + (self.file.loss is not None)

    def __iter__(self) -> Iterator[RgbdFrame | BadFrame]:
        """Read the frames one by one; an unreadable one, or a lost rest, is a `BadFrame`."""
        count = len(self.file.frames)
        stamps_ns, depth_stamps_ns = self.file.stamps_ns()
        with open_binary(self.file.path) as file:
            for k in range(count):
                try:
                    color, depth = self.file.read_images(file, k)
                    depth_m = depth.astype(np.float32) / np.float32(self.file.depth_per_metre)
                    item: RgbdFrame | BadFrame = RgbdFrame(
                        int(stamps_ns[k]), int(depth_stamps_ns[k]), *self.register(color, depth_m)
                    )
                except FrameError as error:
                    item = BadFrame(f'frame {k + 1} of {count}', str(error))
                yield item
        if self.file.loss is not None:
            yield BadFrame(f'what follows frame {count}', self.file.loss)

    def imu(self) -> Iterator[ImuSample]:
        """Read the rotation rates, if there are any."""
        return self.file.imu()


def _open_sens(
    path: Path,
    camera: str | None,
    truth: Trajectory | None,
    options: SourceOptions,
    notes: list[str],
) -> SensSource:
    file = replace(read_sens(path), rate_hz=options.rate_hz)
    if options.depth_per_metre is not None:
        file = replace(file, depth_per_metre=options.depth_per_metre)
    K_color, T_rig_color, K_depth, T_rig_depth = file.calibration
    depth = make_depth_camera(path, camera, K_depth, file.depth_size)
    register = make_resampling(path, K_color, file.color_size, depth, T_rig_color, T_rig_depth)
    if truth is None:
        truth = rigid_trajectory(file.stamps_ns()[0], file.frames['T_world_cam'])
    return SensSource(path.stem, file, depth, _PRESET.sensor, truth, register, notes)


def _exported(path: Path) -> Path | None:
    """Return the folder with color/ and depth/: the path itself, its frames/, or None."""
    for folder in (path, path / 'frames'):
        kinds = all((folder / name).is_dir() for name in ('color', 'depth'))
        if kinds and (_intrinsic(folder).is_dir() or _calibration(folder, 'color').is_file()):
            return folder
    return None


def _intrinsic(folder: Path) -> Path:
    return folder / 'intrinsic'


def _calibration(folder: Path, kind: str) -> Path:
    """Return the file of intrinsics of colour or depth; that of the export tool by default."""
    places = [_intrinsic(folder) / f'intrinsic_{kind}.txt', folder / f'intrinsics_{kind}.txt']
    return next((place for place in places if place.is_file()), places[0])


def _open_folder(
    path: Path,
    camera: str | None,
    truth: Trajectory | None,
    options: SourceOptions,
    notes: list[str],
) -> ImageSequence:
    folder = _exported(path)
    if folder is None:
        raise SourceError(f'{path}: neither it nor its frames/ has color/, depth/ and intrinsic/')
    color = r'color/([0-9]{1,9})\.(?:jpg|png)'
    pairs = pair_by_index(folder, color, r'depth/([0-9]{1,9})\.png', options.rate_hz)
    intrinsic = _intrinsic(folder)
    K_depth = np.eye(3) if camera else read_matrix(_calibration(folder, 'depth'), side=3)
    depth = make_depth_camera(
        intrinsic, camera, K_depth, depth_size(folder, [pair.depth.path for pair in pairs])
    )
    register = make_resampling(
        intrinsic,
        read_matrix(_calibration(folder, 'color'), side=3),
        color_size(folder, pairs),
        depth,
        *(
            read_matrix(file) if file.exists() else np.eye(4)
            for file in (intrinsic / 'extrinsic_color.txt', intrinsic / 'extrinsic_depth.txt')
        ),
    )
    if truth is None:
        files = [folder / 'pose' / f'{Path(pair.color.path).stem}.txt' for pair in pairs]
        stamps_ns = np.array([pair.color.stamp_ns for pair in pairs], np.int64)
        truth = rigid_trajectory(stamps_ns, np.array([read_pose(file) for file in files]))
    name, unit = sequence_name(path), options.depth_per_metre or _PRESET.depth_per_metre
    return ImageSequence(name, folder, pairs, depth, _PRESET.sensor, unit, truth, register, notes)
