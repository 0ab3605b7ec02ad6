# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The index files of TUM's RGB-D benchmark, which list the images and their stamps."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from ...io.trajectory import format_stamp_ns, parse_stamp_ns
from ..images.association import (
    MAX_PAIR_GAP_NS,
    StampedPath,
    StampPair,
    no_overlap,
    pair_images,
)
from ..source import SourceError


def read_pairs(folder: Path) -> list[StampPair]:
    """Read `associations.txt`, or pair the images of `rgb.txt` and `depth.txt`; by colour stamp.

    Raises `SourceError` naming the file and line, the missing file, or the gap in time.
    """
    # All index files are read, needed or not: a damaged one is a sign of a damaged copy.
    read = {
        name: read_index(folder / name, images)
        for name, images in (('associations.txt', 2), ('rgb.txt', 1), ('depth.txt', 1))
        if (folder / name).exists()
    }
    if 'associations.txt' in read:
        pairs = [StampPair(color, depth) for color, depth in read['associations.txt']]
        gaps = [abs(pair.color.stamp_ns - pair.depth.stamp_ns) for pair in pairs]
        if min(gaps) > MAX_PAIR_GAP_NS:
            raise no_overlap(folder, *zip(*pairs, strict=True))
        return pairs
    missing = [name for name in ('rgb.txt', 'depth.txt') if name not in read]
    if missing:
        raise SourceError(
            f'{folder} is no TUM dataset: there is neither associations.txt '
            f'nor {" and ".join(missing)} in it'
        )
    color, depth = ([row[0] for row in read[name]] for name in ('rgb.txt', 'depth.txt'))
    return pair_images(folder, color, depth)


def read_index(path: Path, images: int) -> list[tuple[StampedPath, ...]]:
    """Read an index file: `images` times `stamp path` per line, stamps increasing.

    Raises `SourceError` naming the file and the line.
    """
    rows: list[tuple[StampedPath, ...]] = []
    try:
        lines = path.read_text(encoding='utf-8', errors='replace').splitlines()
    except OSError as error:
        raise SourceError(f'{path}: cannot be read: {error.strerror}') from error
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith('#'):
            continue
        try:
            row = _parse_row(line, images)
            if rows:
                _check_order(rows[-1], row)
        except ValueError as error:
            raise SourceError(f'{path}:{number}: {error}') from None
        rows.append(row)
    if not rows:
        raise SourceError(f'{path}: names no image')
    return rows


def _parse_row(line: str, images: int) -> tuple[StampedPath, ...]:
    words = line.split()
    if len(words) != 2 * images:
        raise ValueError(
            f'{len(words)} columns, not {2 * images} ({" ".join(["stamp path"] * images)})'
        )
    for path in words[1::2]:
        check_inside(path)
    return tuple(
        StampedPath(parse_stamp_ns(stamp), path)
        for stamp, path in zip(words[::2], words[1::2], strict=True)
    )


def check_inside(path: str) -> None:
    """Check that a path stays within the dataset's folder; raises `ValueError`."""
    if '\0' in path or any('\ud800' <= character <= '\udfff' for character in path):
        raise ValueError(f'{path!r} is not a path')
    if PurePosixPath(path).is_absolute() or '..' in PurePosixPath(path).parts:
        raise ValueError(f'{path} leads out of the dataset')


def _check_order(before: tuple[StampedPath, ...], row: tuple[StampedPath, ...]) -> None:
    for earlier, later in zip(before, row, strict=True):
        if later.stamp_ns == earlier.stamp_ns:
            raise ValueError(f'stamp {format_stamp_ns(later.stamp_ns)} a second time')
        if later.stamp_ns < earlier.stamp_ns:
            raise ValueError(
                f'stamp {format_stamp_ns(later.stamp_ns)} comes after the later '
                f'{format_stamp_ns(earlier.stamp_ns)}'
            )
