# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The index files of TUM's RGB-D benchmark, which list the images and their stamps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from ...core.errors import FrameError
from ...io.images.decoding import read_depth_file
from ...io.trajectory import data_rows, parse_stamp_ns
from ..images.association import StampedPath
from ..images.pairing import PairedImages, pair_images, pair_rows
from ..options import SourceOptions
from ..source import SourceError

# TUM's tool writes the first; others are those of ORB-SLAM's users.
ASSOCIATIONS = ('associations.txt', 'associate.txt', 'association.txt', 'associated.txt')
_PROBED = 20  # rows, in search of a readable image that tells depth from colour


def read_pairs(folder: Path, options: SourceOptions) -> PairedImages:
    """Read `associations.txt`, or pair the images of `rgb.txt` and `depth.txt`; by colour stamp.

    Raises `SourceError` naming the file and line, the missing file, or the gap in time.
    """
    # All index files are read, needed or not: a damaged one is a sign of a damaged copy.
    read = {
        name: read_index(folder / name, images)
        for names, images in ((ASSOCIATIONS, 2), (('rgb.txt', 'depth.txt'), 1))
        for name in names
        if (folder / name).exists()
    }
    for name in ASSOCIATIONS:
        if name in read:
            rows, turned = _color_first(folder, read[name])
            found = pair_rows(folder, rows, options)
            note = (f'{folder / name}: lists depth before colour: columns are exchanged',)
            return found._replace(notes=(*(note if turned else ()), *found.notes))
    missing = [name for name in ('rgb.txt', 'depth.txt') if name not in read]
    if missing:
        raise SourceError(
            f'{folder} is no TUM dataset: there is neither {ASSOCIATIONS[0]} '
            f'nor {" and ".join(missing)} in it'
        )
    color, depth = ([row[0] for row in read[name]] for name in ('rgb.txt', 'depth.txt'))
    return pair_images(folder, color, depth, options)


def read_index(path: Path, images: int) -> list[tuple[StampedPath, ...]]:
    """Read an index file: `images` times `stamp path` per line, in the order of the file.

    Raises `SourceError` naming the file and the line, `TrajectoryFileError` if it is unreadable.
    """
    rows: list[tuple[StampedPath, ...]] = []
    for number, words in data_rows(path):
        try:
            rows.append(_parse_row(words, images))
        except ValueError as error:
            raise SourceError(f'{path}:{number}: {error}') from None
    if not rows:
        raise SourceError(f'{path}: names no image')
    return rows


def _parse_row(words: Sequence[str], images: int) -> tuple[StampedPath, ...]:
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


def _color_first(
    folder: Path, rows: list[tuple[StampedPath, ...]]
) -> tuple[list[tuple[StampedPath, ...]], bool]:
    """Return rows (colour, depth), and whether the columns were exchanged: depth has 16 bits."""
    for row in rows[:_PROBED]:
        is_depth = [_is_depth(folder, image.path) for image in row]
        if any(is_depth):
            turned = is_depth == [True, False]
            return ([(color, depth) for depth, color in rows] if turned else rows), turned
    return rows, False


def _is_depth(folder: Path, path: str) -> bool:
    try:
        read_depth_file(folder, path)
    except FrameError:
        return False
    return True


def check_inside(path: str) -> None:
    """Check that a path stays within the dataset's folder; raises `ValueError`."""
    if '\0' in path or any('\ud800' <= character <= '\udfff' for character in path):
        raise ValueError(f'{path!r} is not a path')
    if PurePosixPath(path).is_absolute() or '..' in PurePosixPath(path).parts:
        raise ValueError(f'{path} leads out of the dataset')
