# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Pairing of stamps, against its definition and TUM's own association."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dcgs_ros.datasets.images.association import MAX_PAIR_GAP_NS, associate_stamps

STAMPS = st.lists(st.integers(0, 500), unique=True, max_size=25).map(sorted)


@given(STAMPS, STAMPS, st.integers(0, 60))
def test_association_is_greedy_and_one_to_one(a: list[int], b: list[int], gap: int) -> None:
    pairs = associate_stamps(np.array(a, np.int64), np.array(b, np.int64), gap)
    first, second = {i for i, _ in pairs}, {j for _, j in pairs}
    assert len(pairs) == len(first) == len(second)
    assert [i for i, _ in pairs] == sorted(first)
    cost = {('a', i): abs(a[i] - b[j]) for i, j in pairs}
    cost |= {('b', j): abs(a[i] - b[j]) for i, j in pairs}
    assert all(value <= gap for value in cost.values())
    for i, stamp_a in enumerate(a):
        for j, stamp_b in enumerate(b):
            distance = abs(stamp_a - stamp_b)
            if distance <= gap:  # then one of the two has a partner at most as far away
                partners = [cost[key] for key in (('a', i), ('b', j)) if key in cost]
                assert min(partners, default=gap + 1) <= distance


@pytest.mark.parametrize('name', ['tum_fr3_teddy_200', 'mini_fr1_xyz_vga_120'])
def test_own_association_is_the_published_one(data_dir: Path, name: str) -> None:
    def stamps(file: str) -> NDArray[np.int64]:
        lines = (data_dir / name / file).read_text().splitlines()
        rows = [line.split() for line in lines if not line.startswith('#')]
        return np.array([int(row[0].replace('.', '')) * 1000 for row in rows])

    color, depth = stamps('rgb.txt'), stamps('depth.txt')
    pairs = associate_stamps(color, depth, MAX_PAIR_GAP_NS)
    published = stamps('associations.txt')
    assert [color[i] for i, _ in pairs] == list(published)
