# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Options behind an address are those of the flags."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcgs_ros.core.config.schema import ConfigError
from dcgs_ros.datasets.options import SourceOptions, join_options, split_options

OPTIONS = st.builds(
    SourceOptions,
    st.none() | st.floats(1, 1e6),
    st.none() | st.floats(0, 0.1),
    st.none() | st.floats(1e-3, 1e4),
)
ADDRESSES = st.sampled_from(['/a/b', 'a b.bag', 'x?color=/c/image&depth=/d', 'x?color=/c'])


@given(ADDRESSES, OPTIONS, OPTIONS)
def test_joined_options_are_split_off_and_the_last_ones_count(
    address: str, first: SourceOptions, last: SourceOptions
) -> None:
    assert split_options(join_options(address, first)) == (address, first)
    twice = split_options(join_options(join_options(address, first), last))
    assert twice == split_options(join_options(address, first), last)


def test_what_is_no_option_stays(tmp_path: Path) -> None:
    assert split_options('x?color=/a&rate_hz=30') == ('x?color=/a', SourceOptions(rate_hz=30))
    assert split_options('synthetic:room?rate_hz=30')[0] == 'synthetic:room?rate_hz=30'
    named = tmp_path / 'x?rate_hz=30'
    named.mkdir()
    assert split_options(str(named)) == (str(named), SourceOptions())


@pytest.mark.parametrize('query', ['depth_per_metre=0', 'depth_per_metre=mm', 'sync_slop_s=5'])
def test_a_value_out_of_range_is_named(query: str) -> None:
    with pytest.raises(ConfigError, match=query.partition('=')[0]):
        split_options(f'x?{query}')
