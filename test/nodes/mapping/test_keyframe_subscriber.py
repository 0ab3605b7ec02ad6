# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Messages of a keyframe are joined by their stamp, in any order of arrival."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip('rclpy')

from dcgs_ros.nodes.mapping.keyframe_subscriber import Joiner


@given(st.permutations([(name, k) for name in 'abc' for k in range(4)]))
def test_parts_join_by_stamp_in_any_order(arrivals: list[tuple[str, int]]) -> None:
    joiner = Joiner('abc', capacity=4)
    joined = [joiner.add(name, k, f'{name}{k}') for name, k in arrivals]
    complete = [parts for parts in joined if parts is not None]
    expected = [{name: f'{name}{k}' for name in 'abc'} for k in range(4)]
    assert sorted(complete, key=lambda parts: parts['a']) == expected
    assert joiner.dropped == 0


def test_what_stays_incomplete_is_dropped_oldest_first() -> None:
    joiner = Joiner(['a', 'b'], capacity=3)
    for k in range(10):
        assert joiner.add('a', k, k) is None
    assert joiner.dropped == 7
    assert [joiner.add('b', k, k) for k in (7, 8, 9)] == [{'a': k, 'b': k} for k in (7, 8, 9)]


@pytest.mark.parametrize('capacity', [1, 3])
def test_a_part_that_comes_twice_counts_once(capacity: int) -> None:
    joiner = Joiner(['a', 'b'], capacity)
    assert joiner.add('a', 5, 'old') is None
    assert joiner.add('a', 5, 'new') is None
    assert joiner.add('b', 5, 'b') == {'a': 'new', 'b': 'b'}
