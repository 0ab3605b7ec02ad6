# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Images found by patterns of file names, paired by their order or by stamps in the names."""

from __future__ import annotations

import os
import re
from fnmatch import fnmatchcase
from fractions import Fraction
from itertools import pairwise
from pathlib import Path, PurePosixPath

from ...io.trajectory import format_stamp_ns, parse_stamp_ns
from ..options import SourceOptions
from ..source import SourceError
from .association import StampedPath
from .pairing import PairedImages, pair_images, pair_in_order


def pair_by_order(folder: Path, color: str, depth: str, rate_hz: Fraction) -> PairedImages:
    """Pair the images that two patterns find in the order of names; frame i is at i / rate s.

    Raises `SourceError` if a pattern finds nothing, or they find different numbers of images.
    """
    colors, depths = find_images(folder, color), find_images(folder, depth)
    try:
        return pair_in_order(folder, colors, depths, rate_hz)
    except SourceError as error:
        raise SourceError(f'{error} ({color}, {depth})') from None


def pair_by_name(folder: Path, color: str, depth: str, options: SourceOptions) -> PairedImages:
    """Pair the images that two patterns find by their stamps: names without suffix, in seconds.

    Raises `SourceError` naming a file whose name is not a stamp, or with the gap in time between
    colour and depth.
    """
    return pair_images(folder, _stamped(folder, color), _stamped(folder, depth), options)


def find_images(folder: Path, pattern: str) -> list[str]:
    """Return the paths that match the pattern, in natural order: 2.png before 10.png.

    Paths are relative to the folder. Only the last part of the pattern may have wildcards. Raises
    `SourceError` if nothing matches.
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
    """Return a sort key that compares runs of digits by value."""
    parts = re.split('([0-9]+)', name)
    return [(int(part), part) if k % 2 else (0, part) for k, part in enumerate(parts)]


def _stamped(folder: Path, pattern: str) -> list[StampedPath]:
    images = []
    for path in find_images(folder, pattern):
        try:
            images.append(StampedPath(parse_stamp_ns(PurePosixPath(path).stem), path))
        except ValueError as error:
            raise SourceError(f'{folder / path}: {error}') from None
    images.sort()
    for before, after in pairwise(images):
        if before.stamp_ns == after.stamp_ns:
            raise SourceError(
                f'{folder / after.path}: stamp {format_stamp_ns(after.stamp_ns)} a second time'
            )
    return images
