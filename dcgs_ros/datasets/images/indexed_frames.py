# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Sequences whose files carry a number instead of a stamp."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.trajectory import Trajectory
from ..poses import rigid_trajectory
from ..source import SourceError
from .association import Entry, StampPair

RATE_HZ = Fraction(30)  # of every camera whose frames are only numbered


def stamp_of(number: int, rate_hz: Fraction = RATE_HZ) -> int:
    """Stamp, nanoseconds, of a frame by its number from 0, rounded once."""
    return round(Fraction(number * 10**9) / rate_hz)


def numbered_pairs(folder: Path, color: str, depth: str) -> list[StampPair]:
    """Pair the files by the number that the one group of each regex catches.

    Before its last slash a regex is the name of a folder in `folder`. Raises `SourceError` where
    no number has both images.
    """
    colors, depths = (_numbered(folder, regex) for regex in (color, depth))
    both = sorted(colors.keys() & depths.keys())
    if not both:
        raise SourceError(
            f'{folder}: none of {len(colors)} colour images ({color}) has the number of one of '
            f'{len(depths)} depth images ({depth})'
        )
    return [
        StampPair(*(Entry(stamp_of(number), names[number]) for names in (colors, depths)))
        for number in both
    ]


def numbered_poses(path: Path, poses: Mapping[int, NDArray[np.float64]]) -> Trajectory:
    """Make a trajectory of the `poses` (4, 4) that are rigid, by frame number, increasing.

    Raises `SourceError` with `path` where none is: how a matrix should read was misunderstood.
    """
    stamps_ns = np.array([stamp_of(number) for number in poses], dtype=np.int64)
    truth = rigid_trajectory(stamps_ns, np.array(list(poses.values())).reshape(-1, 4, 4))
    if truth is None:
        raise SourceError(f'{path}: none of {len(poses)} poses is a rotation and a translation')
    return truth


def _numbered(folder: Path, regex: str) -> dict[int, str]:
    """Find the files' paths, relative to the folder, by their numbers."""
    within, name = os.path.split(regex)
    try:
        names = sorted(os.listdir(folder / within))
    except OSError as error:
        raise SourceError(f'{folder / within}: cannot be read: {error.strerror}') from error
    matches = ((re.fullmatch(name, found), found) for found in names)
    return {int(match[1]): os.path.join(within, found) for match, found in matches if match}
