# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Images that patterns of file names find, paired by their order or by the names themselves."""

from __future__ import annotations

import os
import re
from fnmatch import fnmatchcase
from fractions import Fraction
from itertools import pairwise
from pathlib import Path, PurePosixPath

from ...io.trajectory import format_stamp_ns, parse_stamp_ns
from ..source import SourceError
from ..tum.index import pair_images
from .association import Entry, StampPair
from .indexed_frames import stamp_of


def pair_by_order(folder: Path, color: str, depth: str, rate_hz: Fraction) -> list[StampPair]:
    """Pair what two patterns find, in the order of the names; frame i is at i / rate seconds.

    Raises `SourceError` where one finds nothing, or the other another number of images.
    """
    colors, depths = find_images(folder, color), find_images(folder, depth)
    if len(colors) != len(depths):
        raise SourceError(
            f'{folder}: {color} finds {len(colors)} images, {depth} {len(depths)}: in order, '
            'they pair only if they are equally many'
        )
    stamps = (stamp_of(number, rate_hz) for number in range(len(colors)))
    return [
        StampPair(Entry(stamp, first), Entry(stamp, second))
        for stamp, first, second in zip(stamps, colors, depths, strict=True)
    ]


def pair_by_name(folder: Path, color: str, depth: str) -> list[StampPair]:
    """Pair what two patterns find by the stamps, seconds, that the names are without suffix.

    Raises `SourceError` naming the file whose name is no stamp, or saying how far apart in time
    colour and depth are.
    """
    return pair_images(folder, _stamped(folder, color), _stamped(folder, depth))


def find_images(folder: Path, pattern: str) -> list[str]:
    """Paths, relative to the folder, that match the pattern, in natural order: 2.png, 10.png.

    Only the pattern's last part has wildcards. Raises `SourceError` where there is none.
    """
    within, name = os.path.split(pattern)
    try:
        names = [found for found in os.listdir(folder / within) if fnmatchcase(found, name)]
    except OSError as error:
        raise SourceError(f'{folder / within}: cannot be read: {error.strerror}') from error
    if not names:
        raise SourceError(f'{folder}: no image is called {pattern}')
    return [os.path.join(within, found) for found in sorted(names, key=_natural)]


def _natural(name: str) -> list[tuple[int, str]]:
    """Sort digits by their value: words and numbers alternate."""
    parts = re.split('([0-9]+)', name)
    return [(int(part), part) if k % 2 else (0, part) for k, part in enumerate(parts)]


def _stamped(folder: Path, pattern: str) -> list[Entry]:
    entries = []
    for path in find_images(folder, pattern):
        try:
            entries.append(Entry(parse_stamp_ns(PurePosixPath(path).stem), path))
        except ValueError as error:
            raise SourceError(f'{folder / path}: {error}') from None
    entries.sort()
    for before, after in pairwise(entries):
        if before.stamp_ns == after.stamp_ns:
            raise SourceError(
                f'{folder / after.path}: stamp {format_stamp_ns(after.stamp_ns)} a second time'
            )
    return entries
