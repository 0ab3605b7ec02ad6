# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Stamps are brought in order: nothing is lost but what is wrong, and all of it is said."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dcgs_ros.datasets.images.stamps import OrderedStamps, order_stamps
from dcgs_ros.datasets.source import SourceError

STEP_NS = 33_000_000
HOUR_NS = 3_600_000_000_000
STAMPS_NS = 10**18 + STEP_NS * np.arange(40)


def ordered(stamps_ns: NDArray[np.int64], shifts_ns: tuple[int, ...] = ()) -> OrderedStamps:
    return order_stamps(stamps_ns, 'colour', lambda k: f'{k}.png', shifts_ns)


def changed(at: int | slice, by_ns: int) -> NDArray[np.int64]:
    stamps_ns = STAMPS_NS.copy()
    stamps_ns[at] += by_ns
    return stamps_ns


def test_what_increases_stays_as_it_is() -> None:
    found = ordered(STAMPS_NS)
    np.testing.assert_array_equal(found.stamps_ns, STAMPS_NS)
    np.testing.assert_array_equal(found.images, np.arange(40))
    assert not found.notes


@given(st.lists(st.integers(0, 10**9), max_size=30))
def test_within_a_second_stamps_are_sorted_and_each_counts_once(stamps: list[int]) -> None:
    try:
        found = ordered(np.array(stamps, np.int64))
    except SourceError:
        assert 2 * len(set(stamps)) <= len(stamps)
        return
    kept = [stamp for stamp in set(stamps) if stamps.count(stamp) < 3]
    assert found.stamps_ns.tolist() == sorted(kept)
    assert [stamps[k] for k in found.images] == found.stamps_ns.tolist()
    assert bool(found.notes) == (len(kept) < len(stamps))


@pytest.mark.parametrize('by_ns', [HOUR_NS, -HOUR_NS, -(10**18)])
@pytest.mark.parametrize('at', [0, 7, 20, 39, slice(5, 8)])
def test_outliers_are_left_out_one_by_one(at: int | slice, by_ns: int) -> None:
    found = ordered(changed(at, by_ns))
    out = np.arange(40)[at].reshape(-1)
    np.testing.assert_array_equal(found.images, np.setdiff1d(np.arange(40), out))
    np.testing.assert_array_equal(found.stamps_ns, STAMPS_NS[found.images])
    (note,) = found.notes
    assert note.startswith(f'colour: {len(out)} of 40 images are left out')
    assert f'the first: {out[0]}.png' in note


@pytest.mark.parametrize('by_ns', [-2 * 10**9, -HOUR_NS])
def test_a_clock_that_was_set_back_goes_on(by_ns: int) -> None:
    found = ordered(changed(slice(25, None), by_ns))
    np.testing.assert_array_equal(found.images, np.arange(40))
    np.testing.assert_array_equal(found.stamps_ns, STAMPS_NS)
    assert found.shifts_ns == (-by_ns,)
    (note,) = found.notes
    assert f'set back by {(-by_ns - STEP_NS) / 1e9:.3f} s at 25.png, image 26 of 40' in note


def test_depth_is_moved_by_as_much_as_colour() -> None:
    """Its own interval across the step may be another."""
    color = ordered(changed(slice(25, None), -HOUR_NS))
    depth_ns = changed(slice(25, None), -HOUR_NS) + 4_000_000
    depth_ns = np.delete(depth_ns, 25)
    depth = ordered(depth_ns, color.shifts_ns)
    np.testing.assert_array_equal(depth.stamps_ns, np.delete(STAMPS_NS, 25) + 4_000_000)


def test_images_without_stamps_are_left_out_where_most_have_one() -> None:
    stamps_ns = STAMPS_NS.copy()
    stamps_ns[:10] = 0
    found = ordered(stamps_ns)
    np.testing.assert_array_equal(found.images, np.arange(10, 40))
    assert 'colour: 10 of 40' in found.notes[0]


@pytest.mark.parametrize('stamps', [[0] * 30, [7] * 3, [0] * 15 + [1] * 15])
def test_missing_stamps_are_told_with_the_remedy(stamps: list[int]) -> None:
    with pytest.raises(SourceError, match=r'stamps are missing.*--rate-hz 30'):
        ordered(np.array(stamps))


def test_stamps_in_no_order_are_refused() -> None:
    stamps_ns = np.random.default_rng(0).permutation(100) * 10**10
    with pytest.raises(SourceError, match=r'step back \d+ times .* in no order'):
        ordered(stamps_ns)
