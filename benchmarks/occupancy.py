# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The occupancy grid against the truth: `python -m benchmarks.occupancy [ADDRESS] [--seeds S]`.

Synthetic scenes are tracked, and the views that the mapper would get make the grid, at the poses
that the tracker found. The map begins on the floor under the first camera. A cell counts where the
grid knows it: right is occupied where something solid in the height band is in the cell (walls are
solid to their outside), free where nothing is. A cell that would be the other if it were a
centimetre larger or smaller all round is neither; `every cell` counts those too.

`--ghosts` instead has a crate stand before the camera for the first half, and counts the cells
that are occupied where it stood: before it goes, and at the end. `--times` measures updates, and
building the grid again after a correction, with 1000 views all over 30 x 30 m, in processor time
of one thread.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain, islice

import numpy as np
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.config.navigation import GridConfig
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.mapping.rectification import Rectifier
from dcgs_ros.core.navigation.occupancy import OccupancyMap, OccupancyMapper
from dcgs_ros.core.navigation.voxels import FREE, OCCUPIED, UNKNOWN
from dcgs_ros.core.tracking.selector import KeyframeSelector
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.datasets.synthetic.options import SyntheticOptions
from dcgs_ros.datasets.synthetic.raycast import SPHERE, Scene
from dcgs_ros.datasets.synthetic.scenes.builder import SceneBuilder
from dcgs_ros.datasets.synthetic.source import SyntheticSource

ADDRESSES = (
    'synthetic:room?frames=300',
    'synthetic:room?motion=wheeled&speed=2&frames=400&sensor=d435i',
    'synthetic:room?motion=wheeled&frames=300&sensor=d435i_measured',
)
_ACROSS = 6  # samples along a cell's side, from edge to edge
_EDGE_M = 0.01
_CRATE = (1.15, 0.1, 0.45), (0.15, 0.2, 0.45)  # middle and half extent
_VIEWS, _HALF_SIDE_M = 1000, 13.0  # places whose views reach over 30 x 30 m
COLUMNS = (
    'scene', 'seed', 'known cells', 'right, %', 'of free, %', 'of occupied, %',
    'every cell, %', 'free found, %', 'update ms', 'at most',
)  # fmt: skip


@dataclass(frozen=True)
class Truth:
    """Which cells (H, W) are occupied and which are free; neither at edges."""

    occupied: NDArray[np.bool_]
    free: NDArray[np.bool_]
    touched: NDArray[np.bool_]  # those in which anything is


@dataclass(frozen=True)
class Score:
    """How a grid compares with the truth; shares of cells."""

    known: int  # of those that are free or occupied
    right: float  # of the known ones
    free_right: float
    occupied_right: float
    every: float  # right, of all that are known, those at edges too
    free_found: float  # known and right, of the free ones within the grid


def on_floor(T_world_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return T_map_world (4, 4): the map begins under a camera, x where that looks."""
    ahead = T_world_cam[:3, 2]
    yaw = np.arctan2(ahead[1], ahead[0])
    T_world_map = se3.exp(np.array([0, 0, 0, 0, 0, yaw]))
    T_world_map[:2, 3] = T_world_cam[:2, 3]
    return se3.inverse(T_world_map)


def solid(
    scene: Scene, points: NDArray[np.floating], low_m: float, high_m: float
) -> NDArray[np.bool_]:
    """Return which places (N, 2) of the floor something stands at between two heights.

    A box that is seen from inside is solid outside.
    """
    found = np.zeros(len(points), np.bool_)
    everything = scene.halves[:, :2].max(axis=1).max()
    for k, (centre, half) in enumerate(zip(scene.centres, scene.halves, strict=True)):
        offsets = points - centre[:2]
        if scene.kinds[k] == SPHERE:
            away = max(low_m - centre[2], centre[2] - high_m, 0.0)
            if away < half[0]:
                found |= np.sum(offsets**2, axis=1) < half[0] ** 2 - away**2
            continue
        if centre[2] + half[2] <= low_m or centre[2] - half[2] >= high_m:
            continue
        local = np.abs(offsets @ scene.R_world_local[k][:2, :2])
        inside = (local < half[:2]).all(axis=1)
        is_room = half[:2].max() == everything and half[2] > 1.0
        found |= ~inside if is_room else inside
    return found


def truth(
    grid: OccupancyMap, scene: Scene, T_map_world: NDArray[np.float64], config: GridConfig
) -> Truth:
    """Return what the cells are; each is sampled from edge to edge."""

    def touched(grown_m: float) -> NDArray[np.bool_]:
        rows, columns = grid.cells.shape
        y, x = np.mgrid[:rows, :columns] * grid.resolution_m
        found = np.zeros(grid.cells.shape, np.bool_)
        steps = np.linspace(-grown_m, grid.resolution_m + grown_m, _ACROSS)
        T_world_map = se3.inverse(T_map_world)
        for dx in steps:
            for dy in steps:
                places = np.stack([x + dx, y + dy, np.zeros(x.shape)], axis=-1).reshape(-1, 3)
                there = se3.transform(T_world_map, places + np.array([*grid.origin_m, 0.0]))
                hits = solid(scene, there[:, :2], config.min_height_m, config.max_height_m)
                found |= hits.reshape(found.shape)
        return found

    return Truth(touched(-_EDGE_M), ~touched(_EDGE_M), touched(0.0))


def score(grid: OccupancyMap, true: Truth) -> Score:
    """Return the score of a grid."""
    is_known, says = grid.cells != UNKNOWN, grid.cells == OCCUPIED
    right = np.where(says, true.occupied, true.free)
    free, occupied = is_known & true.free, is_known & true.occupied
    return Score(
        int((free | occupied).sum()),
        float(right[free | occupied].mean()),
        float(right[free].mean()),
        float(right[occupied].mean()),
        float((says == true.touched)[is_known].mean()),
        float((grid.cells == FREE)[true.free].mean()),
    )


def opened(address: str, seed: int) -> SyntheticSource:
    """Return the source of an address and a seed."""
    joint = '&' if '?' in address else '?'
    return SyntheticSource.from_address(f'{address}{joint}seed={seed}')


def views_of(
    source: SyntheticSource, frames: Iterable[object]
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float64]]]:
    """Track; yield depth (H, W) and T_map_cam (4, 4) of what the mapper would get."""
    assert source.groundtruth is not None
    first = source.groundtruth.T_world_cam[0]
    tracker = Tracker(source.camera, Config(sensor=source.sensor), on_floor(first) @ first)
    selector = KeyframeSelector(tracker.config.mapping.view_interval)
    rectify = Rectifier(source.camera)
    for frame in frames:
        assert isinstance(frame, RgbdFrame)
        result = tracker.track(frame)
        for view in selector.select(tracker.corrected(frame), result):
            yield rectify(view.frame, view.T_cam_cam_at_depth).depth_m, view.T_world_cam


def mapped(address: str, seed: int, config: GridConfig) -> tuple[Score, list[float]]:
    """Return the score of a scene's grid, and the processor time (V,) of each update, ms."""
    source = opened(address, seed)
    grid = OccupancyMapper(source.camera, source.sensor, config)
    times_ms = []
    for depth_m, T_map_cam in views_of(source, source):
        begin = time.thread_time()
        grid.insert(depth_m, T_map_cam)
        times_ms.append(1e3 * (time.thread_time() - begin))
    assert source.groundtruth is not None
    T_map_world = on_floor(source.groundtruth.T_world_cam[0])
    true = truth(grid.map, source.scene, T_map_world, config)
    return score(grid.map, true), times_ms[1:]


class _WithCrate(SyntheticSource):
    """A room with a crate on the floor."""

    def __init__(self, scene: str, options: SyntheticOptions, name: str) -> None:
        super().__init__(scene, options, name)
        build = SceneBuilder()
        build.box(_CRATE[0], _CRATE[1], 'books', 0.8)
        room = self._scenario.scene
        crate = build.build((0, 0, 0), 0.0)
        self._scenario = replace(self._scenario, scene=room.beside(crate))


def ghosts(seed: int, config: GridConfig) -> tuple[int, int]:
    """Return how many cells are occupied by a crate: before it goes, and at the end.

    They are those where it stood and nothing else does.
    """
    address = f'{ADDRESSES[0]}&seed={seed}'
    empty, full = (kind.from_address(address) for kind in (SyntheticSource, _WithCrate))
    half = len(empty) // 2
    frames = chain(islice(full, half), islice(empty, half, None))
    grid, found = OccupancyMapper(empty.camera, empty.sensor, config), []
    for depth_m, T_map_cam in views_of(empty, frames):
        grid.insert(depth_m, T_map_cam)
        found.append(replace(grid.map, cells=grid.map.cells.copy()))
    assert empty.groundtruth is not None
    T_map_world = on_floor(empty.groundtruth.T_world_cam[0])
    counts = []
    for one in (found[len(found) // 2 - 5], found[-1]):
        stood = truth(one, full.scene, T_map_world, config).occupied
        gone = truth(one, empty.scene, T_map_world, config).free
        counts.append(int((one.cells[stood & gone] == OCCUPIED).sum()))
    return counts[0], counts[1]


def rows(addresses: list[str], seeds: list[int]) -> Iterator[list[str]]:
    """Yield the cells of the table's rows."""
    for address in addresses:
        for seed in seeds:
            found, times_ms = mapped(address, seed, GridConfig())
            shares = (
                found.right, found.free_right, found.occupied_right, found.every, found.free_found,
            )  # fmt: skip
            yield [
                address, str(seed), str(found.known), *(f'{100 * share:.2f}' for share in shares),
                f'{np.median(times_ms):.1f}', f'{max(times_ms):.1f}',
            ]  # fmt: skip


def print_times(config: GridConfig) -> None:
    """Insert the views of a room in different places, then move them all by a little."""
    source = SyntheticSource.from_address('synthetic:room?frames=300')
    assert source.groundtruth is not None
    depths = [source.render(k).depth_m for k in range(0, 300, 30)]
    seen_from = source.groundtruth.T_world_cam[::30]
    rng = np.random.default_rng(0)
    poses = np.array([seen_from[k % len(depths)] for k in range(_VIEWS)])
    poses[:, :2, 3] += rng.uniform(-_HALF_SIDE_M, _HALF_SIDE_M, (_VIEWS, 2))
    grid = OccupancyMapper(source.camera, source.sensor, config)
    grid.insert(depths[0], poses[0])
    times_ms = []
    for k in range(1, _VIEWS):
        begin = time.thread_time()
        grid.insert(depths[k % len(depths)], poses[k])
        times_ms.append(1e3 * (time.thread_time() - begin))
    height, width = (0.05 * side for side in grid.map.cells.shape)
    poses[:, 0, 3] += np.linspace(0.0, 0.3, _VIEWS)
    begin = time.thread_time()
    grid.move(poses)
    while grid.work():
        pass
    rebuilt_s = time.thread_time() - begin
    print(
        f'{_VIEWS} views over {width:.0f} x {height:.0f} m: update {np.median(times_ms):.1f} ms, '
        f'99 % {np.percentile(times_ms, 99):.1f}, at most {max(times_ms):.1f}; built again in '
        f'{rebuilt_s:.2f} s; {1e-6 * grid.bytes:.1f} MB of views'
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('addresses', nargs='*', default=list(ADDRESSES))
    parser.add_argument('--seeds', type=int, nargs='+', default=[2, 3])
    parser.add_argument('--ghosts', action='store_true')
    parser.add_argument('--times', action='store_true')
    arguments = parser.parse_args()
    if arguments.ghosts:
        for seed in arguments.seeds:
            before, after = ghosts(seed, GridConfig())
            print(f'seed {seed}: {before} cells occupied by the crate, {after} at the end')
        return
    if arguments.times:
        print_times(GridConfig())
        return
    print(f'| {" | ".join(COLUMNS)} |\n|{"---|" * len(COLUMNS)}', flush=True)
    for cells in rows(arguments.addresses, arguments.seeds):
        print(f'| {" | ".join(cells)} |', flush=True)


if __name__ == '__main__':
    main()
