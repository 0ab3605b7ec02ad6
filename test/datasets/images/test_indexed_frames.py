# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Frames by their numbers: stamps and poses."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import folders  # type: ignore[import-not-found]
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.datasets.images.indexed_frames import indexed_trajectory, stamp_of_index
from dcgs_ros.datasets.parsing.pose_matrices import parse_matrix


@given(st.integers(0, 10**9))
def test_a_frames_stamp_is_its_time_rounded_once(number: int) -> None:
    stamp_ns = stamp_of_index(number)
    assert abs(Fraction(stamp_ns) - Fraction(number * 10**9, 30)) < Fraction(1, 2)
    assert round(Fraction(stamp_ns, 10**9) * 30) == number
    assert stamp_of_index(number + 1) > stamp_ns


TWISTS = st.lists(st.floats(-3, 3), min_size=6, max_size=6).map(np.array)


@given(TWISTS)
def test_a_written_pose_reads_back(twist: NDArray[np.float64]) -> None:
    T = se3.exp(twist)
    truth = indexed_trajectory(Path('traj.txt'), {7: parse_matrix(folders.matrix_row(T))})
    assert truth.stamps_ns.tolist() == [stamp_of_index(7)]
    np.testing.assert_allclose(truth.T_world_cam[0], T, atol=folders.POSE_TOLERANCE)
