# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The mapper on textured walls: what it learns, what it removes, what it reports."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.errors import DcgsError
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.kernels.workers import Workers
from dcgs_ros.core.keyframe import Keyframe
from dcgs_ros.core.mapping.exposure import Exposure
from dcgs_ros.core.mapping.mapper import Mapper, mapper_threads
from dcgs_ros.core.render.cpu import CpuRenderer

CAMERA = PinholeCamera(80, 60, 70.0, 72.0, 38.0, 31.0)
DISTORTED = replace(CAMERA, distortion=(-0.1, 0.02, 0.001, 0.0))
STRIDE = 5
STEPS = 300
RISE_DB, GOOD_DB = 5.0, 26.0  # of the views, by that many steps
FLOAT32_M = 2e-6
EXPOSURE = 1e-5
FIRST_OPACITY_ROW, SCALE_ROW = 10, 3
NO_IDS = np.empty(0, np.int64)


def texture(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Colours (..., 3) of the world, none of them near black or white."""
    x, y, z = np.moveaxis(points, -1, 0)
    waves = [np.sin(18 * x) * np.cos(14 * y), np.cos(16 * x - 10 * y + z), np.sin(12 * y + 8 * x)]
    return np.asarray(0.5 + 0.25 * np.stack(waves, axis=-1))


def view_from(
    T_world_cam: NDArray[np.float64], camera: PinholeCamera = CAMERA
) -> tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]:
    """Colour, depth and points (H, W, .) of two walls that meet, 1.2 m to 1.8 m away."""
    rays = np.ones((camera.height, camera.width, 3))
    rays[..., :2] = camera.undistortion_map
    directions, t = rays @ T_world_cam[:3, :3].T, T_world_cam[:3, 3]
    walls = np.array([[0.3, 0.1, 1.0], [-0.4, 0.0, 1.0]])
    depth_m = ((1.5 - walls @ t) / (directions @ walls.T)).min(axis=-1)
    points = t + depth_m[..., None] * directions
    return texture(points), depth_m, points


def frame_from(
    T_world_cam: NDArray[np.float64], index: int = 0, camera: PinholeCamera = CAMERA,
    gain: float = 1.0, offset: float = 0.0,
) -> RgbdFrame:  # fmt: skip
    color, depth_m, _ = view_from(T_world_cam, camera)
    levels = np.round(255 * np.clip(gain * color + offset, 0, 1)).astype(np.uint8)
    stamp_ns = 10**9 + index * 10**8
    return RgbdFrame(stamp_ns, stamp_ns, levels, depth_m.astype(np.float32))


def normals_of(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Of the wall that each point is on, towards the origin."""
    walls = np.array([[0.3, 0.1, 1.0], [-0.4, 0.0, 1.0]])
    chosen = walls[np.abs(points @ walls.T - 1.5).argmin(axis=1)]
    return np.asarray(-chosen / np.linalg.norm(chosen, axis=1, keepdims=True))


def keyframe_from(
    T_world_cam: NDArray[np.float64], index: int = 0, first_id: int | None = 0,
    T_tracked: NDArray[np.float64] | None = None, **look: Any,
) -> Keyframe:  # fmt: skip
    """Keyframe as tracked, its Gaussians on a grid; None spawns none."""
    tracked = T_world_cam if T_tracked is None else T_tracked
    _, _, points = view_from(T_world_cam, look.get('camera', CAMERA))
    points = points[2::STRIDE, 2::STRIDE].reshape(-1, 3)[: None if first_id is not None else 0]
    moved = tracked @ se3.inverse(T_world_cam)
    return Keyframe(
        frame_from(T_world_cam, index, **look), tracked, np.eye(4),
        NO_IDS if first_id is None else first_id + np.arange(len(points), dtype=np.int64),
        (points @ moved[:3, :3].T + moved[:3, 3]).astype(np.float32),
        (normals_of(points) @ moved[:3, :3].T).astype(np.float32),
    )  # fmt: skip


def poses(count: int) -> list[NDArray[np.float64]]:
    """Around the origin, the first at it."""
    k = np.arange(count)
    waves = [0.1 * np.sin(2 * k), 0.08 * np.sin(3 * k), 0.1 * np.sin(k)]
    turns = [0.06 * np.sin(5 * k), 0.08 * np.sin(4 * k), 0.1 * np.sin(1.5 * k)]
    return [se3.exp(xi) for xi in np.array(waves + turns).T]


def configured(**values: Any) -> Config:
    """Settings by stage__field."""
    return override(Config(), {name.replace('__', '.'): x for name, x in values.items()})


def mapper_for(
    camera: PinholeCamera = CAMERA, workers: Workers | None = None, **settings: Any
) -> Mapper:
    workers = workers or Workers(1)
    return Mapper(camera, configured(**settings), CpuRenderer(workers), workers)


def filled(count: int = 3, look: Sequence[dict[str, Any]] = (), **settings: Any) -> Mapper:
    """Mapper with some keyframes in it; Gaussians have ids 1000 k + n."""
    mapper = mapper_for(**settings)
    for k, T in enumerate(poses(count)):
        mapper.insert(keyframe_from(T, k, 1000 * k, **(look[k] if look else {})))
    return mapper


def psnr(mapper: Mapper, T_world_cam: NDArray[np.float64], truth: NDArray[np.floating]) -> float:
    error = np.moveaxis(mapper.render(T_world_cam).color, 0, -1) - truth
    return float(-10 * np.log10(np.mean(error**2)))


def mean_psnr(mapper: Mapper) -> float:
    truths = [view_from(view.T_tracked)[0] for view in mapper.views]
    return float(
        np.mean(
            [psnr(mapper, v.T_world_cam, t) for v, t in zip(mapper.views, truths, strict=True)]
        )
    )


@dataclass(frozen=True)
class Run:
    """A mapper after STEPS steps, and how it got there."""

    mapper: Mapper
    before_db: float
    losses: list[float]


@pytest.fixture(scope='module')
def run() -> Iterator[Run]:
    mapper = filled(4)
    before_db = mean_psnr(mapper)
    losses = [mapper.step(replay=True) for _ in range(STEPS)]
    yield Run(mapper, before_db, losses)


def test_the_views_are_learnt(run: Run) -> None:
    assert np.mean(run.losses[-20:]) < 0.5 * np.mean(run.losses[:20])
    after_db = mean_psnr(run.mapper)
    assert after_db > run.before_db + RISE_DB and after_db > GOOD_DB
    assert run.mapper.steps == STEPS and run.mapper.poisoned == 0


def test_a_view_between_is_rendered_as_well(run: Run) -> None:
    T = se3.exp(0.5 * (se3.log(poses(4)[1]) + se3.log(poses(4)[2])))
    color, depth_m, _ = view_from(T)
    assert psnr(run.mapper, T, color) > GOOD_DB
    shown = run.mapper.render(T)
    covered = shown.transmittance < 0.05
    assert covered.mean() > 0.95
    error = np.abs(shown.depth / (1 - shown.transmittance) / depth_m - 1)[covered]
    assert np.median(error) < 0.03  # discs of some centimetres, blended front to back


def test_coarse_and_fine_steps_learn_too() -> None:
    mapper = filled(3)
    before_db = mean_psnr(mapper)
    for _ in range(STEPS):
        mapper.step()
    assert mean_psnr(mapper) > before_db + RISE_DB


@pytest.mark.slow
def test_through_a_lens_the_map_is_the_same_world() -> None:
    """Rendered without distortion, where the lens has seen anything."""
    mapper = mapper_for(DISTORTED)
    for k, T in enumerate(poses(3)):
        mapper.insert(keyframe_from(T, k, 1000 * k, camera=DISTORTED))
    for _ in range(STEPS):
        mapper.step(replay=True)
    truth = view_from(np.eye(4))[0]
    shown = np.moveaxis(mapper.render(np.eye(4)).color, 0, -1)
    inner = np.s_[8:-8, 8:-8]
    assert -10 * np.log10(np.mean((shown - truth)[inner] ** 2)) > GOOD_DB


def displacement_px(T_world_cam: NDArray[np.float64], T_true: NDArray[np.float64]) -> float:
    """How far the image is from where it belongs: turns and shifts make up for each other."""
    points = view_from(T_true)[2].reshape(-1, 3)
    seen = [
        CAMERA.project((points - T[:3, 3]) @ T[:3, :3]) for T in (T_world_cam, T_true)
    ]  # fmt: skip
    return float(np.sqrt(np.mean(np.sum((seen[0] - seen[1]) ** 2, axis=1))))


@pytest.mark.parametrize(
    'off', [(0.016, -0.012, 0.008, 0.01, 0.012, -0.008), (-0.02, 0.01, 0.01, -0.01, 0.015, 0.01)]
)
def test_the_pose_of_a_view_comes_back_towards_the_truth(off: tuple[float, ...]) -> None:
    """A view tracked 2 cm and a degree off, among good ones, with nothing of its own."""
    mapper, T = filled(3), poses(5)[4]
    for _ in range(200):
        mapper.step(replay=True)
    tracked = T @ se3.exp(np.array(off))
    mapper.insert(keyframe_from(T, 3, None, T_tracked=tracked))
    view, before_px = mapper.views[-1], displacement_px(tracked, T)
    for _ in range(200):
        mapper.step(replay=True)
    assert before_px > 1.0
    assert displacement_px(view.T_world_cam, T) < 0.4 * before_px
    np.testing.assert_array_equal(view.T_tracked, tracked)
    corrected = mapper.corrections().pose(view.stamp_ns, tracked)
    np.testing.assert_allclose(corrected, view.T_world_cam, atol=1e-12)


def test_the_first_view_stays_and_good_ones_hardly_move(run: Run) -> None:
    first, *others = run.mapper.views
    np.testing.assert_array_equal(first.T_world_cam, first.T_tracked)
    for view in others:
        assert displacement_px(view.T_world_cam, view.T_tracked) < 0.6


@pytest.mark.slow
def test_exposures_are_found_up_to_one_that_all_have_in_common() -> None:
    gains, offsets = np.array([1.0, 1.12, 0.9, 1.05]), np.array([0.0, -0.03, 0.02, 0.0])
    look = [{'gain': g, 'offset': o} for g, o in zip(gains, offsets, strict=True)]
    mapper = filled(4, look, mapping__exposure_share=1.0, mapping__prune_interval=50)
    for _ in range(2 * STEPS):
        mapper.step(replay=True)
    exposures = [view.exposure for view in mapper.views]
    np.testing.assert_allclose(np.mean([e.gain for e in exposures], axis=0), 1, atol=EXPOSURE)
    np.testing.assert_allclose(np.mean([e.offset for e in exposures], axis=0), 0, atol=EXPOSURE)
    grey = 0.5  # the middle of the texture: what a view shows there against the first one
    shown = np.array([grey * e.gain + e.offset for e in exposures])
    expected = np.repeat((gains * grey + offsets)[:, None], 3, axis=1)
    np.testing.assert_allclose(shown - shown.mean(), expected - expected.mean(), atol=0.02)
    for exposure, view in zip(exposures, mapper.views, strict=True):
        again = mapper.corrections().exposure(view.stamp_ns)
        np.testing.assert_allclose(again.gain, exposure.gain, atol=EXPOSURE)


def test_what_views_show_does_not_change_when_exposures_are_centred() -> None:
    mapper = filled(
        3, mapping__prune_interval=1, mapping__trial_visits=1000, rates__exposure=0,
        mapping__exposure_share=0,
    )  # fmt: skip
    for _ in range(100):
        mapper.step(replay=True)
    rng = np.random.default_rng(0)
    for view in mapper.views:
        gain, offset = rng.uniform(0.8, 1.3, 3), rng.normal(0, 0.1, 3)
        view.exposure = Exposure(gain.astype(np.float32), offset.astype(np.float32))

    def shown() -> list[NDArray[np.floating]]:
        return [
            v.exposure.gain[:, None] * r.color[:, r.transmittance < 1e-3]
            + v.exposure.offset[:, None]
            for v in mapper.views
            for r in [mapper.render(v.T_world_cam)]
        ]

    before = shown()
    mapper.step(rate=0.0, replay=True)
    np.testing.assert_allclose(np.mean([v.exposure.gain for v in mapper.views], 0), 1, atol=1e-5)
    for now, then in zip(shown(), before, strict=True):
        assert now.size
        np.testing.assert_allclose(now, then, atol=2e-3)


def test_a_rate_of_nothing_changes_nothing() -> None:
    mapper = filled(2)
    planes = mapper.table.splats.planes.copy()
    T = mapper.views[1].T_world_cam.copy()
    for _ in range(3):
        mapper.step(rate=0.0)
    np.testing.assert_array_equal(mapper.table.splats.planes, planes)
    np.testing.assert_array_equal(mapper.views[1].T_world_cam, T)


def test_replaying_visits_all_views_equally_often() -> None:
    mapper = filled(5)
    for _ in range(15):
        mapper.step(replay=True)
    assert [view.visits for view in mapper.views] == [3] * 5


def test_the_newest_share_goes_to_the_view_that_had_least() -> None:
    mapper = filled(3, mapping__newest_share=1.0)
    for _ in range(30):
        mapper.step()
    assert [view.visits for view in mapper.views] == [10] * 3
    mapper.insert(keyframe_from(poses(4)[3], 3, 3000))
    for _ in range(7):
        mapper.step()
    assert [view.visits for view in mapper.views] == [10, 10, 10, 7]


def ids_of(mapper: Mapper, columns: Sequence[int]) -> list[int]:
    return mapper.table.ids[list(columns)].tolist()


def test_pruning_takes_what_is_transparent_huge_useless_or_poisoned_and_tells_each_once() -> None:
    mapper = filled(2, mapping__trial_visits=5, mapping__spawn_stride_px=3)
    table, count = mapper.table, len(mapper.table)
    own = np.flatnonzero(table.ids < 0)[:4]
    planes, columns = table.splats.planes, [*range(8), *own.tolist()]
    table.visits[:] = 5
    table.weights[:] = 1.0
    planes[FIRST_OPACITY_ROW, [0, own[0]]] = -4.0  # below 0.02
    planes[SCALE_ROW + 1, [1, own[1]]] = 0.0  # 1 m
    table.weights[[2, own[2]]] = 0.1
    planes[0, [3, own[3]]] = np.nan
    planes[FIRST_OPACITY_ROW, 4] = np.inf
    planes[SCALE_ROW, 5] = np.nan
    planes[8, 6] = -np.inf
    planes[13, 7] = np.nan
    table.weights[9], table.visits[9] = 0.1, 4  # not tried yet
    gone = ids_of(mapper, columns)
    assert len(own) == 4
    mapper.prune()
    assert len(mapper.table) == count - len(columns)
    assert not np.isin(gone, mapper.table.ids).any()
    assert mapper.poisoned == 6
    assert sorted(mapper.update().removed.tolist()) == sorted(i for i in gone if i >= 0)
    mapper.prune()
    assert mapper.poisoned == 6 and not len(mapper.update().removed)


def test_pruning_happens_by_itself_at_its_interval() -> None:
    mapper = filled(1, mapping__prune_interval=10)
    mapper.table.splats.planes[2, 7] = np.nan
    victim = ids_of(mapper, [7])
    for _ in range(9):
        mapper.step()
    assert mapper.poisoned == 0
    mapper.step()
    assert mapper.poisoned == 1 and not np.isin(victim, mapper.table.ids).any()
    assert np.isfinite(mapper.table.splats.planes).all()


def test_a_poisoned_gaussian_spoils_nothing_else() -> None:
    """Neither another's parameters nor a pose, even if it is never pruned."""
    mapper = filled(2, mapping__prune_interval=100_000)
    clean = filled(2, mapping__prune_interval=100_000)
    for k, garbage in enumerate([np.nan, np.inf, -np.inf] * 5):
        mapper.table.splats.planes[k % 14, 3 * k] = garbage
        clean.table.splats.planes[FIRST_OPACITY_ROW, 3 * k] = -100.0
    for each in (mapper, clean):
        for _ in range(20):
            each.step()
    others = np.ones(len(mapper.table), np.bool_)
    others[: 3 * 15 : 3] = False
    np.testing.assert_array_equal(
        mapper.table.splats.planes[:, others], clean.table.splats.planes[:, others]
    )
    np.testing.assert_array_equal(mapper.views[1].T_world_cam, clean.views[1].T_world_cam)


def test_a_spawned_gaussian_that_is_not_finite_is_dropped_and_counted() -> None:
    mapper, keyframe = mapper_for(mapping__prune_interval=5), keyframe_from(np.eye(4))
    means, normals = keyframe.means.copy(), keyframe.normals.copy()
    means[3], normals[5, 1] = np.nan, np.nan
    with np.errstate(invalid='ignore'):
        mapper.insert(replace(keyframe, means=means, normals=normals))
    for _ in range(5):
        mapper.step()
    assert mapper.poisoned == 2
    assert sorted(mapper.update().removed.tolist()) == [3, 5]


@pytest.mark.filterwarnings('error')
def test_the_limits_of_the_opacity_are_limits() -> None:
    """Both are within the range of the setting."""
    for limit, left in ((1.0, False), (0.0, True)):
        mapper = filled(1, mapping__prune_opacity=limit)
        mapper.prune()
        assert (len(mapper.table) > 0) == left


def test_what_no_view_ever_sees_goes_too() -> None:
    mapper, keyframe = mapper_for(mapping__prune_interval=20), keyframe_from(np.eye(4))
    away = np.arange(len(keyframe.ids)) % 2 == 0
    means = keyframe.means + np.outer(away, [50, 0, 0]).astype(np.float32)
    mapper.insert(replace(keyframe, means=means))
    for _ in range(200):
        mapper.step()
    assert not np.isin(keyframe.ids[away], mapper.table.ids).any()
    assert np.isin(keyframe.ids[~away], mapper.table.ids).mean() > 0.9


def test_there_are_never_more_gaussians_than_allowed_and_the_trackers_come_first() -> None:
    mapper = mapper_for(mapping__max_gaussians=1000, mapping__spawn_stride_px=2)
    sizes = []
    for k, T in enumerate(poses(4)):
        mapper.insert(keyframe_from(T, k, 1000 * k))
        sizes.append(len(mapper.table))
        ids, given = mapper.table.ids, keyframe_from(T, k, 1000 * k).ids
        assert len(np.unique(ids)) == len(ids)
        if k == 0:
            assert np.isin(given, ids).all()
        mapper.step()
    assert max(sizes) == 1000
    for _ in range(50):
        mapper.step()
    assert len(mapper.update().ids) <= 1000


def test_images_beyond_the_budget_are_compressed_oldest_first() -> None:
    camera = PinholeCamera(160, 120, 140.0, 144.0, 76.0, 62.0)
    mapper = mapper_for(camera, mapping__image_memory_mb=1.0, mapping__spawn_stride_px=16)
    count, whole = 16, 160 * 120 * 5
    assert count * whole > 1e6
    for k, T in enumerate(poses(count)):
        mapper.insert(keyframe_from(T, k, None, camera=camera))
        held = [view.bytes for view in mapper.views]
        assert sum(held) <= 1e6
        compressed = [size < whole for size in held]
        assert compressed == sorted(compressed, reverse=True)
    assert any(compressed) and not compressed[-1]
    for _ in range(2 * count):
        assert np.isfinite(mapper.step(replay=True))


@pytest.mark.slow
def test_where_compressing_is_not_enough_views_give_up_their_images() -> None:
    """Every second of the old ones; the first one, which holds the map, never does."""
    camera = PinholeCamera(160, 120, 140.0, 144.0, 76.0, 62.0)
    mapper = mapper_for(camera, mapping__image_memory_mb=1.0, mapping__spawn_stride_px=32)
    rng, count = np.random.default_rng(1), 40
    for k, T in enumerate(poses(count)):
        keyframe = keyframe_from(T, k, None, camera=camera)
        color = rng.integers(0, 256, keyframe.frame.color.shape, dtype=np.uint8)
        depth_m = rng.uniform(1, 2, color.shape[:2]).astype(np.float32)
        frame = replace(keyframe.frame, color=color, depth_m=depth_m)
        mapper.insert(replace(keyframe, frame=frame))
        assert sum(view.bytes for view in mapper.views) <= 1e6
        mapper.step()
    active = [view.active for view in mapper.views]
    assert active[0] and active[-1] and 4 < sum(active) < count
    visits = [view.visits for view in mapper.views]
    for _ in range(2 * sum(active)):
        assert np.isfinite(mapper.step(replay=True))
    visited = [now.visits > before for now, before in zip(mapper.views, visits, strict=True)]
    assert visited == active
    retired = mapper.views[active.index(False)]
    corrected = mapper.corrections().pose(retired.stamp_ns, retired.T_tracked)
    np.testing.assert_allclose(corrected, retired.T_world_cam, atol=1e-12)


def test_an_update_tells_the_trackers_gaussians_that_moved_and_no_others(run: Run) -> None:
    mapper = filled(3)
    assert not len(mapper.update().ids)
    for _ in range(10):
        mapper.step()
    update = mapper.update()
    assert (update.ids >= 0).all() and len(np.unique(update.ids)) == len(update.ids)
    assert set(update.ids.tolist()) <= set(mapper.table.ids.tolist())
    assert len(update.ids) == np.count_nonzero((mapper.table.ids >= 0) & (mapper.table.visits > 0))
    count = len(update.ids)
    assert update.means.shape == update.normals.shape == (count, 3)
    assert update.flatness.shape == (count,)
    for array in (update.means, update.normals, update.flatness):
        assert array.dtype == np.float32 and np.isfinite(array).all()
    np.testing.assert_allclose(np.linalg.norm(update.normals, axis=1), 1, atol=1e-5)
    assert not len(mapper.update().ids)


def test_normals_told_are_those_of_the_walls(run: Run) -> None:
    table = run.mapper.table
    own = table.ids >= 0
    normals, flatness = table.splats.shape(np.flatnonzero(own))
    cosines = np.abs(np.einsum('ij,ij->i', normals, normals_of(table.measured.T[own])))
    assert np.median(cosines) > np.cos(np.radians(20))
    assert np.median(flatness) < 0.2


def test_gaussians_that_are_here_already_stay_with_the_keyframe_they_came_with() -> None:
    """One that is offered again may bring some that came with another, learnt meanwhile."""
    mapper = filled(2)
    for _ in range(5):
        mapper.step()
    table, count = mapper.table, len(mapper.table)
    before = {id: table.splats.planes[:, k].tobytes() for k, id in enumerate(table.ids.tolist())}
    hosts = dict(zip(table.ids.tolist(), table.hosts.tolist(), strict=True))
    there, keyframe = keyframe_from(poses(1)[0], 0, 0), keyframe_from(poses(4)[3], 3, 3000)
    order = np.random.default_rng(0).permutation(len(there.ids) + len(keyframe.ids))
    both: dict[str, Any] = {
        name: np.concatenate([getattr(there, name), getattr(keyframe, name)])[order]
        for name in ('ids', 'means', 'normals')
    }
    both['means'][np.isin(both['ids'], there.ids)] += 1.0  # their new position must be ignored
    mapper.insert(replace(keyframe, **both))
    table = mapper.table
    ids = table.ids.tolist()
    assert len(set(ids)) == len(ids) and len(ids) >= count + len(keyframe.ids)
    assert set(keyframe.ids.tolist()) <= set(ids)
    column = {id: k for k, id in enumerate(ids)}
    for id, host in hosts.items():
        assert table.hosts[column[id]] == host
        planes = table.splats.planes[:11, column[id]].tobytes()  # exposures may move colours
        assert planes == before[id][: len(planes)]
    assert {table.hosts[column[id]] for id in keyframe.ids.tolist()} == {2}
    assert mapper.poisoned == 0 and not len(mapper.update().removed)


def test_keyframes_that_come_late_are_corrected_in_the_order_of_their_stamps() -> None:
    mapper = mapper_for()
    for k in (0, 3, 1, 2):
        mapper.insert(keyframe_from(poses(4)[k], k, 1000 * k))
    rng = np.random.default_rng(2)
    for view in mapper.views:
        view.T_world_cam = view.T_tracked @ se3.exp(0.01 * rng.normal(size=6))
    corrections = mapper.corrections()
    for view in mapper.views:
        found = corrections.pose(view.stamp_ns, view.T_tracked)
        np.testing.assert_allclose(found, view.T_world_cam, atol=1e-12)


def test_what_did_not_move_is_told_where_the_tracker_had_it() -> None:
    """Though the views, and all they spawned, are elsewhere in the mapper's world."""
    off = se3.exp(np.array([0.02, -0.01, 0.015, 0.01, -0.02, 0.015]))
    mapper = mapper_for(rates__mean_m=0, rates__pose_m=0, rates__pose_rad=0, rates__rotation=0)
    first, second = (keyframe_from(T, k, 1000 * k) for k, T in enumerate(poses(2)))
    mapper.insert(first)
    mapper.views[0].T_world_cam = mapper.views[0].T_world_cam @ off
    mapper.insert(second)
    there = np.isin(mapper.table.ids, second.ids)
    apart = np.linalg.norm(mapper.table.splats.means.T[there] - second.means, axis=1)
    assert apart.min() > 0.01
    np.testing.assert_array_equal(mapper.table.measured.T[there], second.means)
    for _ in range(5):
        mapper.step(replay=True)
    update = mapper.update()
    k = np.isin(update.ids, second.ids)
    assert k.any()
    order = update.ids[k] - 1000
    np.testing.assert_allclose(update.means[k], second.means[order], atol=FLOAT32_M)
    cosines = np.abs(np.einsum('ij,ij->i', update.normals[k], second.normals[order]))
    np.testing.assert_allclose(cosines, 1, atol=1e-4)


@pytest.mark.parametrize('row', range(14))
def test_nothing_is_told_of_a_poisoned_gaussian_before_it_is_pruned(row: int) -> None:
    mapper = filled(1, mapping__prune_interval=100_000)
    for _ in range(3):
        mapper.step()
    poisoned = mapper.table.ids >= 0
    mapper.table.splats.planes[row, poisoned] = np.nan
    assert not len(mapper.update().ids)


def test_means_leave_where_they_were_measured_by_a_share_of_the_noise_at_most(run: Run) -> None:
    """From where the host saw them: a mean that is touched is clamped to its reach."""
    mapper = run.mapper
    before = mapper.table.visits.copy()
    for _ in range(2 * len(mapper.views)):
        mapper.step(rate=0.0, replay=True)
    table, config = mapper.table, mapper.config
    assert len(table.visits) == len(before)  # none was pruned
    own = (table.ids >= 0) & (table.visits > before)
    assert own.mean() > 0.5
    moved = np.linalg.norm((table.splats.means - table.anchors)[:, own], axis=0)
    hosts = np.array([view.T_tracked for view in mapper.views])[table.hosts[own]]
    p_cam = np.einsum('nji,nj->ni', hosts[:, :3, :3], table.measured.T[own] - hosts[:, :3, 3])
    reach_m = config.mapping.reach_sigmas * config.sensor.sigma(p_cam[:, 2])
    assert (moved <= reach_m + FLOAT32_M).all()
    assert moved.max() > 0.5 * reach_m.min()


def test_with_more_reach_means_go_farther() -> None:
    moved = []
    for reach in (0.0, 1.0, 1e6):
        mapper = filled(2, mapping__reach_sigmas=reach, rates__pose_m=0, rates__pose_rad=0)
        for _ in range(100):
            mapper.step(replay=True)
        own = mapper.table.ids >= 0
        away = np.linalg.norm((mapper.table.splats.means - mapper.table.anchors)[:, own], axis=0)
        moved.append(away.mean())
    assert moved[0] == 0 < moved[1] < moved[2]


def state(mapper: Mapper) -> bytes:
    parts = [mapper.table.planes, mapper.table.ids, mapper.table.hosts]
    for view in mapper.views:
        parts += [view.T_world_cam, view.exposure.gain, view.exposure.offset]
    return b''.join(np.ascontiguousarray(part).tobytes() for part in parts)


def test_two_runs_give_the_same_bytes_with_any_threads() -> None:
    states = []
    for threads in (1, 1, 3):
        with closing(Workers(threads)) as workers:
            mapper = mapper_for(workers=workers, mapping__prune_interval=20)
            losses = []
            for k, T in enumerate(poses(3)):
                mapper.insert(keyframe_from(T, k, 1000 * k))
                losses += [mapper.step() for _ in range(15)]
            mapper.step(0.5, replay=True)
            states.append((state(mapper), losses))
    assert states[0] == states[1] == states[2]


def test_another_seed_takes_other_steps() -> None:
    found = []
    for seed in (0, 1):
        mapper = filled(3, mapping__seed=seed)
        for _ in range(5):
            mapper.step()
        found.append(state(mapper))
    assert found[0] != found[1]


def test_holes_in_the_depth_are_mapped_from_the_image() -> None:
    keyframe = keyframe_from(np.eye(4))
    depth_m = keyframe.frame.depth_m.copy()
    depth_m[15:45, 20:60] = 0
    u, v = np.meshgrid(np.arange(2, 80, STRIDE), np.arange(2, 60, STRIDE))
    seen = (depth_m[v, u] > 0).ravel()
    mapper = mapper_for()
    mapper.insert(
        Keyframe(
            replace(keyframe.frame, depth_m=depth_m), np.eye(4), np.eye(4), keyframe.ids[seen],
            keyframe.means[seen], keyframe.normals[seen],
        )
    )  # fmt: skip
    assert (mapper.table.ids < 0).any()
    for _ in range(STEPS):
        mapper.step()
    truth = view_from(np.eye(4))[0]
    assert psnr(mapper, np.eye(4), truth) > GOOD_DB


def test_a_keyframe_that_spawned_nothing_is_mapped_by_the_mappers_own() -> None:
    mapper = mapper_for()
    mapper.insert(keyframe_from(np.eye(4), 0, None))
    assert len(mapper.table) > 50 and (mapper.table.ids < 0).all()
    for _ in range(STEPS):
        mapper.step()
    assert psnr(mapper, np.eye(4), view_from(np.eye(4))[0]) > GOOD_DB
    assert not len(mapper.update().ids)


def test_a_keyframe_that_nothing_can_be_spawned_from_is_no_reason_to_stop() -> None:
    """All its depth lies beyond what is kept of it."""
    keyframe = keyframe_from(np.eye(4), 0, None)
    far = np.full_like(keyframe.frame.depth_m, 40.0)
    mapper = mapper_for()
    mapper.insert(replace(keyframe, frame=replace(keyframe.frame, depth_m=far)))
    assert len(mapper.table) == 0
    for _ in range(5):
        assert np.isfinite(mapper.step())
    mapper.prune()
    assert not len(mapper.update().ids) and (mapper.render(np.eye(4)).transmittance == 1).all()
    mapper.insert(keyframe_from(np.eye(4), 1, 0))
    assert len(mapper.table) > 50


def test_grey_images_give_a_grey_map() -> None:
    keyframe = keyframe_from(np.eye(4))
    grey = keyframe.frame.color.mean(axis=2).round().astype(np.uint8)
    mapper = mapper_for()
    mapper.insert(replace(keyframe, frame=replace(keyframe.frame, color=grey)))
    for _ in range(STEPS):
        mapper.step()
    truth = np.repeat(grey[..., None] / 255.0, 3, axis=2)
    assert psnr(mapper, np.eye(4), truth) > GOOD_DB


def test_depth_of_another_instant_is_mapped_where_it_belongs() -> None:
    """The camera moves between depth and colour; the mapper's Gaussians are on the surface."""
    T_cam_cam_at_depth = se3.exp(np.array([0.03, 0.02, -0.02, 0.01, -0.02, 0.01]))
    then = frame_from(T_cam_cam_at_depth)
    now = frame_from(np.eye(4))
    frame = RgbdFrame(now.stamp_ns, now.stamp_ns - 15_000_000, now.color, then.depth_m)
    none = keyframe_from(np.eye(4), 0, None)
    mapper = mapper_for(mapping__spawn_stride_px=4)
    mapper.insert(replace(none, frame=frame, T_cam_cam_at_depth=T_cam_cam_at_depth))
    walls = np.array([[0.3, 0.1, 1.0], [-0.4, 0.0, 1.0]])
    off_m = np.abs(mapper.table.splats.means.T @ walls.T - 1.5).min(axis=1)
    assert np.median(off_m) < 0.003 and (off_m < 0.02).mean() > 0.9


@pytest.mark.parametrize('replay', [False, True])
def test_a_step_before_any_keyframe_is_refused_in_words(replay: bool) -> None:
    with pytest.raises(DcgsError):
        mapper_for().step(replay=replay)


def test_before_any_keyframe_there_is_nothing_to_tell() -> None:
    update = mapper_for().update()
    assert not len(update.ids) and not len(update.removed)
    assert update.means.shape == update.normals.shape == (0, 3)


def test_an_empty_map_can_be_looked_at() -> None:
    shown = mapper_for().render(np.eye(4))
    assert (shown.transmittance == 1).all() and not shown.color.any()


BAD = {
    'larger': keyframe_from(np.eye(4), 1, camera=PinholeCamera(84, 60, 70.0, 72.0, 38.0, 31.0)),
    'smaller': keyframe_from(np.eye(4), 1, camera=PinholeCamera(64, 48, 70.0, 72.0, 38.0, 31.0)),
    'pose': replace(keyframe_from(np.eye(4), 1), T_world_cam=np.full((4, 4), np.nan)),
    'motion': replace(keyframe_from(np.eye(4), 1), T_cam_cam_at_depth=np.full((4, 4), np.nan)),
    'ids': replace(keyframe_from(np.eye(4), 1), ids=np.arange(3)),
    'twice': replace(
        keyframe_from(np.eye(4), 1), ids=np.arange(len(keyframe_from(np.eye(4)).ids)) // 2
    ),
}


@pytest.mark.parametrize('fault', BAD)
def test_a_keyframe_that_is_none_is_refused_and_the_mapper_goes_on_without_it(fault: str) -> None:
    mapper = filled(1)
    before = state(mapper)
    with pytest.raises(DcgsError):
        mapper.insert(BAD[fault])
    assert state(mapper) == before
    for _ in range(5):
        mapper.step()


def test_lockstep_takes_all_cores_and_online_leaves_one(monkeypatch: pytest.MonkeyPatch) -> None:
    for cores, lockstep, online in ((8, 8, 7), (2, 2, 1), (1, 1, 1)):
        monkeypatch.setattr('dcgs_ros.core.mapping.mapper.cores', lambda cores=cores: cores)
        assert mapper_threads(Config(), online=False) == lockstep
        assert mapper_threads(Config(), online=True) == online
    assert mapper_threads(Config(threads=3), online=True) == 3
