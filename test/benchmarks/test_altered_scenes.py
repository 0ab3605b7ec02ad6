# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Another room of the same shape, one with the same furniture, and a way beside the path."""

from __future__ import annotations

import numpy as np

from benchmarks.altered_scenes import Altered, rearranged, redecorated
from dcgs_ros.core import se3
from dcgs_ros.datasets.synthetic.scenes.catalogue import build_scenario

SCENE = build_scenario('room', 0).scene
STAMP_NS = 1_000_000_000_000


def test_a_redecorated_room_has_the_same_shape_and_other_looks() -> None:
    other = redecorated(SCENE, np.random.default_rng(1))
    np.testing.assert_array_equal(other.centres, SCENE.centres)
    np.testing.assert_array_equal(other.R_world_local, SCENE.R_world_local)
    np.testing.assert_array_equal(other.textures < 0, SCENE.textures < 0)
    moved = np.abs(other.mappings[:, 1:] - SCENE.mappings[:, 1:]).max(axis=1)
    assert np.median(moved) > 0.1 and np.mean(other.textures != SCENE.textures) > 0.3


def test_a_rearranged_room_has_the_same_walls_and_furniture_elsewhere() -> None:
    other = rearranged(SCENE, np.random.default_rng(1))
    large = SCENE.halves.max(axis=1) > 2.0
    assert 2 <= np.count_nonzero(large) < 5
    np.testing.assert_array_equal(other.centres[large], SCENE.centres[large])
    np.testing.assert_array_equal(other.textures, SCENE.textures)
    np.testing.assert_array_equal(other.mappings[~large], SCENE.mappings[~large])
    assert np.all(other.mappings[large, 1:] != SCENE.mappings[large, 1:])
    way = np.linalg.norm(other.centres - SCENE.centres, axis=1)[~large]
    assert np.median(way) > 0.3
    np.testing.assert_allclose(np.linalg.det(other.R_world_local), 1.0)


def test_the_way_is_beside_the_path_by_one_motion() -> None:
    """But for the shake of the hand, which is another one."""
    address = 'synthetic:room?seed=0'
    for k in range(3):
        one, other = (Altered(address, np.random.default_rng(seed)) for seed in (k, k + 10))
        at = [STAMP_NS + 500_000_000 * n for n in range(4)]
        asides = [se3.inverse(one.pose(ns)) @ other.pose(ns) for ns in at]
        np.testing.assert_allclose(asides, np.tile(asides[0], (4, 1, 1)), atol=1e-9)
        xi = se3.log(asides[0])
        assert 0.02 < np.linalg.norm(xi[:3]) < 1.0 and 0.02 < np.linalg.norm(xi[3:]) < 1.0
