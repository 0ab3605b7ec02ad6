# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The keyframes and loops that corrections are timed with."""

from __future__ import annotations

from benchmarks.corrections import COLUMNS, rows


def test_right_loops_are_looked_for_and_kept() -> None:
    """The first lap has 183 keyframes; every third one after that has a loop."""
    row = dict(zip(COLUMNS, next(rows(200)), strict=True))
    assert row['right ones kept'] == '6 of 6'
    assert int(row['corrections']) > 0
