# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Trajectory files in TUM's format: one `stamp tx ty tz qx qy qz qw` per line, or as CSV."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..core.errors import DcgsError
from ..core.trajectory import Trajectory
from .whole_files import replacing

# TUM's four decimals leave the norm right to 1e-4. An error a hundred times larger is no rounding:
# these columns hold another quantity.
QUATERNION_NORM_TOLERANCE = 1e-2

_STAMP_LIMIT_NS = 2**62  # 146 years: the difference of two stamps still fits 64 bits
_SINCE_1970_NS = range(10**18, 21 * 10**17)  # times from 2001 to 2036
_EUROC_COLUMNS = 17  # with velocity and biases after the pose


class TrajectoryFileError(DcgsError):
    """A trajectory file cannot be read or written."""


def parse_stamp_ns(text: str) -> int:
    """Parse seconds as decimal text to integer nanoseconds, without rounding to a float.

    Whole numbers of 11 digits or more are milliseconds or microseconds where that is a time of
    these years, else nanoseconds. Raises `ValueError` for anything but a finite number within 146
    years of zero.
    """
    if re.fullmatch('[0-9]{11,19}', text):
        scales = (scale for scale in (10**6, 10**3) if int(text) * scale in _SINCE_1970_NS)
        text = format_stamp_ns(int(text) * next(scales, 1))
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


def read_tum(path: Path | str, left_out: list[str] | None = None) -> Trajectory:
    """Read a trajectory; quaternions are normalised, comments (#) and empty lines skipped.

    Columns are separated by blanks or commas; in a CSV as EuRoC's the quaternion begins with w,
    as its heading says. Poses that cannot be used are refused; with the list `left_out`, they are
    left out, poses out of order are sorted, and a line about it is appended. Raises
    `TrajectoryFileError` naming the file and the line that is wrong: not eight finite numbers, a
    quaternion not of unit length, stamps that do not increase; or if there is no pose, or of most
    lines none.
    """
    path = Path(path)
    poses, faults, late = _read_poses(path, strict=left_out is None)
    if faults and (left_out is None or len(faults) > len(poses)):
        raise TrajectoryFileError(faults[0])
    if not poses:
        raise TrajectoryFileError(f'{path}: holds no pose')
    if left_out is not None:
        left_out += _notes(path, faults, len(poses), late)
    return trajectory_of(poses)


def _read_poses(path: Path, strict: bool) -> tuple[dict[int, list[float]], list[str], int]:
    """Return poses by their stamps, the faults of lines, and how many came late.

    If it is `strict`, a late one is a fault, and nothing is read after the first.
    """
    poses: dict[int, list[float]] = {}
    faults: list[str] = []
    latest_ns, late = -_STAMP_LIMIT_NS, 0
    for number, words in data_rows(path, scalar_last=True):
        try:
            stamp_ns, row = parse_pose(words)
            if stamp_ns in poses or (strict and stamp_ns < latest_ns):
                raise ValueError(
                    f'stamp {format_stamp_ns(stamp_ns)} does not come after '
                    f'{format_stamp_ns(latest_ns)}'
                )
        except ValueError as error:
            faults.append(f'{path}:{number}: {error}')
            if strict:
                break
            continue
        late += stamp_ns < latest_ns
        latest_ns = max(latest_ns, stamp_ns)
        poses[stamp_ns] = row
    return poses, faults, late


def trajectory_of(poses: Mapping[int, Sequence[float]]) -> Trajectory:
    """Return the trajectory of one pose or more, tx ty tz qx qy qz qw, by their stamps in ns."""
    stamps = sorted(poses)
    values = np.array([poses[stamp_ns] for stamp_ns in stamps])
    T_world_cam = np.tile(np.eye(4), (len(stamps), 1, 1))
    T_world_cam[:, :3, 3] = values[:, :3]
    T_world_cam[:, :3, :3] = Rotation.from_quat(values[:, 3:]).as_matrix()
    return Trajectory(np.array(stamps, dtype=np.int64), T_world_cam)


def write_tum(path: Path | str, trajectory: Trajectory) -> None:
    """Write a trajectory: stamps to the nanosecond, metres and quaternions to nine decimals.

    The file is written completely or not at all. Raises `TrajectoryFileError` if it cannot be.
    """
    path = Path(path)
    lines = ['# timestamp tx ty tz qx qy qz qw\n']
    if len(trajectory):
        rotations = Rotation.from_matrix(trajectory.T_world_cam[:, :3, :3])
        # Canonical (w >= 0), as q and -q are the same rotation and should be the same text.
        quaternions = rotations.as_quat(canonical=True)
        rows = np.hstack([trajectory.T_world_cam[:, :3, 3], quaternions])
        rows = np.round(rows, 9) + 0.0  # + 0.0: no '-0.000000000'
        for stamp_ns, row in zip(trajectory.stamps_ns, rows, strict=True):
            numbers = ' '.join(f'{value:.9f}' for value in row)
            lines.append(f'{format_stamp_ns(stamp_ns)} {numbers}\n')
    try:
        with replacing(path) as temporary:
            temporary.write_text(''.join(lines), encoding='ascii')
    except OSError as error:
        reason = error.strerror or error
        raise TrajectoryFileError(f'{path}: cannot be written: {reason}') from error


def data_rows(path: Path, scalar_last: bool = False) -> Iterator[tuple[int, list[str]]]:
    """Yield number and words of each line of a table that is no comment, heading or empty.

    Words are separated by blanks, commas or semicolons. With `scalar_last`, they are poses: in a
    table whose heading names w as the first part of the quaternion, it becomes the last. Raises
    `TrajectoryFileError` if the file cannot be read.
    """
    try:
        text = path.read_text(encoding='utf-8-sig', errors='replace')
    except OSError as error:
        raise TrajectoryFileError(f'{path}: cannot be read: {error.strerror}') from error
    heading, begun = '', False
    for number, line in enumerate(text.splitlines(), start=1):
        words = _words(line)
        if not words:
            continue
        if line.lstrip().startswith('#') or not (begun or _is_number(words[0])):
            heading += f' {line.lower()}'
            continue
        begun = True
        if scalar_last and _is_scalar_first(heading, words):
            words[4:8] = [*words[5:8], words[4]]
        yield number, words[:8] if scalar_last and len(words) == _EUROC_COLUMNS else words


def _words(line: str) -> list[str]:
    words = line.split()
    separated = len(words) == 1 or any(word.endswith((',', ';')) for word in words)
    return re.sub('[,;]', ' ', line).split() if separated else words


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _is_scalar_first(heading: str, words: list[str]) -> bool:
    """Return whether the quaternion of these columns begins with w, as its heading says."""
    quaternion = re.search(r'\bq\w*', heading)
    return len(words) >= 8 and quaternion is not None and quaternion[0].endswith('w')


def _notes(path: Path, faults: list[str], good: int, late: int) -> list[str]:
    """Return what was left out and what was sorted, a line each."""
    notes = []
    if faults:
        total = good + len(faults)
        notes.append(f'left out {len(faults)} of {total} poses; the first: {faults[0]}')
    if late:
        notes.append(f'{path}: {late} of {good} poses were not in order of their stamps')
    return notes


def parse_pose(words: Sequence[str]) -> tuple[int, list[float]]:
    """Return stamp in ns and seven numbers of a line's words; raises `ValueError`."""
    if len(words) != 8:
        raise ValueError(f'{len(words)} columns, not 8 (stamp tx ty tz qx qy qz qw)')
    row = [float(word) for word in words[1:]]
    if not np.isfinite(row).all():
        raise ValueError(f'pose is not finite: {" ".join(words[1:])}')
    norm = float(np.linalg.norm(row[3:]))
    if abs(norm - 1) > QUATERNION_NORM_TOLERANCE:
        raise ValueError(f'quaternion {" ".join(words[4:])} has length {norm:.4g}, not 1')
    return parse_stamp_ns(words[0]), row
