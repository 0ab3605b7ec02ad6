# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Identity, index and viewpoints of the map's Gaussians."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.kernels import jit
from dcgs_ros.core.sensor import SensorNoise
from dcgs_ros.core.tracking.gaussian_map import GaussianMap

CELL_M = 0.06
COVARIANCE = 1e-5  # relative, float32
SENSOR = SensorNoise.structured_light()
HIDDEN_M = 0.3  # far beyond any noise
PINHOLE = PinholeCamera(320, 240, 262.0, 262.0, 159.5, 119.5)
DISTORTED = PinholeCamera(
    320, 240, 258.6, 258.2, 159.3, 127.6, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
)


def scattered(count: int, seed: int | tuple[int, int]) -> NDArray[np.float32]:
    """Points (N, 3), all farther apart than rounding."""
    return np.random.default_rng(seed).uniform(-2, 2, (count, 3)).astype(np.float32)


def add(
    gaussians: GaussianMap,
    means: NDArray[np.float32],
    viewpoint: tuple[float, float, float] = (0.0, 0.0, 0.0),
    host: int = 0,
) -> NDArray[np.int64]:
    n = len(means)
    normals = np.tile(np.array([0, 0, -1], np.float32), (n, 1))
    return gaussians.add(means, normals, np.zeros(n, np.float32), np.array(viewpoint), host)


def found(gaussians: GaussianMap, queries: NDArray[np.float32]) -> NDArray[np.int64]:
    """Ids of what lies exactly there, or -1."""
    slots = gaussians.index.nearest(gaussians.means, queries, 1e-4)
    return np.where(slots >= 0, gaussians.ids[slots], -1)


def test_rows_belong_together() -> None:
    rng = np.random.default_rng(1)
    gaussians, means = GaussianMap(CELL_M), scattered(50, seed=2)
    normals = rng.normal(size=(50, 3)).astype(np.float32)
    flatness = rng.random(50).astype(np.float32)
    ids = gaussians.add(means, normals, flatness, np.array([1.0, 2.0, 3.0]), 7)
    assert len(gaussians) == 50 == len(np.unique(ids))
    np.testing.assert_array_equal(gaussians.ids, ids)
    np.testing.assert_array_equal(gaussians.means, means)
    np.testing.assert_array_equal(gaussians.normals, normals)
    np.testing.assert_array_equal(gaussians.flatness, flatness)
    np.testing.assert_array_equal(gaussians.viewpoints, [[1, 2, 3]] * 50)
    np.testing.assert_array_equal(gaussians.hosts, 7)


def test_growth_keeps_what_is_there() -> None:
    gaussians, batches = GaussianMap(CELL_M), [scattered(3000, seed) for seed in range(12)]
    ids = [add(gaussians, means, host=k) for k, means in enumerate(batches)]
    assert len(gaussians) == 36_000
    for k, means in enumerate(batches):
        np.testing.assert_array_equal(found(gaussians, means), ids[k])
        slots = gaussians.index.nearest(gaussians.means, means, 1e-4)
        np.testing.assert_array_equal(gaussians.hosts[slots], k)


def test_ids_are_never_used_again_but_slots_are() -> None:
    gaussians = GaussianMap(CELL_M)
    first = add(gaussians, scattered(100, seed=3))
    slots = len(gaussians.means)
    gaussians.remove(first[::2])
    second = add(gaussians, scattered(50, seed=4))
    assert len(gaussians.means) == slots and len(gaussians) == 100
    assert not set(first) & set(second)
    third = add(gaussians, scattered(10, seed=5))
    assert len(gaussians) == 110 and len(gaussians.means) == slots + 10
    assert not set(third) & (set(first) | set(second))


def test_a_removed_gaussian_leaves_no_trace() -> None:
    gaussians, means = GaussianMap(CELL_M), scattered(100, seed=6)
    ids = add(gaussians, means)
    gaussians.remove(ids[10:20])
    gone = np.zeros(100, np.bool_)
    gone[10:20] = True
    np.testing.assert_array_equal(found(gaussians, means), np.where(gone, -1, ids))
    assert (gaussians.ids[gone] == -1).all() and np.isnan(gaussians.means[gone]).all()
    assert np.isfinite(gaussians.means[~gone]).all()


def test_removing_what_is_gone_or_never_was_changes_nothing() -> None:
    gaussians, means = GaussianMap(CELL_M), scattered(20, seed=7)
    ids = add(gaussians, means)
    gaussians.remove(ids[:5])
    gaussians.remove(np.concatenate([ids[:5], ids[:5], [-1, 999]]))
    gaussians.remove(np.empty(0, np.int64))
    assert len(gaussians) == 15
    fresh = add(gaussians, scattered(10, seed=8))
    assert len(gaussians) == 25 == len(gaussians.means)
    assert len(np.unique(np.concatenate([ids, fresh]))) == 30


def test_the_same_id_twice_is_removed_once() -> None:
    gaussians = GaussianMap(CELL_M)
    ids = add(gaussians, scattered(20, seed=9))
    gaussians.remove(np.concatenate([ids[:5], ids[:5]]))
    assert len(gaussians) == 15
    add(gaussians, scattered(10, seed=10))
    assert len(gaussians) == 25 == len(gaussians.means)


def test_another_shape_is_each_ones_own_and_moves_nobody() -> None:
    gaussians, means, rng = GaussianMap(CELL_M), scattered(100, seed=11), np.random.default_rng(12)
    ids = add(gaussians, means, (1.0, 2.0, 3.0), host=5)
    chosen = rng.permutation(ids)[:40]
    flatness = rng.random(40).astype(np.float32)
    normals = rng.normal(size=(40, 3)).astype(np.float32)
    normals[:, 2] = -np.abs(normals[:, 2])  # on the side they were
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    between = normals + np.array([0, 0, -1])
    between /= np.linalg.norm(between, axis=1, keepdims=True)
    gaussians.reshape(chosen, normals, flatness)
    slots = gaussians.index.nearest(gaussians.means, means[chosen], 1e-4)
    np.testing.assert_array_equal(gaussians.ids[slots], chosen)
    np.testing.assert_allclose(gaussians.normals[slots], between, atol=1e-6)
    np.testing.assert_array_equal(gaussians.flatness[slots], flatness)
    np.testing.assert_array_equal(found(gaussians, means), ids)
    np.testing.assert_array_equal(gaussians.means, means)
    np.testing.assert_array_equal(gaussians.viewpoints, [[1, 2, 3]] * 100)
    np.testing.assert_array_equal(gaussians.hosts, 5)
    rest = np.setdiff1d(ids, chosen)
    np.testing.assert_array_equal(gaussians.normals[rest], [[0, 0, -1]] * 60)
    np.testing.assert_array_equal(gaussians.flatness[rest], 0)


def test_a_normal_keeps_its_side() -> None:
    """Either direction of an axis of Sigma_r may come; across the old one both are as good."""
    gaussians = GaussianMap(CELL_M)
    ids = add(gaussians, scattered(3, seed=20))  # normals (0, 0, -1)
    tilted = np.array([[0.6, 0, 0.8], [0.6, 0, -0.8], [1, 0, 0]], np.float32)
    gaussians.reshape(ids, tilted, np.zeros(3, np.float32))
    halves = np.array([[-0.3, 0, -0.9], [0.3, 0, -0.9], [0.5, 0, -0.5]])
    halves /= np.linalg.norm(halves, axis=1, keepdims=True)
    np.testing.assert_allclose(gaussians.normals, halves, atol=1e-6)


def test_a_shape_of_what_is_gone_or_never_was_is_passed_over() -> None:
    gaussians = GaussianMap(CELL_M)
    ids = add(gaussians, scattered(30, seed=21))
    gaussians.remove(ids[10:20])
    asked = np.array([999, 12, 3, -1, 15, 25, 30], np.int64)
    flatness = np.arange(1, 8, dtype=np.float32)
    gaussians.reshape(asked, np.tile(np.array([0, 0, -1], np.float32), (7, 1)), flatness)
    expected = np.zeros(30)
    expected[[3, 25]] = flatness[[2, 5]]
    living = gaussians.ids >= 0
    assert len(gaussians) == 20 == living.sum()
    np.testing.assert_array_equal(gaussians.flatness[living], expected[living])
    gaussians.reshape(np.empty(0, np.int64), np.empty((0, 3), 'f4'), np.empty(0, 'f4'))


def test_an_empty_map_passes_over_all_of_it() -> None:
    gaussians = GaussianMap(CELL_M)
    gaussians.reshape(np.arange(3), np.ones((3, 3), np.float32), np.zeros(3, np.float32))
    gaussians.remove(np.arange(3))
    assert len(gaussians) == 0 and not gaussians.alive(np.arange(3)).any()


def test_alive_are_those_added_and_not_removed() -> None:
    gaussians = GaussianMap(CELL_M)
    ids = add(gaussians, scattered(10, seed=24))
    gaussians.remove(ids[::2])
    add(gaussians, scattered(4, seed=25))  # into the free slots
    asked = np.array([-5, -1, 0, 1, 2, 9, 10, 13, 14, 10**12])
    expected = [False, False, False, True, False, True, True, True, False, False]
    before = asked.copy()
    np.testing.assert_array_equal(gaussians.alive(asked), expected)
    np.testing.assert_array_equal(asked, before)
    assert gaussians.alive(np.empty(0, np.int64)).shape == (0,)


def test_of_tells_means_and_normals_of_the_living_in_the_order_asked() -> None:
    gaussians, means, rng = GaussianMap(CELL_M), scattered(20, seed=26), np.random.default_rng(27)
    normals = rng.normal(size=(20, 3)).astype(np.float32)
    ids = gaussians.add(means, normals, np.zeros(20, np.float32), np.zeros(3), 0)
    gaussians.remove(ids[5:8])
    found_means, found_normals = gaussians.of(np.array([19, 6, 2, 77, 11], np.int64))
    np.testing.assert_array_equal(found_means, means[[19, 2, 11]])
    np.testing.assert_array_equal(found_normals, normals[[19, 2, 11]])
    found_means[...] = 0  # a copy: the map stays
    np.testing.assert_array_equal(gaussians.of(ids[:2])[0], means[:2])


@settings(max_examples=30, deadline=None)
@given(st.sets(st.integers(0, 40_000), max_size=60), st.integers(0, 30_000), st.integers(0, 2**31))
def test_a_map_of_an_earlier_life_goes_on_as_it_was(
    chosen: set[int], margin: int, seed: int
) -> None:
    """Ids with gaps and in any order; new ones begin where they are told to."""
    rng = np.random.default_rng(seed)
    ids = rng.permutation(np.array(sorted(chosen), np.int64))
    n, next_id = len(ids), max(chosen, default=-1) + 1 + margin
    gaussians, means = GaussianMap(CELL_M), scattered(n, seed)
    normals, viewpoints = rng.normal(size=(2, n, 3)).astype(np.float32)
    flatness, hosts = rng.random(n).astype(np.float32), rng.integers(0, 9, n).astype(np.int32)
    gaussians.restore(ids, means, normals, flatness, viewpoints, hosts, next_id)
    assert len(gaussians) == n
    np.testing.assert_array_equal(gaussians.ids, ids)
    np.testing.assert_array_equal(gaussians.means, means)
    np.testing.assert_array_equal(gaussians.normals, normals)
    np.testing.assert_array_equal(gaussians.flatness, flatness)
    np.testing.assert_array_equal(gaussians.viewpoints, viewpoints)
    np.testing.assert_array_equal(gaussians.hosts, hosts)
    every = np.arange(-2, next_id + 3)
    np.testing.assert_array_equal(every[gaussians.alive(every)], np.sort(ids))
    if n:
        np.testing.assert_array_equal(found(gaussians, means), ids)
    gaussians.remove(ids[::2])
    new = add(gaussians, scattered(5, (seed, 1)), host=9)
    np.testing.assert_array_equal(new, next_id + np.arange(5))
    every = np.arange(-2, next_id + 8)
    living = np.sort(np.concatenate([ids[1::2], new]))
    np.testing.assert_array_equal(every[gaussians.alive(every)], living)


steps = st.lists(st.tuples(st.sampled_from('ars'), st.integers(0, 2**31)), min_size=1, max_size=12)


@settings(max_examples=40, deadline=None)
@given(steps)
def test_any_history_leaves_exactly_the_living_where_they_are(
    history: list[tuple[str, int]],
) -> None:
    gaussians = GaussianMap(CELL_M)
    alive: dict[int, NDArray[np.float32]] = {}
    used: set[int] = set()
    for k, (action, seed) in enumerate(history):
        rng = np.random.default_rng(seed)
        chosen = rng.permutation(np.array(sorted(alive), np.int64))[: rng.integers(1, 40)]
        if action == 'a':
            means = scattered(int(rng.integers(1, 60)), (k, seed))
            ids = add(gaussians, means)
            assert not used & set(ids.tolist())
            used |= set(ids.tolist())
            alive |= dict(zip(ids.tolist(), means, strict=True))
        elif action == 'r':
            gaussians.remove(chosen)
            alive = {k: v for k, v in alive.items() if k not in chosen}
        else:
            normals = rng.normal(size=(len(chosen), 3)).astype(np.float32)
            gaussians.reshape(chosen, normals, rng.random(len(chosen)).astype(np.float32))
    assert len(gaussians) == len(alive)
    assert set(gaussians.ids[gaussians.ids >= 0].tolist()) == set(alive)
    if alive:
        keys, means = np.array(list(alive)), np.array(list(alive.values()))
        np.testing.assert_array_equal(found(gaussians, means), keys)


def test_tracking_covariance_is_that_of_the_last_view() -> None:
    """Sigma_t = S(u, z; p) with u, z seen from the viewpoint."""
    gaussians, means = GaussianMap(CELL_M), scattered(50, seed=14)
    viewpoint = np.array([0.5, -3.0, 0.2])
    add(gaussians, means, (0.5, -3.0, 0.2))
    slots = np.arange(0, 50, 3, dtype=np.int32)
    rays = means[slots] - viewpoint
    ranges = np.linalg.norm(rays, axis=1)
    u = rays / ranges[:, None]
    along = u[:, :, None] * u[:, None, :]
    expected = (ranges * 0.5 / 525.0)[:, None, None] ** 2 * (np.eye(3) - along)
    expected += (SENSOR.a_m + SENSOR.b_per_m * ranges**2)[:, None, None] ** 2 * along
    found_covariances = gaussians.tracking_covariances(slots, SENSOR, 0.5, 525.0)
    error = np.abs(found_covariances - expected).max(axis=(1, 2))
    assert (error <= COVARIANCE * np.abs(expected).max(axis=(1, 2))).all()


def pose_and_view(camera: PinholeCamera) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Pose of a camera and a wavy depth image it sees."""
    T_world_cam = se3.exp(np.array([0.4, -0.3, 0.2, 0.3, -0.8, 0.5]))
    v, u = np.mgrid[: camera.height, : camera.width]
    depth_m = 1.5 + 0.2 * np.sin(u / 40.0) + 0.2 * np.cos(v / 30.0)
    return T_world_cam, depth_m.astype(np.float32)


def lifted(
    camera: PinholeCamera,
    pixels: NDArray[np.floating] | NDArray[np.int64],
    depth_m: NDArray[np.floating],
    T_world_cam: NDArray[np.float64],
) -> NDArray[np.float32]:
    """World points of pixels (N, 2) at depths (N,)."""
    rays = np.column_stack([camera.undistort(pixels.astype(np.float64)), np.ones(len(pixels))])
    points = rays * depth_m[:, None] @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
    return points.astype(np.float32)


def beyond_the_edges(
    camera: PinholeCamera, by_px: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Pixels (80, 2) up to `by_px` outside the image, whose nearest pixel is outside too."""
    inside = rng.uniform((0, 0), (camera.width, camera.height), (4, 20, 2))
    off = 0.6 + rng.uniform(0, by_px - 0.6, (4, 20))
    inside[0, :, 0], inside[1, :, 0] = -off[0], camera.width - 1 + off[1]
    inside[2, :, 1], inside[3, :, 1] = -off[2], camera.height - 1 + off[3]
    return inside.reshape(-1, 2)


@pytest.mark.parametrize('camera', [PINHOLE, DISTORTED], ids=['pinhole', 'distorted'])
def test_refresh_moves_the_viewpoint_of_what_is_seen_and_of_nothing_else(
    camera: PinholeCamera,
) -> None:
    """Not of what lies behind or before the measured surface, outside the image, or behind us."""
    T, depth_m = pose_and_view(camera)
    rng = np.random.default_rng(15)
    pixels = rng.integers((0, 0), (camera.width, camera.height), (400, 2))
    z = depth_m[pixels[:, 1], pixels[:, 0]]
    seen = lifted(camera, pixels, z, T)
    outside = np.concatenate([beyond_the_edges(camera, by, rng) for by in (1.4, 80.0)])
    nearest = np.clip(np.round(outside), 0, (camera.width - 1, camera.height - 1)).astype(int)
    unseen = [
        lifted(camera, pixels, z + HIDDEN_M, T),
        lifted(camera, pixels, z - HIDDEN_M, T),
        lifted(camera, pixels, -z, T),
        lifted(camera, outside, depth_m[nearest[:, 1], nearest[:, 0]], T),
    ]
    gaussians, old = GaussianMap(CELL_M), (9.0, 9.0, 9.0)
    seen_ids = add(gaussians, seen, old)
    for means in unseen:
        add(gaussians, means, old)
    share = gaussians.refresh(T, depth_m, camera, SENSOR, 0)
    assert share == len(seen) / (2 * len(seen))  # those behind the surface are hidden
    assert share == gaussians.agreement(T, depth_m, camera, SENSOR)
    expected = np.full((len(gaussians.means), 3), 9.0)
    expected[seen_ids] = T[:3, 3]
    np.testing.assert_allclose(gaussians.viewpoints, expected, atol=1e-6)


def refreshed(gaussians: GaussianMap, T: NDArray[np.float64], depth_m: NDArray[np.float32]) -> int:
    """Refresh the map, and return how many Gaussians are seen from T's centre then."""
    gaussians.refresh(T, depth_m, PINHOLE, SENSOR, 0)
    there = np.abs(gaussians.viewpoints - T[:3, 3]).max(axis=1, initial=0.0) < 1e-6
    return int(np.count_nonzero(there & (gaussians.ids >= 0)))


def test_refresh_tolerates_the_noise_but_no_more() -> None:
    T, depth_m = pose_and_view(PINHOLE)
    pixels = np.array([[100, 100]])
    z = depth_m[[100], [100]]
    sigma = float(SENSOR.sigma(z[0]))
    for error, seen in ((2 * sigma, 1), (-2 * sigma, 1), (0.1, 0), (-0.1, 0)):
        gaussians = GaussianMap(CELL_M)
        add(gaussians, lifted(PINHOLE, pixels, z + error, T))
        assert refreshed(gaussians, T, depth_m) == seen


@pytest.mark.parametrize('hole', [0.0, np.nan])
def test_refresh_sees_nothing_where_nothing_is_measured(hole: float) -> None:
    T, depth_m = pose_and_view(PINHOLE)
    pixels = np.array([[100, 100], [200, 50]])
    gaussians = GaussianMap(CELL_M)
    add(gaussians, lifted(PINHOLE, pixels, depth_m[pixels[:, 1], pixels[:, 0]], T))
    depth_m[100, 100] = hole
    assert refreshed(gaussians, T, depth_m) == 1


def test_refresh_passes_over_free_slots_and_an_empty_map() -> None:
    T, depth_m = pose_and_view(PINHOLE)
    gaussians = GaussianMap(CELL_M)
    assert refreshed(gaussians, T, depth_m) == 0
    pixels = np.array([[100, 100], [200, 50]])
    ids = add(gaussians, lifted(PINHOLE, pixels, depth_m[pixels[:, 1], pixels[:, 0]], T))
    gaussians.remove(ids[:1])
    assert refreshed(gaussians, T, depth_m) == 1


def test_refresh_is_the_same_with_any_threads() -> None:
    T, depth_m = pose_and_view(PINHOLE)
    pixels = np.random.default_rng(16).integers((0, 0), (320, 240), (1000, 2))
    means = lifted(PINHOLE, pixels, depth_m[pixels[:, 1], pixels[:, 0]], T)
    means[::2] += 0.05
    views = []
    for threads in (1, None):
        jit.set_threads(threads)
        gaussians = GaussianMap(CELL_M)
        add(gaussians, means)
        gaussians.refresh(T, depth_m, PINHOLE, SENSOR, 0)
        views.append(gaussians.viewpoints.copy())
    np.testing.assert_array_equal(views[0], views[1])
