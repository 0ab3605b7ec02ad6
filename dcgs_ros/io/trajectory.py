# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Trajectory files in TUM's format: one `stamp tx ty tz qx qy qz qw` per line."""

from __future__ import annotations

import os
from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from io import FileIO
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..core.errors import DcgsError
from ..core.trajectory import Trajectory
from .whole_files import replacing

# TUM's four decimals leave the norm right to 1e-4. An error a hundred times larger is no rounding:
# these columns hold another quantity.
QUATERNION_NORM_TOLERANCE = 1e-2

_HEADING = '# timestamp tx ty tz qx qy qz qw\n'
_STAMP_LIMIT_NS = 2**62  # 146 years: the difference of two stamps still fits 64 bits


class TrajectoryFileError(DcgsError):
    """A trajectory file cannot be read or written."""


def parse_stamp_ns(text: str) -> int:
    """Parse seconds as decimal text to integer nanoseconds, without rounding to a float.

    Raises `ValueError` for anything but a finite number within 146 years of zero.
    """
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        raise ValueError(f'{text!r} is no time in seconds') from None
    if not seconds.is_finite() or seconds.adjusted() > 10:
        raise ValueError(f'{text!r} is no usable time in seconds')
    stamp_ns = int(seconds.scaleb(9).to_integral_value())
    if abs(stamp_ns) >= _STAMP_LIMIT_NS:
        raise ValueError(f'{text!r} is no usable time in seconds')
    return stamp_ns


def format_stamp_ns(stamp_ns: int) -> str:
    """Return integer nanoseconds as seconds with nine decimals, exactly."""
    seconds, fraction = divmod(abs(int(stamp_ns)), 1_000_000_000)
    return f'{"-" if stamp_ns < 0 else ""}{seconds}.{fraction:09d}'


def read_tum(path: Path | str) -> Trajectory:
    """Read a trajectory; quaternions are normalised, comments (#) and empty lines skipped.

    Raises `TrajectoryFileError` naming the file and the line that is wrong: not eight finite
    numbers, a quaternion not of unit length, stamps that do not increase; or if there is no pose.
    """
    path = Path(path)
    stamps: list[int] = []
    rows: list[list[float]] = []
    for number, line in _data_lines(path):
        try:
            stamp_ns, row = _parse_pose(line)
            if stamps and stamp_ns <= stamps[-1]:
                raise ValueError(
                    f'stamp {format_stamp_ns(stamp_ns)} does not come after '
                    f'{format_stamp_ns(stamps[-1])}'
                )
        except ValueError as error:
            raise TrajectoryFileError(f'{path}:{number}: {error}') from None
        stamps.append(stamp_ns)
        rows.append(row)
    if not rows:
        raise TrajectoryFileError(f'{path}: holds no pose')
    values = np.array(rows)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, 3] = values[:, :3]
    poses[:, :3, :3] = Rotation.from_quat(values[:, 3:]).as_matrix()
    return Trajectory(np.array(stamps, dtype=np.int64), poses)


def write_tum(path: Path | str, trajectory: Trajectory) -> None:
    """Write a trajectory: stamps to the nanosecond, metres and quaternions to nine decimals.

    The file is written completely or not at all. Raises `TrajectoryFileError` if it cannot be.
    """
    path = Path(path)
    try:
        with replacing(path) as temporary:
            temporary.write_text(_HEADING + _lines(trajectory), encoding='ascii')
    except OSError as error:
        reason = error.strerror or error
        raise TrajectoryFileError(f'{path}: cannot be written: {reason}') from error


class TrajectoryStream:
    """A trajectory file that grows. What replaces the file meanwhile is never written to."""

    def __init__(self, path: Path) -> None:
        """Wait for the first pose to create the file."""
        self._path, self._last_ns = path, -_STAMP_LIMIT_NS
        self._file: FileIO | None = None

    def append(self, trajectory: Trajectory) -> None:
        """Write the poses that are newer than those before to the disk.

        Raises `OSError`, a `FileExistsError` if the file was there before the first pose.
        """
        newer = trajectory.stamps_ns > self._last_ns
        stamps_ns, T_world_cam = trajectory.stamps_ns[newer], trajectory.T_world_cam[newer]
        if not len(stamps_ns):
            return
        text = _lines(Trajectory(stamps_ns, T_world_cam))
        if self._file is None:
            self._file = FileIO(self._path, 'x')
            text = _HEADING + text
        self._file.write(text.encode('ascii'))  # at once: a killed process leaves whole lines
        os.fsync(self._file.fileno())
        self._last_ns = int(stamps_ns[-1])

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()


def _lines(trajectory: Trajectory) -> str:
    lines = []
    if len(trajectory):
        rotations = Rotation.from_matrix(trajectory.T_world_cam[:, :3, :3])
        # Canonical (w >= 0), as q and -q are the same rotation and should be the same text.
        quaternions = rotations.as_quat(canonical=True)
        rows = np.hstack([trajectory.T_world_cam[:, :3, 3], quaternions])
        rows = np.round(rows, 9) + 0.0  # + 0.0: no '-0.000000000'
        for stamp_ns, row in zip(trajectory.stamps_ns, rows, strict=True):
            numbers = ' '.join(f'{value:.9f}' for value in row)
            lines.append(f'{format_stamp_ns(stamp_ns)} {numbers}\n')
    return ''.join(lines)


def _data_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Return number and text of each line that is neither empty nor a comment."""
    try:
        text = path.read_text(encoding='utf-8', errors='replace')
    except OSError as error:
        raise TrajectoryFileError(f'{path}: cannot be read: {error.strerror}') from error
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith('#'):
            yield number, line


def _parse_pose(line: str) -> tuple[int, list[float]]:
    """Return stamp and seven numbers of one line; raises `ValueError` with what is wrong."""
    words = line.split()
    if len(words) != 8:
        raise ValueError(f'{len(words)} columns, not 8 (stamp tx ty tz qx qy qz qw)')
    row = [float(word) for word in words[1:]]
    if not np.isfinite(row).all():
        raise ValueError(f'pose is not finite: {" ".join(words[1:])}')
    norm = float(np.linalg.norm(row[3:]))
    if abs(norm - 1) > QUATERNION_NORM_TOLERANCE:
        raise ValueError(f'quaternion {" ".join(words[4:])} has length {norm:.4g}, not 1')
    return parse_stamp_ns(words[0]), row
