# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Which colour and depth images belong together: pairs of stamps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

MAX_PAIR_GAP_NS = 20_000_000  # colour and depth farther apart in time are no pair


class Entry(NamedTuple):
    """One image of an index file."""

    stamp_ns: int
    path: str  # relative to the dataset's folder


class StampPair(NamedTuple):
    """One frame before it is read."""

    color: Entry
    depth: Entry


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
