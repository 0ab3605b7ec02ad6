# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Sequences whose files carry a frame number instead of a stamp."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.trajectory import Trajectory
from ..parsing.pose_matrices import rigid_trajectory
from ..source import SourceError
from .association import StampedPath, StampPair

RATE_HZ = Fraction(30)  # of the cameras of all datasets without stamps


def stamp_of_index(index: int, rate_hz: Fraction | float | None = None) -> int:
    """Return the stamp, nanoseconds, of a frame by its index from 0: index / rate, rounded.

    The rate is `RATE_HZ` if it is None.
    """
    return round(Fraction(index * 10**9) / Fraction(rate_hz or RATE_HZ))


def pair_by_index(
    folder: Path, color: str, depth: str, rate_hz: float | None = None
) -> list[StampPair]:
    """Pair the files that two regexes find by the frame number, the only group of each regex.

    The part of a regex before its last slash is a subfolder's name. Raises `SourceError` if no
    number has both images.
    """
    colors, depths = (_paths_by_index(folder, regex) for regex in (color, depth))
    both = sorted(colors.keys() & depths.keys())
    if not both:
        raise SourceError(
            f'{folder}: none of {len(colors)} colour images ({color}) has the number of one of '
            f'{len(depths)} depth images ({depth})'
        )
    return [
        StampPair(
            *(
                StampedPath(stamp_of_index(index, rate_hz), paths[index])
                for paths in (colors, depths)
            )
        )
        for index in both
    ]


def indexed_trajectory(
    path: Path, poses: Mapping[int, NDArray[np.float64]], rate_hz: float | None = None
) -> Trajectory:
    """Return the trajectory of those `poses` (4, 4), by increasing frame index, that are rigid.

    Raises `SourceError` with `path` if none is, as the file then has another convention.
    """
    stamps_ns = np.array([stamp_of_index(index, rate_hz) for index in poses], dtype=np.int64)
    truth = rigid_trajectory(stamps_ns, np.array(list(poses.values())).reshape(-1, 4, 4))
    if truth is None:
        raise SourceError(f'{path}: none of {len(poses)} poses is a rotation and a translation')
    return truth


def _paths_by_index(folder: Path, regex: str) -> dict[int, str]:
    """Find the files' paths, relative to the folder, by their frame numbers."""
    within, name = os.path.split(regex)
    try:
        names = sorted(os.listdir(folder / within))
    except OSError as error:
        raise SourceError(f'{folder / within}: cannot be read: {error.strerror}') from error
    matches = ((re.fullmatch(name, found), found) for found in names)
    return {int(match[1]): os.path.join(within, found) for match, found in matches if match}
