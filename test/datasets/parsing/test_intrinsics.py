# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Intrinsics given as text."""

from __future__ import annotations

import pytest

from dcgs_ros.datasets.parsing.intrinsics import parse_intrinsics
from dcgs_ros.datasets.source import SourceError


@pytest.mark.parametrize('count', [4, 8, 9, 12])
def test_intrinsics_are_parsed_in_order(count: int) -> None:
    numbers = [500.0, 501.0, 320.0, 240.0, *(0.001 * k for k in range(1, 9))][:count]
    camera = parse_intrinsics(','.join(map(str, numbers)), 640, 480)
    assert [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion] == numbers


@pytest.mark.parametrize('text', ['fr9', '1,2,3', '500,500,320,x', '-500,500,320,240', ''])
def test_unusable_intrinsics_are_refused(text: str) -> None:
    with pytest.raises(SourceError, match='camera'):
        parse_intrinsics(text, 640, 480)
