# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Corrections of a few views, carried over to the frames between them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.mapping.corrections import Corrections
from dcgs_ros.core.mapping.exposure import Exposure

EXACT = 1e-12
FLOAT32 = 1e-6
START_NS = 1_700_000_000_000_000_000  # a double holds it to 256 ns only
STAMPS_NS = START_NS + np.array([0, 200_000_000, 233_333_333, 1_000_000_000], np.int64)


def poses(seed: int, count: int, size: float) -> NDArray[np.float64]:
    twists = np.random.default_rng(seed).normal(scale=size, size=(count, 6))
    return np.array([se3.exp(xi) for xi in twists])


def exposures(seed: int, count: int) -> list[Exposure]:
    rng = np.random.default_rng(seed)
    return [
        Exposure(
            rng.uniform(0.7, 1.4, 3).astype(np.float32), rng.normal(size=3).astype(np.float32)
        )
        for _ in range(count)
    ]


def none() -> Exposure:
    return Exposure(np.ones(3, np.float32), np.zeros(3, np.float32))


TRACKED = poses(0, 4, 1.0)
CHANGES = poses(1, 4, 0.02)
REFINED = TRACKED @ CHANGES
EXPOSURES = exposures(2, 4)


def corrections() -> Corrections:
    return Corrections(STAMPS_NS, TRACKED, REFINED, EXPOSURES)


def assert_exposure(
    found: Exposure, gain: NDArray[np.floating], offset: NDArray[np.floating]
) -> None:
    np.testing.assert_allclose(found.gain, gain, atol=FLOAT32)
    np.testing.assert_allclose(found.offset, offset, atol=FLOAT32)
    assert found.gain.dtype == found.offset.dtype == np.float32


def test_where_nothing_was_corrected_every_pose_stays() -> None:
    nothing = Corrections(STAMPS_NS, TRACKED, TRACKED, [none()] * 4)
    for T in poses(3, 5, 1.0):
        np.testing.assert_allclose(nothing.pose(START_NS + 77, T), T, atol=EXACT)
    assert_exposure(nothing.exposure(START_NS + 77), np.ones(3), np.zeros(3))


def test_at_a_views_stamp_its_own_correction_holds() -> None:
    for k, stamp_ns in enumerate(STAMPS_NS.tolist()):
        pose = corrections().pose(stamp_ns, TRACKED[k])
        np.testing.assert_allclose(pose, REFINED[k], atol=EXACT)
        assert_exposure(corrections().exposure(stamp_ns), EXPOSURES[k].gain, EXPOSURES[k].offset)


def test_a_correction_is_of_the_camera_wherever_it_is() -> None:
    T = poses(4, 1, 2.0)[0]
    pose = corrections().pose(int(STAMPS_NS[2]), T)
    np.testing.assert_allclose(pose, T @ CHANGES[2], atol=EXACT)


@pytest.mark.parametrize('share', [0.1, 0.5, 0.9])
@pytest.mark.parametrize('k', [0, 1, 2])
def test_between_two_views_twist_and_exposure_change_evenly(k: int, share: float) -> None:
    stamp_ns = int(STAMPS_NS[k] + round(share * int(STAMPS_NS[k + 1] - STAMPS_NS[k])))
    share = (stamp_ns - int(STAMPS_NS[k])) / int(STAMPS_NS[k + 1] - STAMPS_NS[k])
    xi = (1 - share) * se3.log(CHANGES[k]) + share * se3.log(CHANGES[k + 1])
    T = poses(5, 1, 1.0)[0]
    np.testing.assert_allclose(corrections().pose(stamp_ns, T), T @ se3.exp(xi), atol=EXACT)
    a, b = EXPOSURES[k], EXPOSURES[k + 1]
    assert_exposure(
        corrections().exposure(stamp_ns),
        (1 - share) * a.gain + share * b.gain, (1 - share) * a.offset + share * b.offset,
    )  # fmt: skip


def test_before_the_first_and_after_the_last_view_theirs_hold() -> None:
    T = poses(6, 1, 1.0)[0]
    for k, away_ns in ((0, -1), (0, -(10**12)), (3, 1), (3, 10**12)):
        stamp_ns = int(STAMPS_NS[k]) + away_ns
        np.testing.assert_allclose(corrections().pose(stamp_ns, T), T @ CHANGES[k], atol=EXACT)
        assert_exposure(corrections().exposure(stamp_ns), EXPOSURES[k].gain, EXPOSURES[k].offset)


def test_one_view_speaks_for_all() -> None:
    alone = Corrections(STAMPS_NS[:1], TRACKED[:1], REFINED[:1], EXPOSURES[:1])
    T = poses(7, 1, 1.0)[0]
    for stamp_ns in (START_NS - 5, START_NS, START_NS + 10**10):
        np.testing.assert_allclose(alone.pose(stamp_ns, T), T @ CHANGES[0], atol=EXACT)
        assert_exposure(alone.exposure(stamp_ns), EXPOSURES[0].gain, EXPOSURES[0].offset)


def test_what_comes_out_is_a_rigid_motion() -> None:
    T = poses(8, 1, 3.0)[0]
    for stamp_ns in range(START_NS, START_NS + 10**9, 10**8):
        found = corrections().pose(stamp_ns, T)
        np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=EXACT)
        np.testing.assert_array_equal(found[3], [0, 0, 0, 1])
