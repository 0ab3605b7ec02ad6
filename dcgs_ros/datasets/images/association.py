# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Which colour and depth images form a frame: pairs of close stamps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...io.trajectory import format_stamp_ns
from ..source import SourceError

MAX_PAIR_GAP_NS = 20_000_000  # between the stamps of colour and depth of one frame


class StampedPath(NamedTuple):
    """An image file and its stamp."""

    stamp_ns: int
    path: str  # relative to the dataset's folder


class StampPair(NamedTuple):
    """The two images of a frame, not yet read."""

    color: StampedPath
    depth: StampedPath


def associate_stamps(
    first_ns: NDArray[np.int64], second_ns: NDArray[np.int64], max_gap_ns: int
) -> list[tuple[int, int]]:
    """Pair two increasing lists of stamps one to one, the closest first; indices (i, j) by i.

    This is what TUM's own associate.py does: a stamp whose nearest is taken gets the next one.
    """
    low = np.searchsorted(second_ns, first_ns - max_gap_ns, side='left')
    high = np.searchsorted(second_ns, first_ns + max_gap_ns, side='right')
    candidates = sorted(
        (abs(int(second_ns[j] - first_ns[i])), i, j)
        for i in range(len(first_ns))
        for j in range(low[i], high[i])
    )
    partner: dict[int, int] = {}
    taken: set[int] = set()
    for _, i, j in candidates:
        if i not in partner and j not in taken:
            partner[i] = j
            taken.add(j)
    return sorted(partner.items())


def pair_images(
    folder: Path, color: Sequence[StampedPath], depth: Sequence[StampedPath]
) -> list[StampPair]:
    """Pair images, given in order of their stamps, within `MAX_PAIR_GAP_NS`.

    Raises `SourceError` if no two are that close.
    """
    color_ns, depth_ns = (
        np.array([image.stamp_ns for image in images], dtype=np.int64) for images in (color, depth)
    )
    matched = associate_stamps(color_ns, depth_ns, MAX_PAIR_GAP_NS)
    if not matched:
        raise no_overlap(folder, color, depth)
    return [StampPair(color[i], depth[j]) for i, j in matched]


def no_overlap(
    folder: Path, color: Sequence[StampedPath], depth: Sequence[StampedPath]
) -> SourceError:
    """Return the error that no colour image has a depth image close in time."""
    ranges = [
        f'{format_stamp_ns(images[0].stamp_ns)} to {format_stamp_ns(images[-1].stamp_ns)} s'
        for images in (color, depth)
    ]
    stamps = np.array([image.stamp_ns for image in depth])
    gaps = [int(np.abs(stamps - image.stamp_ns).min()) for image in color]
    return SourceError(
        f'{folder}: none of {len(color)} colour images has a depth image within '
        f'{MAX_PAIR_GAP_NS / 1e6:.0f} ms: colour {ranges[0]}, depth {ranges[1]}, '
        f'gaps {min(gaps) / 1e6:.1f} to {max(gaps) / 1e6:.1f} ms'
    )
