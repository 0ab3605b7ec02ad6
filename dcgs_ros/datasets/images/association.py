# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Which colour and depth images form a frame: pairs of close stamps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...io.trajectory import format_stamp_ns
from ..source import SourceError

MAX_PAIR_GAP_NS = 20_000_000  # between the stamps of colour and depth of one frame, at 25 Hz
LARGEST_PAIR_GAP_NS = 100_000_000  # that the tracker takes
_MANY_UNPAIRED = 0.1  # of the colour images, which deserve a note


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


def pair_gap_ns(
    color_ns: NDArray[np.int64], depth_ns: NDArray[np.int64], slop_s: float | None
) -> int:
    """Return how far the stamps of a frame may be apart: `slop_s`, or by the rate of the images.

    That is half the interval of the faster stream: the nearest image is never farther.
    """
    if slop_s is not None:
        return round(1e9 * slop_s)
    halves = [np.median(np.diff(stamps)) / 2 for stamps in (color_ns, depth_ns) if len(stamps) > 1]
    return int(np.clip(min(halves, default=0), MAX_PAIR_GAP_NS, LARGEST_PAIR_GAP_NS))


def pair_stamps(
    color_ns: NDArray[np.int64], depth_ns: NDArray[np.int64], slop_s: float | None, name: str
) -> tuple[list[tuple[int, int]], tuple[str, ...]]:
    """Pair increasing stamps within `pair_gap_ns`; return indices, and a note if many are left.

    Raises `SourceError`, which begins with `name`, if no two are that close.
    """
    gap_ns = pair_gap_ns(color_ns, depth_ns, slop_s)
    matched = associate_stamps(color_ns, depth_ns, gap_ns)
    if not matched:
        raise no_overlap(name, color_ns, depth_ns, gap_ns)
    left = len(color_ns) - len(matched)
    if left <= _MANY_UNPAIRED * len(color_ns):
        return matched, ()
    note = (
        f'{left} of {len(color_ns)} colour images have no depth image of their own within '
        f'{gap_ns / 1e6:.0f} ms and are left out (--sync-slop-s {gap_ns / 1e9:g})'
    )
    return matched, (note,)


def no_overlap(
    name: str, color_ns: NDArray[np.int64], depth_ns: NDArray[np.int64], gap_ns: int
) -> SourceError:
    """Return the error that no colour image has a depth image close in time."""
    if not len(color_ns) or not len(depth_ns):
        return SourceError(f'{name}: {len(color_ns)} colour and {len(depth_ns)} depth images')
    ranges = [
        f'{format_stamp_ns(stamps.min())} to {format_stamp_ns(stamps.max())} s'
        for stamps in (color_ns, depth_ns)
    ]
    gaps = [int(np.abs(depth_ns - stamp_ns).min()) for stamp_ns in color_ns]
    remedy = ''
    if min(gaps) <= LARGEST_PAIR_GAP_NS:
        remedy = f'; --sync-slop-s {np.ceil(min(gaps) / 1e6 + 1) / 1e3:g} or more pairs some'
    return SourceError(
        f'{name}: none of {len(color_ns)} colour images has a depth image within '
        f'{gap_ns / 1e6:.0f} ms: colour {ranges[0]}, depth {ranges[1]}, '
        f'gaps {min(gaps) / 1e6:.1f} to {max(gaps) / 1e6:.1f} ms{remedy}'
    )
