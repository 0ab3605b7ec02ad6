# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""ICL-NUIM: two rendered rooms, in the dataset's 'TUM RGB-D compatible PNGs'."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.sensor import SensorNoise
from ..core.trajectory import Trajectory
from ..io.trajectory import read_tum
from .camera_presets import PRESETS
from .images.association import StampedPath, StampPair
from .images.indexed_frames import stamp_of_index
from .images.sequence import ImageSequence
from .options import AS_STORED, SourceOptions
from .parsing.intrinsics import choose_camera
from .source import SourceError, sequence_name
from .tum.index import read_index

LAYOUT = 'associations.txt of depth and colour by frame number, and *.gt.freiburg (ICL-NUIM)'

_TRUTH_SUFFIX = '.gt.freiburg'
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def is_icl_nuim(path: Path) -> bool:
    """Return whether the path is a sequence's folder: by its name or its ground truth's."""
    named = re.search(r'traj[0-9]n?_frei_png', sequence_name(path)) is not None
    known = bool(_truth_files(path)) or named
    return known and (path / 'associations.txt').is_file()


def open_icl_nuim(
    path: Path | str,
    camera: str | None = None,
    groundtruth: Path | str | None = None,
    options: SourceOptions = AS_STORED,
) -> ImageSequence:
    """Open a sequence's folder; frame i is at i / 30 s.

    `camera` is a preset or intrinsics instead of the dataset's. `groundtruth` replaces the
    folder's `*.gt.freiburg`: by another one of these, or by a TUM trajectory.

    Raises `SourceError` (or `TrajectoryFileError`) naming the file and the line.
    """
    folder = Path(path)
    preset = PRESETS['icl_nuim']
    if re.search(r'traj[0-9]n(?![a-z])', sequence_name(folder)):
        preset = dataclasses.replace(preset, sensor=SensorNoise.structured_light())
    pairs = _read_pairs(folder / 'associations.txt', options.rate_hz)
    chosen = choose_camera(camera, preset, folder, pairs, options.depth_per_metre)
    notes: list[str] = []
    truth = _read_truth(folder, groundtruth, options.rate_hz, notes)
    return ImageSequence.from_preset(folder, pairs, chosen, truth, notes=notes)


def mirrored(T_world_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the poses (..., 4, 4) of the y-up camera as those of one with y down, F T F.

    ICL-NUIM projects with fy < 0. With F = diag(1, -1, 1) the point F p in the world F is seen at
    the same pixel through F T F with fy > 0, so the images stay as they are.
    """
    return _MIRROR @ T_world_cam @ _MIRROR


def _truth_files(folder: Path) -> list[Path]:
    return sorted(folder.glob(f'*{_TRUTH_SUFFIX}'))


def _read_pairs(path: Path, rate_hz: float | None) -> list[StampPair]:
    """Read rows of `number depth number colour`."""

    def with_stamp(image: StampedPath) -> StampedPath:
        number = _frame_number(path, image.stamp_ns)
        return StampedPath(stamp_of_index(number, rate_hz), image.path)

    pairs = (
        StampPair(with_stamp(color), with_stamp(depth)) for depth, color in read_index(path, 2)
    )
    return list({pair.color.stamp_ns: pair for pair in sorted(pairs)}.values())


def _frame_number(path: Path, stamp_ns: int) -> int:
    """Return the frame number that `read_index` or `read_tum` read as seconds."""
    number, rest = divmod(stamp_ns, 1_000_000_000)
    if rest or number < 0:
        raise SourceError(f'{path}: {stamp_ns / 1e9:.9g} is not a frame number: 0, 1, 2 ...')
    return number


def _read_truth(
    folder: Path, groundtruth: Path | str | None, rate_hz: float | None, notes: list[str]
) -> Trajectory | None:
    if groundtruth is None:
        files = _truth_files(folder)
        if len(files) > 1:
            raise SourceError(
                f'{folder}: which of {", ".join(file.name for file in files)} is the ground truth?'
            )
        if not files:
            return None
        groundtruth = files[0]
    path = Path(groundtruth)
    truth = read_tum(path, notes)
    if not path.name.endswith(_TRUTH_SUFFIX):
        return truth
    numbers = [_frame_number(path, stamp_ns) for stamp_ns in truth.stamps_ns.tolist()]
    stamps_ns = np.array([stamp_of_index(number, rate_hz) for number in numbers], dtype=np.int64)
    return Trajectory(stamps_ns, mirrored(truth.T_world_cam))
