# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Stamps of recorded images brought in order: outliers are dropped, clocks set back are undone."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ...io.trajectory import format_stamp_ns
from ..source import SourceError

_DISORDER_NS = 1_000_000_000  # a larger step back is of another clock
_MAX_OUTLIERS = 0.1  # of the images: more of them have a clock of their own
_FAR_NS = 600_000_000_000  # of the first or last image from all others
_MAX_CLOCKS = 20  # more steps back are no clock


@dataclass(frozen=True)
class OrderedStamps:
    """Increasing stamps, and whose they are."""

    stamps_ns: NDArray[np.int64]  # (M,)
    images: NDArray[np.int64]  # (M,) indices of the images as they were recorded
    shifts_ns: tuple[int, ...] = ()  # by which each clock but the first was moved on
    notes: tuple[str, ...] = ()  # what was changed, for the user


def order_stamps(
    stamps_ns: NDArray[np.int64],
    name: str,
    label: Callable[[int], str],
    shifts_ns: tuple[int, ...] = (),
) -> OrderedStamps:
    """Order the stamps (N,) of one stream of images, given as they were recorded.

    Small disorder is sorted. Images are left out whose stamp is that of others, or out of order
    while nine tenths are in order. Otherwise the clock was set back: what follows is moved on, by
    the colour's `shifts_ns` if there are as many, so that colour and depth stay together. `name`
    and `label`, which names an image by its index, are for notes and errors. Raises `SourceError`
    where stamps are missing or in no order at all.
    """
    recorded = np.asarray(stamps_ns, np.int64)
    if (np.diff(recorded) > 0).all() and not _far_ends(recorded):
        return OrderedStamps(recorded, np.arange(len(recorded)))
    images = _with_stamps(recorded, name)
    moved = recorded.copy()
    shifts: tuple[int, ...] = ()
    notes: list[str] = []
    if np.diff(recorded[images]).min(initial=0) < -_DISORDER_NS:
        longest = images[_longest_increasing(recorded[images])]
        if len(images) - len(longest) <= max(1, _MAX_OUTLIERS * len(recorded)):
            images = longest
        else:
            shifts, notes = _undo_steps(moved, images, shifts_ns, name, label)
    _, first = np.unique(moved[images], return_index=True)
    images = images[first]
    while ends := _far_ends(moved[images]):
        images = np.delete(images, ends)
    notes += _left_out(recorded, images, name, label)
    return OrderedStamps(moved[images], images, shifts, tuple(notes))


def _left_out(
    recorded: NDArray[np.int64],
    images: NDArray[np.int64],
    name: str,
    label: Callable[[int], str],
) -> list[str]:
    """Return a note about all but these `images`, if there are others."""
    others = np.setdiff1d(np.arange(len(recorded)), images)
    if not len(others):
        return []
    return [
        f'{name}: {len(others)} of {len(recorded)} images are left out, as their stamps are '
        f'repeated, out of order or far from the others; the first: {label(int(others[0]))} at '
        f'{format_stamp_ns(recorded[others[0]])} s'
    ]


def _with_stamps(stamps_ns: NDArray[np.int64], name: str) -> NDArray[np.int64]:
    """Return the images whose stamp is one: not shared by three or more."""
    values, inverse, counts = np.unique(stamps_ns, return_inverse=True, return_counts=True)
    most = int(counts.argmax())
    if counts[most] > 2 and 2 * len(values) <= len(stamps_ns):
        raise SourceError(
            f'{name}: {len(stamps_ns)} images have {len(values)} different stamps, '
            f'{counts[most]} of them {format_stamp_ns(values[most])} s: stamps are missing. If '
            'the images are in order, give their rate: --rate-hz 30'
        )
    return np.flatnonzero(counts[inverse.ravel()] <= 2)


def _far_ends(stamps_ns: NDArray[np.int64]) -> list[int]:
    """Return the first or the last index (0, -1) where that stamp is far from all others."""
    steps = np.diff(stamps_ns)
    if len(steps) < 3:
        return []
    far_ns = max(_FAR_NS, 100 * float(np.median(steps)))
    return [end for end in (0, -1) if steps[end] > far_ns][:1]


def _longest_increasing(values: NDArray[np.int64]) -> list[int]:
    """Return the indices of a longest strictly increasing subsequence (patience sorting)."""
    tails: list[int] = []  # smallest last value of a subsequence of each length
    last: list[int] = []  # and its index
    before: list[int] = []
    for k, value in enumerate(values.tolist()):
        at = bisect_left(tails, value)
        before.append(last[at - 1] if at else -1)
        tails[at : at + 1], last[at : at + 1] = [value], [k]
    chain, k = [], last[-1]
    while k >= 0:
        chain.append(k)
        k = before[k]
    return chain[::-1]


def _undo_steps(
    moved: NDArray[np.int64],
    images: NDArray[np.int64],
    given_ns: tuple[int, ...],
    name: str,
    label: Callable[[int], str],
) -> tuple[tuple[int, ...], list[str]]:
    """Move on, in place, the stamps after each step back; return by how much, and the notes."""
    steps = np.diff(moved[images])
    breaks = np.flatnonzero(steps < -_DISORDER_NS) + 1
    if len(breaks) >= _MAX_CLOCKS:
        raise SourceError(
            f'{name}: stamps of {len(images)} images step back {len(breaks)} times by more than '
            f'{_DISORDER_NS / 1e9:g} s, the first time at {label(int(images[breaks[0]]))}: they '
            'are in no order. If the images are, give their rate: --rate-hz 30'
        )
    interval_ns = int(np.median(steps[steps > 0])) if (steps > 0).any() else 1
    parts = np.split(images, breaks)
    shifts, notes = [], []
    for k, (earlier, part) in enumerate(pairwise(parts)):
        shift = int(moved[earlier].max()) + interval_ns - int(moved[part].min())
        if len(given_ns) == len(breaks):
            shift = given_ns[k]
        back_s = -int(steps[breaks[k] - 1]) / 1e9
        notes.append(
            f'{name}: the clock was set back by {back_s:.3f} s at {label(int(part[0]))}, image '
            f'{part[0] + 1} of {len(moved)}: the stamps from there are moved on by '
            f'{shift / 1e9:.3f} s'
        )
        moved[part] += shift
        shifts.append(shift)
    return tuple(shifts), notes
