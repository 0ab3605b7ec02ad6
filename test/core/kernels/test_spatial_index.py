# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The voxel hash against brute force and scipy's k-d tree."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dcgs_ros.core import se3
from dcgs_ros.core.kernels import jit
from dcgs_ros.core.kernels.spatial_index import VoxelIndex

CELL_M = 0.0625
DISTANCE_M = 1e-6
RADII = {'far below the cell': 0.01, 'below': 0.03125, 'cell': CELL_M, 'above': 0.2}


def clusters(count: int, seed: int) -> NDArray[np.float32]:
    """Points (N, 3) in clumps about both signs of the coordinates, some of them twice."""
    rng = np.random.default_rng(seed)
    centres = rng.uniform(-1.0, 1.0, (8, 3))
    points = centres[rng.integers(8, size=count)] + rng.normal(scale=0.08, size=(count, 3))
    points[: count // 10] = points[count // 2 : count // 2 + count // 10]
    return points.astype(np.float32)


def lattice(count: int, seed: int) -> NDArray[np.float32]:
    """Points on a grid of 1/64 m: all distances are exact, many are equal, many cells' borders."""
    return (np.random.default_rng(seed).integers(-12, 12, (count, 3)) / 64).astype(np.float32)


def slots_of(points: NDArray[np.floating]) -> NDArray[np.int32]:
    return np.arange(len(points), dtype=np.int32)


def index_of(points: NDArray[np.float32], cell_m: float = CELL_M) -> VoxelIndex:
    index = VoxelIndex(cell_m)
    index.insert(points, slots_of(points))
    return index


def brute_nearest(
    points: NDArray[np.float32],
    queries: NDArray[np.float32],
    radius_m: float,
    alive: NDArray[np.bool_] | None = None,
) -> NDArray[np.int64]:
    """Lowest slot of the nearest points within the radius, else -1."""
    square = ((queries[:, None].astype(np.float64) - points[None]) ** 2).sum(axis=2)
    if alive is not None:
        square[:, ~alive] = np.inf
    best = square.argmin(axis=1)
    return np.where(square[np.arange(len(queries)), best] <= radius_m**2, best, -1)


@pytest.mark.parametrize('radius_m', RADII.values(), ids=list(RADII))
def test_nearest_is_scipys(radius_m: float) -> None:
    points, queries = clusters(3000, seed=1), clusters(1000, seed=2)
    queries[:200] = points[300:500]
    found = index_of(points).nearest(points, queries, radius_m)
    distances, _ = cKDTree(points).query(queries, distance_upper_bound=radius_m)
    np.testing.assert_array_equal(found >= 0, np.isfinite(distances))
    hit = found >= 0
    reached = np.linalg.norm(points[found[hit]].astype(np.float64) - queries[hit], axis=1)
    np.testing.assert_allclose(reached, distances[hit], atol=DISTANCE_M)
    assert 20 < hit.sum()


@pytest.mark.parametrize('radius_m', RADII.values(), ids=list(RADII))
def test_ties_go_to_the_lower_slot(radius_m: float) -> None:
    points, queries = lattice(2000, seed=3), lattice(500, seed=4)
    queries[250:] += np.float32(1 / 128)  # between the grid's points: eight are equally near
    found = index_of(points).nearest(points, queries, radius_m)
    np.testing.assert_array_equal(found, brute_nearest(points, queries, radius_m))


def test_order_of_insertion_does_not_matter() -> None:
    points, queries = lattice(2000, seed=5), lattice(500, seed=6)
    shuffled = VoxelIndex(CELL_M)
    order = np.random.default_rng(7).permutation(slots_of(points))
    for part in np.array_split(order, 7):
        shuffled.insert(points, part)
    np.testing.assert_array_equal(
        shuffled.nearest(points, queries, 0.1),
        index_of(points).nearest(points, queries, 0.1),
    )


@pytest.mark.parametrize('cell_m', [0.01, 0.06, 0.5])
def test_the_cell_does_not_matter(cell_m: float) -> None:
    points, queries = clusters(2000, seed=8), clusters(500, seed=9)
    np.testing.assert_array_equal(
        index_of(points, cell_m).nearest(points, queries, 0.05),
        brute_nearest(points, queries, 0.05),
    )


def test_growth_from_nothing() -> None:
    """Point by point through several sizes of the table and of the chains."""
    points = np.random.default_rng(10).uniform(-3, 3, (20_000, 3)).astype(np.float32)
    index = VoxelIndex(CELL_M)
    for part in np.array_split(slots_of(points), 50):
        index.insert(points, part)
    np.testing.assert_array_equal(index.nearest(points, points, 0.01), slots_of(points))


def test_nothing_is_near_in_an_empty_index() -> None:
    points = np.empty((0, 3), np.float32)
    queries = clusters(10, seed=11)
    index = index_of(points)
    np.testing.assert_array_equal(index.nearest(points, queries, 0.1), -1)
    assert len(index.nearest(points, points, 0.1)) == 0
    rays, reach = np.tile(np.array([0, 0, 1], np.float32), (10, 1)), np.full(10, 0.1, np.float32)
    assert not index.covered(points, queries, rays, reach, reach).any()


@pytest.mark.parametrize('seed', range(3))
def test_what_is_removed_is_not_found_and_the_rest_is(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, queries = lattice(2000, seed=20 + seed), lattice(500, seed=30 + seed)
    index, alive = index_of(points), np.ones(len(points), np.bool_)
    for _ in range(4):
        gone = rng.choice(np.flatnonzero(alive), 400, replace=False).astype(np.int32)
        index.remove(points, gone)
        alive[gone] = False
        np.testing.assert_array_equal(
            index.nearest(points, queries, 0.1), brute_nearest(points, queries, 0.1, alive)
        )
    index.insert(points, gone)
    alive[gone] = True
    np.testing.assert_array_equal(
        index.nearest(points, queries, 0.1), brute_nearest(points, queries, 0.1, alive)
    )


edits = st.lists(
    st.tuples(st.sampled_from(['insert', 'remove', 'move']), st.integers(0, 2**31)),
    min_size=1,
    max_size=8,
)


@settings(max_examples=40, deadline=None)
@given(edits)
def test_any_history_leads_to_the_same_answers(history: list[tuple[str, int]]) -> None:
    """After inserting, removing and moving in any order: as if built from what is alive."""
    points, queries = lattice(300, seed=40), lattice(100, seed=41)
    index, alive = VoxelIndex(CELL_M), np.zeros(len(points), np.bool_)
    for action, seed in history:
        rng = np.random.default_rng(seed)
        candidates = np.flatnonzero(~alive if action == 'insert' else alive).astype(np.int32)
        chosen = rng.permutation(candidates)[: rng.integers(1, 200)]
        if action != 'insert':
            index.remove(points, chosen)
        if action == 'move':
            points[chosen] = lattice(len(chosen), seed)
        if action != 'remove':
            index.insert(points, chosen)
        alive[chosen] = action != 'remove'
        np.testing.assert_array_equal(
            index.nearest(points, queries, 0.1), brute_nearest(points, queries, 0.1, alive)
        )


def test_many_moves_do_not_let_the_table_grow_without_bound() -> None:
    """A hundred points that wander: only the cells in use need a place."""
    rng = np.random.default_rng(42)
    points = rng.uniform(-1, 1, (100, 3)).astype(np.float32)
    index = index_of(points)
    fresh = sum(a.nbytes for a in vars(index).values() if isinstance(a, np.ndarray))
    for _ in range(500):
        index.remove(points, slots_of(points))
        points[:] = rng.uniform(-50, 50, (100, 3))
        index.insert(points, slots_of(points))
    size = sum(a.nbytes for a in vars(index).values() if isinstance(a, np.ndarray))
    assert size <= 4 * fresh
    np.testing.assert_array_equal(index.nearest(points, points, 0.01), slots_of(points))


def test_moved_queries_are_the_motion_and_then_the_search() -> None:
    points = clusters(3000, seed=12)
    T = se3.exp(np.random.default_rng(13).normal(scale=0.3, size=6))
    local = clusters(1000, seed=14)
    queries = local @ T[:3, :3].T + T[:3, 3]
    found = np.full(len(local), -1, np.int32)
    index_of(points).nearest_moved(points, local, T, 0.05, found)
    square = ((queries[:, None] - points[None]) ** 2).sum(axis=2)
    expected = np.where(square.min(axis=1) <= 0.05**2, square.argmin(axis=1), -1)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize('guesses', ['right', 'random', 'far', 'mixed'])
def test_a_first_guess_does_not_change_the_answer(guesses: str) -> None:
    points, queries = lattice(2000, seed=15), lattice(500, seed=16)
    expected = brute_nearest(points, queries, 0.1)
    rng = np.random.default_rng(17)
    slots = {
        'right': expected,
        'random': rng.integers(0, 2000, 500),
        'far': np.full(500, ((points - queries[0]) ** 2).sum(axis=1).argmax()),
        'mixed': rng.choice([-1, 5, 1000], 500),
    }[guesses].astype(np.int32)
    index_of(points).nearest_moved(points, queries, np.eye(4), 0.1, slots)
    np.testing.assert_array_equal(slots, expected)


def test_threads_do_not_matter() -> None:
    points, queries = clusters(3000, seed=18), clusters(1000, seed=19)
    index = index_of(points)
    jit.set_threads(1)
    one = index.nearest(points, queries, 0.1)
    jit.set_threads(None)
    np.testing.assert_array_equal(one, index.nearest(points, queries, 0.1))


@pytest.mark.parametrize('share', [0.9, 1.1])
def test_the_rim_of_the_cylinder_is_covered_too(share: float) -> None:
    """Along a diagonal ray the rim reaches farther on one axis than the cylinder is long."""
    query = np.array([[0.5 * CELL_M, 0.5 * CELL_M, 0.5 * CELL_M]], np.float32)
    ray = np.array([[1, 1, 0]], np.float32) / np.sqrt(np.float32(2))
    reach = np.array([0.4 * CELL_M], np.float32)
    rim = reach * share * (ray + np.array([[1, -1, 0]], np.float32) / np.sqrt(np.float32(2)))
    points = query + rim
    found = index_of(points).covered(points, query, ray, reach, reach)
    assert found[0] == (share < 1)


@pytest.mark.parametrize('ratio', [0.2, 1.0, 4.0])
@pytest.mark.parametrize('across_m', [0.01, 0.05, 0.1])
def test_covered_is_brute_force(across_m: float, ratio: float) -> None:
    """A point within `across` of the ray's line, and within `along` of the query along it."""
    rng = np.random.default_rng(50)
    points = rng.uniform(-0.5, 0.5, (1500, 3)).astype(np.float32)
    queries = rng.uniform(-0.6, 0.6, (800, 3)).astype(np.float32)
    rays = rng.normal(size=(800, 3))
    rays = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)
    across = rng.uniform(0.5, 1.0, 800).astype(np.float32) * np.float32(across_m)
    along = across * np.float32(ratio)
    offsets = points[None].astype(np.float64) - queries[:, None]
    axial = np.einsum('qpk,qk->qp', offsets, rays.astype(np.float64))
    square = (offsets**2).sum(axis=2) - axial**2
    inside = (np.abs(axial) <= along[:, None]) & (square <= across[:, None] ** 2)
    expected = inside.any(axis=1)
    assert expected.sum() < 800
    found = index_of(points).covered(points, queries, rays, across, along)
    np.testing.assert_array_equal(found, expected)
    gone = rng.permutation(slots_of(points))[:700]
    index = index_of(points)
    index.remove(points, gone)
    inside[:, gone] = False
    np.testing.assert_array_equal(
        index.covered(points, queries, rays, across, along), inside.any(axis=1)
    )
