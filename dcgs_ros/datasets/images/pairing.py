# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Frames of listed image files: colour and depth paired by their stamps, or by their order."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..options import SourceOptions
from ..source import SourceError
from .association import StampedPath, StampPair, no_overlap, pair_gap_ns, pair_stamps
from .indexed_frames import stamp_of_index
from .stamps import OrderedStamps, order_stamps


class PairedImages(NamedTuple):
    """Pairs by colour's stamp, and what was changed or left out to get them."""

    pairs: list[StampPair]
    notes: tuple[str, ...] = ()


def pair_images(
    folder: Path,
    color: Sequence[StampedPath],
    depth: Sequence[StampedPath],
    options: SourceOptions,
) -> PairedImages:
    """Pair two lists of images by their stamps, or in their order at `options.rate_hz`.

    Raises `SourceError` if stamps are missing, or no two are close.
    """
    if options.rate_hz is not None:
        return _listed_in_order(folder, color, depth, options.rate_hz)
    first = _ordered(folder, color, 'colour')
    second = _ordered(folder, depth, 'depth', first.shifts_ns)
    matched, unpaired = pair_stamps(
        first.stamps_ns, second.stamps_ns, options.sync_slop_s, str(folder)
    )
    colors, depths = (
        [
            StampedPath(int(stamp_ns), images[k].path)
            for stamp_ns, k in zip(ordered.stamps_ns, ordered.images, strict=True)
        ]
        for ordered, images in ((first, color), (second, depth))
    )
    pairs = [StampPair(colors[i], depths[j]) for i, j in matched]
    return PairedImages(pairs, (*first.notes, *second.notes, *unpaired))


def pair_rows(
    folder: Path, rows: Sequence[tuple[StampedPath, ...]], options: SourceOptions
) -> PairedImages:
    """Return the frames of rows (colour, depth), of which several may share their depth.

    Raises `SourceError` if stamps are missing, or no row's are close.
    """
    if options.rate_hz is not None:
        colors, depths = zip(*rows, strict=True)
        return _listed_in_order(folder, colors, depths, options.rate_hz)
    ordered = _ordered(folder, [row[0] for row in rows], 'colour')
    pairs = []
    for stamp_ns, k in zip(ordered.stamps_ns.tolist(), ordered.images.tolist(), strict=True):
        color, depth = rows[k]
        lag_ns = depth.stamp_ns - color.stamp_ns
        moved = StampedPath(stamp_ns, color.path), StampedPath(stamp_ns + lag_ns, depth.path)
        pairs.append(StampPair(*moved))
    color_ns = np.array([pair.color.stamp_ns for pair in pairs])
    depth_ns = np.array([pair.depth.stamp_ns for pair in pairs])
    gap_ns = pair_gap_ns(color_ns, np.unique(depth_ns), options.sync_slop_s)
    if np.abs(color_ns - depth_ns).min() > gap_ns:
        raise no_overlap(str(folder), color_ns, depth_ns, gap_ns)
    return PairedImages(pairs, ordered.notes)


def pair_in_order(
    folder: Path, color: Sequence[str], depth: Sequence[str], rate_hz: Fraction
) -> PairedImages:
    """Pair two lists of images in their order; frame i is at i / rate seconds.

    Raises `SourceError` if their numbers differ.
    """
    if len(color) != len(depth):
        raise SourceError(
            f'{folder}: {len(color)} colour and {len(depth)} depth images: images can be paired '
            'by order only if their numbers are equal'
        )
    stamps = (stamp_of_index(index, rate_hz) for index in range(len(color)))
    return PairedImages(
        [
            StampPair(StampedPath(stamp, first), StampedPath(stamp, second))
            for stamp, first, second in zip(stamps, color, depth, strict=True)
        ]
    )


def _listed_in_order(
    folder: Path, color: Sequence[StampedPath], depth: Sequence[StampedPath], rate_hz: float
) -> PairedImages:
    colors, depths = ([image.path for image in images] for images in (color, depth))
    return pair_in_order(folder, colors, depths, Fraction(rate_hz))


def _ordered(
    folder: Path, images: Sequence[StampedPath], name: str, shifts_ns: tuple[int, ...] = ()
) -> OrderedStamps:
    stamps_ns = np.array([image.stamp_ns for image in images], np.int64)
    return order_stamps(stamps_ns, f'{folder}: {name}', lambda k: images[k].path, shifts_ns)
