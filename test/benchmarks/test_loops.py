# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Which loops are wrong, and the laps that are driven."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.long_walk import period_ns
from benchmarks.loops import COLUMNS, Errors, Score, addresses
from dcgs_ros.core import se3
from dcgs_ros.core.backend.closure import Loop
from dcgs_ros.core.trajectory import Trajectory
from dcgs_ros.datasets.synthetic.options import parse_address

STAMPS_NS = np.array([10, 20, 30], np.int64) * 10**9
TRUTH = Trajectory(STAMPS_NS, np.array([se3.exp(np.full(6, 0.1 * k)) for k in range(3)]))


def loop(xi: NDArray[np.float64], sigma: float) -> Loop:
    """Between the first and the last keyframe, off by a twist, with an error claimed."""
    T = se3.inverse(TRUTH.T_world_cam[0]) @ TRUTH.T_world_cam[2] @ se3.exp(xi)
    return Loop(0, 2, T, sigma**2 * np.eye(6) / 3, inliers=100)


@pytest.mark.parametrize(
    ('metres', 'degrees', 'sigma', 'wrong'),
    [
        (0.0, 0.0, 1e-3, False),
        (0.09, 0.0, 1e-3, False),
        (0.11, 0.0, 1e-3, True),
        (0.11, 0.0, 0.04, False),  # within 3 sigma
        (0.13, 0.0, 0.04, True),
        (0.0, 2.9, 1e-3, False),
        (0.0, 3.1, 1e-3, True),
    ],
)
def test_a_loop_is_wrong_beyond_both_limits(
    metres: float, degrees: float, sigma: float, wrong: bool
) -> None:
    xi = np.array([metres, 0.0, 0.0, 0.0, math.radians(degrees), 0.0])
    errors = Errors.of([loop(xi, sigma)], STAMPS_NS, TRUTH)
    assert errors.wrong.tolist() == [wrong]
    assert errors.radians[0] == pytest.approx(math.radians(degrees), abs=1e-9)


def test_without_loops_there_are_no_errors() -> None:
    errors = Errors.of([], STAMPS_NS, TRUTH)
    assert len(errors.metres) == len(errors.radians) == len(errors.wrong) == 0


def test_half_of_the_laps_go_either_way_and_half_of_the_floors_repeat() -> None:
    rings = [parse_address(address)[1] for address in addresses(range(8)) if 'ring' in address]
    kinds = [(ring.direction, ring.period) for ring in rings]
    assert {kinds.count(kind) for kind in kinds} == {2} and len(set(kinds)) == 4
    assert [ring.seed for ring in rings] == list(range(8))


def test_a_row_has_a_cell_for_each_column() -> None:
    score = Score('', 1, 1, 1, 0, 0, 0, 1, 1, 0, 1, {'ok': 3}, 1, 0, (1, 2), 1, 1, 1)
    assert len(score.cells()) == len(COLUMNS)
    assert '3/0/0/0' in score.cells()


def test_a_recording_begins_again_one_interval_after_its_end() -> None:
    assert period_ns(STAMPS_NS) == 30 * 10**9
