# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Ids between the nodes: one number for an epoch and an index, exact on the wire."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dcgs_ros.nodes.messages.ids import (
    EPOCH,
    EPOCHS,
    first_epoch,
    is_epoch,
    joined_ids,
    next_epoch,
    same_tracker,
    split_ids,
)

EPOCH_NUMBERS = st.integers(1, EPOCHS - 1)
INDICES = st.lists(st.integers(0, EPOCH - 1), max_size=20)


@given(EPOCH_NUMBERS, INDICES)
def test_what_was_joined_is_split_again(epoch: int, indices: list[int]) -> None:
    ids = np.array(indices, np.int64)
    epochs, found = split_ids(joined_ids(epoch, ids))
    np.testing.assert_array_equal(epochs, epoch)
    np.testing.assert_array_equal(found, ids)
    assert epochs.dtype == found.dtype == np.int64


@given(EPOCH_NUMBERS, INDICES)
def test_a_float64_holds_them_exactly(epoch: int, indices: list[int]) -> None:
    ids = joined_ids(epoch, np.array(indices, np.int64))
    np.testing.assert_array_equal(ids.astype('<f8').astype(np.int64), ids)
    assert (ids < 2**53).all()


@given(
    st.sets(st.tuples(EPOCH_NUMBERS, st.integers(0, EPOCH - 1)), max_size=20),
    st.sets(st.integers(-(2**53) + 1, -1), max_size=20),
)
def test_no_two_are_the_same(pairs: set[tuple[int, int]], own: set[int]) -> None:
    tracked = [int(joined_ids(e, np.array([k], np.int64))[0]) for e, k in pairs]
    assert len({*tracked, *own}) == len(pairs) + len(own)


@given(st.lists(st.integers(-(2**53) + 1, -1), max_size=20))
def test_the_mappers_own_are_of_no_epoch_and_stay_as_they_are(own: list[int]) -> None:
    ids = np.array(own, np.int64)
    epochs, found = split_ids(ids)
    np.testing.assert_array_equal(epochs, 0)
    np.testing.assert_array_equal(found, ids)


def test_the_limits_are_where_they_are_said_to_be() -> None:
    ids = np.array([-1, 0, EPOCH - 1, EPOCH, EPOCHS * EPOCH - 1], np.int64)
    epochs, found = split_ids(ids)
    assert epochs.tolist() == [0, 0, 0, 1, EPOCHS - 1]
    assert found.tolist() == [-1, 0, EPOCH - 1, 0, EPOCH - 1]


def test_the_maps_of_one_tracker_are_told_from_those_of_another() -> None:
    drawn = [first_epoch() for _ in range(200)]
    assert len(set(drawn)) > 195 and all(is_epoch(epoch) for epoch in drawn)
    assert sum(same_tracker(drawn[0], other) for other in drawn[1:]) < 4
    epoch, seen = drawn[0], {drawn[0]}
    for _ in range(100):
        epoch = next_epoch(epoch)
        assert is_epoch(epoch) and epoch not in seen and same_tracker(epoch, drawn[0])
        seen.add(epoch)
    assert not is_epoch(0) and not is_epoch(1) and not is_epoch(EPOCHS)
