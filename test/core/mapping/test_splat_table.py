# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Bookkeeping of the mapper's Gaussians, and selective Adam against torch's."""

from __future__ import annotations

from contextlib import closing
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch.optim.adam import adam

from dcgs_ros.core.kernels.workers import Workers
from dcgs_ros.core.mapping.exposure import Exposure
from dcgs_ros.core.mapping.splat_table import SplatTable
from dcgs_ros.core.mapping.splats import PLANES, SH_C0, Splats
from dcgs_ros.core.render.cpu import CpuRenderer
from dcgs_ros.core.render.renderer import Gradients, View
from dcgs_ros.core.render.simd import LANES

torch.set_num_threads(1)

ADAM = 1e-5  # of a step's size: ours is float32, torch's float64
COLOR = 1e-6
ROUNDING_M = 1e-6  # of means up to a few metres in float32
UNSEEN_LOGIT = -10.0  # far below what any renderer shows
RATES = np.geomspace(1e-4, 1e-1, len(PLANES)).astype(np.float32)
WORKERS = Workers(1)


def splats(seed: int, count: int) -> Splats:
    rng = np.random.default_rng(seed)
    return Splats(rng.normal(size=(len(PLANES), count)).astype(np.float32))


def append(
    table: SplatTable,
    new: Splats,
    ids: NDArray[np.int64],
    host: int = 0,
    reach_m: float = np.inf,
) -> None:
    """Append Gaussians whose tracked means are the opposite of their means."""
    table.append(new, ids, host, -new.means, np.full(len(new), reach_m, np.float32))


def table_of(count: int, seed: int = 0, reach_m: float = np.inf) -> SplatTable:
    table = SplatTable()
    append(table, splats(seed, count), np.arange(count), reach_m=reach_m)
    return table


def gradients(
    table: SplatTable,
    planes: NDArray[np.floating],
    touched: NDArray[np.bool_],
    weights: NDArray[np.floating] | None = None,
) -> Gradients:
    """Fill up to the table's columns, with garbage where nothing is touched."""
    columns = table.planes.shape[1]
    filled = np.full((len(PLANES), columns), 7.0, np.float32)
    filled[:, : len(table)] = planes
    all_touched, all_weights = np.zeros(columns, np.bool_), np.zeros(columns, np.float32)
    all_touched[: len(table)] = touched
    all_weights[: len(table)] = 1.0 if weights is None else weights
    return Gradients(filled, all_touched, np.zeros(6), all_weights)


def snapshot(table: SplatTable) -> dict[str, NDArray[Any]]:
    """Return copies of a table's columns."""
    return {
        'planes': table.splats.planes.copy(),
        'measured': table.measured.copy(),
        'anchors': table.anchors.copy(),
        'ids': table.ids.copy(),
        'hosts': table.hosts.copy(),
        'visits': table.visits.copy(),
        'weights': table.weights.copy(),
    }


def assert_same(found: dict[str, NDArray[Any]], expected: dict[str, NDArray[Any]]) -> None:
    for name, column in expected.items():
        np.testing.assert_array_equal(found[name], column, err_msg=name)


def test_what_is_appended_stands_behind_the_others_with_all_that_belongs_to_it() -> None:
    table = table_of(21, seed=1)
    table.step(gradients(table, 1.0 * splats(2, 21).planes, np.ones(21, np.bool_)), RATES, WORKERS)
    before, new = snapshot(table), splats(3, 5)
    append(table, new, np.array([-1, -2, 50, 51, -3]), 4)
    assert len(table) == 26
    after = snapshot(table)
    assert_same({name: column[..., :21] for name, column in after.items()}, before)
    np.testing.assert_array_equal(table.splats.planes[:, 21:], new.planes)
    np.testing.assert_array_equal(table.anchors[:, 21:], new.means)
    np.testing.assert_array_equal(table.measured[:, 21:], -new.means)
    np.testing.assert_array_equal(table.ids[21:], [-1, -2, 50, 51, -3])
    np.testing.assert_array_equal(table.hosts[21:], 4)
    assert not table.visits[21:].any() and not table.weights[21:].any()


actions = st.lists(st.tuples(st.sampled_from('aks'), st.integers(0, 2**31)), max_size=10)


@settings(max_examples=40, deadline=None)
@given(actions)
def test_any_history_keeps_the_columns_together_and_the_groups_whole(
    history: list[tuple[str, int]],
) -> None:
    table, next_id = SplatTable(), 0
    rows: dict[int, tuple[bytes, int]] = {}  # by id: what was appended, host
    for action, seed in history:
        rng = np.random.default_rng(seed)
        if action == 'a':
            count, host = int(rng.integers(0, 40)), int(rng.integers(100))
            new, ids = splats(seed, count), np.arange(next_id, next_id + count)
            append(table, new, ids, host)
            next_id += count
            rows |= {int(i): (new.means[:, k].tobytes(), host) for k, i in enumerate(ids)}
        elif action == 'k':
            mask = rng.random(len(table)) < rng.random()
            rows = {i: rows[i] for i in table.ids[mask].tolist()}
            table.keep(mask)
        else:
            touched = rng.random(len(table)) < 0.5
            planes = rng.normal(size=(len(PLANES), len(table)))
            table.step(gradients(table, planes, touched), RATES, WORKERS)
    assert table.planes.shape[1] % LANES == 0
    assert len(table) == len(rows) <= table.planes.shape[1] < len(table) + LANES
    assert sorted(table.ids.tolist()) == table.ids.tolist() == list(rows)
    for column, (means, host) in enumerate(rows.values()):
        assert table.anchors[:, column].tobytes() == means
        assert (-table.measured[:, column]).tobytes() == means
        assert table.hosts[column] == host


def test_padding_is_never_seen_and_never_moves() -> None:
    """Through the renderer and back, from before the camera, however many Gaussians there are."""
    view = View(48, 32, 40.0, 40.0, 23.5, 15.5, np.eye(4))
    renderer, table = CpuRenderer(WORKERS), SplatTable()
    rng = np.random.default_rng(4)
    for count in (3, 14, 20):
        new = splats(count, count)
        new.means[...] = rng.uniform((-1, -1, 1), (1, 1, 3), (count, 3)).T
        new.log_scales[...] = np.log(0.05)
        append(table, new, np.arange(count))
        padding = table.planes[:, len(table) :].copy()
        assert padding.shape[1] == -len(table) % LANES
        assert (padding[PLANES.index('opacity')] < UNSEEN_LOGIT).all()
        for _ in range(20):
            renderer.render(table.planes, view)
            upstream = rng.normal(size=(5, 32, 48)).astype(np.float32)
            table.step(renderer.backward(upstream), RATES, WORKERS)
        np.testing.assert_array_equal(table.planes[:, len(table) :], padding)
        alone = renderer.render(table.splats.planes, view).planes.copy()
        np.testing.assert_array_equal(renderer.render(table.planes, view).planes, alone)


def torch_adam(
    start: NDArray[np.floating], history: list[NDArray[np.floating]]
) -> NDArray[np.float64]:
    """Run torch's, each plane at its rate, in float64."""
    planes = torch.tensor(start, dtype=torch.float64)
    first, second = torch.zeros_like(planes), torch.zeros_like(planes)
    counts = torch.zeros(len(planes))
    for gradient in history:
        for k, row in enumerate(torch.tensor(gradient, dtype=torch.float64)):
            # The function behind torch.optim.Adam, whose class takes seconds to load.
            adam(
                [planes[k]], [row], [first[k]], [second[k]], [], [counts[k]], foreach=False,
                amsgrad=False, beta1=0.9, beta2=0.999, lr=float(RATES[k]), weight_decay=0.0,
                eps=1e-15, maximize=False,
            )  # fmt: skip
    return np.asarray(planes.numpy())


def assert_moved_alike(
    found: NDArray[np.floating], expected: NDArray[np.floating], steps: int
) -> None:
    """To within a share of the way that many steps can go, and the parameters' own rounding."""
    way = steps * RATES[:, None].astype(np.float64)
    error = np.abs(found - expected)
    assert (error < ADAM * way + 2e-7 * np.sqrt(steps) * np.abs(expected)).all(), error.max()


def test_a_gaussian_that_every_step_touches_moves_as_with_torch() -> None:
    """Gradients of all sizes: Adam does not see the scale."""
    count, steps = 37, 50
    table, rng = table_of(count, seed=5), np.random.default_rng(6)
    start = table.splats.planes.copy()
    sizes = 10.0 ** rng.uniform(-9, 3, (len(PLANES), count))
    drift = rng.normal(size=(len(PLANES), count))
    history = [
        (sizes * (drift + rng.normal(size=drift.shape))).astype(np.float32) for _ in range(steps)
    ]
    for gradient in history:
        table.step(gradients(table, gradient, np.ones(count, np.bool_)), RATES, WORKERS)
    assert_moved_alike(table.splats.planes, torch_adam(start, history), steps)
    assert (table.visits == steps).all()


def test_a_gaussian_counts_its_own_visits_only() -> None:
    """A Gaussian moves as if the steps in which it was not touched had not been taken."""
    count, steps = 37, 40
    table, rng = table_of(count, seed=7), np.random.default_rng(8)
    start = table.splats.planes.copy()
    history: list[list[NDArray[np.floating]]] = [[] for _ in range(count)]
    for _ in range(steps):
        gradient = rng.normal(0.3, 1.0, (len(PLANES), count)).astype(np.float32)
        touched = rng.random(count) < np.linspace(0, 1, count)
        before = table.splats.planes.copy()
        table.step(gradients(table, gradient, touched), RATES, WORKERS)
        np.testing.assert_array_equal(table.splats.planes[:, ~touched], before[:, ~touched])
        for k in np.flatnonzero(touched):
            history[k].append(gradient[:, k : k + 1])
    expected = [torch_adam(start[:, k : k + 1], history[k]) for k in range(count)]
    assert_moved_alike(table.splats.planes, np.concatenate(expected, axis=1), steps)
    np.testing.assert_array_equal(table.visits, [len(h) for h in history])


def test_moments_stay_with_their_gaussian_when_others_go() -> None:
    count, rng = 50, np.random.default_rng(9)
    table, alone = table_of(count, seed=10), table_of(count, seed=10)
    mask = rng.random(count) < 0.4
    alone.keep(mask)
    for k in range(6):
        if k == 3:
            table.keep(mask)
            append(table, splats(11, 9), np.arange(100, 109), 1)
        gradient = rng.normal(size=(len(PLANES), count))
        mine = gradient[:, mask]
        if k < 3:
            table.step(gradients(table, gradient, np.ones(count, np.bool_)), RATES, WORKERS)
        else:
            both = np.concatenate([mine, rng.normal(size=(len(PLANES), 9))], axis=1)
            table.step(gradients(table, both, np.ones(both.shape[1], np.bool_)), RATES, WORKERS)
        alone.step(gradients(alone, mine, np.ones(mask.sum(), np.bool_)), RATES, WORKERS)
    kept = np.count_nonzero(mask)
    np.testing.assert_array_equal(table.splats.planes[:, :kept], alone.splats.planes)


def test_the_bias_correction_outlives_its_table() -> None:
    """After very many visits a constant gradient still moves by the rate, step by step."""
    table = table_of(1)
    gradient = gradients(table, np.ones((len(PLANES), 1)), np.ones(1, np.bool_))
    for _ in range(8300):  # beyond the table's 8192
        table.step(gradient, RATES, WORKERS)
    before = table.splats.planes.astype(np.float64)
    table.step(gradient, RATES, WORKERS)
    moved = before - table.splats.planes
    rounding = np.spacing(np.abs(before).astype(np.float32))
    assert (np.abs(moved[:, 0] - RATES) < 1e-3 * RATES + rounding[:, 0]).all()


@pytest.mark.parametrize('garbage', [np.nan, np.inf, -np.inf])
def test_what_stands_where_nothing_is_touched_does_not_matter(garbage: float) -> None:
    """A backend leaves there what it likes, such as the gradient that was not finite."""
    table, touched = table_of(16), np.ones(16, np.bool_)
    touched[5] = False
    before = table.splats.planes.copy()
    planes = np.ones((len(PLANES), 16), np.float32)
    planes[:, 5] = garbage
    for _ in range(2):
        table.step(gradients(table, planes, touched), RATES, WORKERS)
    np.testing.assert_array_equal(table.splats.planes[:, 5], before[:, 5])
    assert np.isfinite(table.splats.planes).all()
    touched[5] = True  # nor did its moments take any of it
    planes[:, 5] = 1.0
    table.step(gradients(table, planes, touched), RATES, WORKERS)
    moved = before[:, 5].astype(np.float64) - table.splats.planes[:, 5]
    np.testing.assert_allclose(moved, RATES, rtol=1e-3, atol=1e-6)


def test_a_huge_gradient_leaves_finite_parameters() -> None:
    table = table_of(16)
    planes = np.full((len(PLANES), 16), 1e20, np.float32)
    for _ in range(3):
        table.step(gradients(table, planes, np.ones(16, np.bool_)), RATES, WORKERS)
    assert np.isfinite(table.splats.planes).all()


@pytest.mark.parametrize('size', [0.0, 1e-45, 1e-30, 1e-20, 1e15])
def test_no_step_is_much_longer_than_the_rate(size: float) -> None:
    table, rng = table_of(16), np.random.default_rng(12)
    for _ in range(20):
        before = table.splats.planes.astype(np.float64)
        planes = size * rng.choice([-1.0, 0.1, 1.0], (len(PLANES), 16))
        table.step(gradients(table, planes, np.ones(16, np.bool_)), RATES, WORKERS)
        rounding = np.spacing(np.abs(before).astype(np.float32))
        assert (np.abs(before - table.splats.planes) < 2 * RATES[:, None] + rounding).all()


def test_a_mean_goes_no_farther_than_its_reach_and_slides_along_the_edge_of_it() -> None:
    """Each by its own; what it had been pushed beyond is forgotten."""
    reach_m = 0.01
    table, free = table_of(40, seed=17, reach_m=reach_m), table_of(40, seed=17)
    rng = np.random.default_rng(18)
    rates = np.full(len(PLANES), 3e-3, np.float32)
    for _ in range(30):
        planes = rng.normal(0.5, 1.0, (len(PLANES), 40))
        for each in (table, free):
            each.step(gradients(each, planes, np.ones(40, np.bool_)), rates, WORKERS)
        away = np.linalg.norm(table.splats.means - table.anchors, axis=0)
        assert (away <= reach_m + ROUNDING_M).all()
    assert (away > 0.99 * reach_m).mean() > 0.5
    assert np.linalg.norm(free.splats.means - free.anchors, axis=0).max() > 2 * reach_m
    np.testing.assert_array_equal(table.splats.planes[3:], free.splats.planes[3:])


def test_without_reach_a_mean_stays_and_the_rest_moves() -> None:
    table = table_of(20, seed=19, reach_m=0.0)
    before = table.splats.planes.copy()
    table.step(gradients(table, np.ones((14, 20)), np.ones(20, np.bool_)), RATES, WORKERS)
    np.testing.assert_array_equal(table.splats.means, before[:3])
    assert (table.splats.planes[3:] < before[3:]).all()


def test_whom_nothing_touches_stays_wherever_its_anchor_has_gone() -> None:
    table, touched = table_of(16, reach_m=0.1), np.ones(16, np.bool_)
    touched[5] = False
    before = table.splats.means[:, 5].copy()
    table.anchors[:, 5] += 1.0
    table.step(gradients(table, np.ones((14, 16)), touched), RATES, WORKERS)
    assert 5 not in table.report()
    np.testing.assert_array_equal(table.splats.means[:, 5], before)


def test_the_weight_kept_is_the_largest_of_the_visits() -> None:
    table, touched = table_of(4), np.array([True, True, True, False])
    for weights in ([1.0, 5.0, 2.0, 9.0], [3.0, 4.0, 0.5, 9.0]):
        planes = np.zeros((len(PLANES), 4))
        table.step(gradients(table, planes, touched, np.array(weights)), RATES, WORKERS)
    np.testing.assert_array_equal(table.weights, [3, 5, 2, 0])


def test_each_change_of_the_trackers_is_reported_once() -> None:
    table = SplatTable()
    append(table, splats(13, 6), np.array([10, -1, 11, 12, -2, 13]))

    def visit(*columns: int) -> None:
        touched = np.isin(np.arange(len(table)), columns)
        table.step(gradients(table, np.ones((14, len(table))), touched), RATES, WORKERS)

    def reported() -> list[int]:
        return table.ids[table.report()].tolist()

    assert reported() == []
    visit(0, 1, 3)
    visit(3, 5)
    assert reported() == [10, 12, 13]  # the mapper's own are its own business
    assert reported() == []
    visit(5)
    table.keep(np.array([False, True, True, True, True, True]))
    visit(1)
    assert reported() == [11, 13]
    assert reported() == []


def test_recoloring_is_what_the_exposure_does_to_a_color() -> None:
    table = table_of(20, seed=14)
    before = snapshot(table)
    padding = table.planes[:, 20:].copy()
    gain = np.array([1.5, 0.7, 1.0], np.float32)
    offset = np.array([0.1, -0.2, 0.0], np.float32)
    table.recolor(Exposure(gain, offset))
    colors = 0.5 + SH_C0 * before['planes'][11:]
    expected = colors * gain[:, None] + offset[:, None]
    np.testing.assert_allclose(0.5 + SH_C0 * table.splats.sh_dc, expected, atol=COLOR)
    np.testing.assert_array_equal(table.splats.planes[:11], before['planes'][:11])
    np.testing.assert_array_equal(table.planes[:, 20:], padding)
    assert not len(table.report())


def test_a_step_is_the_same_with_any_threads() -> None:
    found = []
    for threads in (1, 3):
        table, rng = table_of(500, seed=15), np.random.default_rng(16)
        with closing(Workers(threads)) as workers:
            for _ in range(5):
                touched = rng.random(500) < 0.6
                planes = rng.normal(size=(len(PLANES), 500))
                table.step(gradients(table, planes, touched), RATES, workers)
        found.append(table.planes.tobytes())
    assert found[0] == found[1]


def test_an_empty_table_can_do_everything() -> None:
    table = SplatTable()
    table.step(gradients(table, np.empty((14, 0)), np.empty(0, np.bool_)), RATES, WORKERS)
    table.keep(np.empty(0, np.bool_))
    append(table, splats(0, 0), np.empty(0, np.int64))
    table.recolor(Exposure(np.ones(3, np.float32), np.zeros(3, np.float32)))
    assert len(table) == len(table.report()) == len(table.splats) == 0
