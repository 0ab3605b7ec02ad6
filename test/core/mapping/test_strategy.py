# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Another densification in the mapper: what it decides, and what the mapper does in any case."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.errors import DcgsError
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.kernels.workers import Workers
from dcgs_ros.core.mapping.mapper import Keyframe, Mapper
from dcgs_ros.core.mapping.seeding import Surface
from dcgs_ros.core.mapping.splat_table import SplatTable
from dcgs_ros.core.mapping.splats import Splats
from dcgs_ros.core.mapping.strategy import DefaultDensification, Densification, Observation
from dcgs_ros.core.mapping.views import KeyframeView
from dcgs_ros.core.render.cpu import CpuRenderer

CAMERA = PinholeCamera(48, 36, 40.0, 40.0, 23.5, 17.5)
CONFIG = override(Config(), {'mapping.prune_interval': 5})
WALL_M = 1.5
TRANSPARENT = -9.0  # logit of an opacity far below `prune_opacity`


class TrackedOnly(DefaultDensification):
    """Adds nothing to what the tracker spawned, and keeps everything."""

    def seed(self, seen: Observation, spawned: Surface, config: Config) -> Splats:
        return self.tracked(seen, spawned, config)

    def prune(
        self, table: SplatTable, views: Sequence[KeyframeView], config: Config
    ) -> NDArray[np.bool_]:
        return np.ones(len(table), np.bool_)


class Twice(TrackedOnly):
    """Adds each of the tracker's Gaussians a second time, as its own."""

    def seed(self, seen: Observation, spawned: Surface, config: Config) -> Splats:
        planes = self.tracked(seen, spawned, config).planes
        return Splats(np.concatenate([planes, planes], axis=1))


class Forgetful(TrackedOnly):
    """Leaves one of the tracker's Gaussians out."""

    def seed(self, seen: Observation, spawned: Surface, config: Config) -> Splats:
        return Splats(self.tracked(seen, spawned, config).planes[:, 1:])


def keyframe() -> Keyframe:
    """A grey wall, with Gaussians in its left half only."""
    height, width = CAMERA.height, CAMERA.width
    color = np.full((height, width, 3), 128, np.uint8)
    frame = RgbdFrame(0, 0, color, np.full((height, width), WALL_M, np.float32))
    v, u = (k.ravel() for k in np.mgrid[2:height:5, 2 : width // 2 : 5])
    x, y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    means = (WALL_M * np.stack([x, y, np.ones(len(u))], axis=1)).astype(np.float32)
    normals = np.tile(np.array([0, 0, -1], np.float32), (len(u), 1))
    ids = np.arange(len(u), dtype=np.int64)
    return Keyframe(frame, np.eye(4), np.eye(4), ids, means, normals)


def mapper_with(strategy: Densification | None) -> Mapper:
    workers = Workers(1)
    return Mapper(CAMERA, CONFIG, CpuRenderer(workers), workers, strategy)


def test_another_densification_decides_what_comes_and_what_goes() -> None:
    counts = []
    for strategy in (None, TrackedOnly()):
        mapper, given = mapper_with(strategy), keyframe()
        mapper.insert(given)
        inserted = len(mapper.table)
        mapper.table.splats.opacity_logits[:3] = TRANSPARENT
        for _ in range(5):
            mapper.step()
        counts.append((inserted - len(given.ids), inserted - len(mapper.table)))
    assert counts[0][0] > 10 and counts[0][1] >= 3
    assert counts[1] == (0, 0)


def test_own_gaussians_get_ids_from_minus_one_downwards_and_stay_out_of_updates() -> None:
    mapper, given = mapper_with(Twice()), keyframe()
    mapper.insert(given)
    n = len(given.ids)
    np.testing.assert_array_equal(mapper.table.ids, [*range(n), *range(-1, -n - 1, -1)])
    planes = mapper.table.splats.planes
    np.testing.assert_array_equal(planes[:, :n], planes[:, n:])
    np.testing.assert_array_equal(mapper.table.measured[:, :n], given.means.T)
    assert np.isfinite(mapper.table.reach_m[:n]).all() and np.isinf(mapper.table.reach_m[n:]).all()
    mapper.step()
    assert (mapper.update().ids >= 0).all()


def test_gaussians_that_are_not_finite_are_removed_even_if_the_strategy_keeps_them() -> None:
    mapper = mapper_with(TrackedOnly())
    mapper.insert(keyframe())
    mapper.table.splats.planes[0, 4] = np.nan
    mapper.prune()
    assert mapper.poisoned == 1 and mapper.update().removed.tolist() == [4]


def test_a_strategy_that_leaves_out_the_trackers_gaussians_is_refused() -> None:
    with pytest.raises(DcgsError, match='strategy'):
        mapper_with(Forgetful()).insert(keyframe())


def test_settings_that_change_hold_from_the_next_keyframe_and_step_on() -> None:
    """As when a parameter of the node is set while it runs."""
    first, second = mapper_with(None), mapper_with(None)
    second.config = override(CONFIG, {'mapping.spawn_stride_px': 12, 'mapping.prune_opacity': 0.9})
    for mapper in (first, second):
        mapper.insert(keyframe())
    assert len(second.table) < len(first.table)
    first.prune()
    inserted = len(second.table)
    second.prune()
    assert len(first.table) > 0 and len(second.table) < inserted
