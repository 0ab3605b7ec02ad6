# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Densification: which Gaussians a keyframe adds to the map, and which ones are removed again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..config.stages import Config
from ..render.renderer import Rendering, View
from .exposure import Exposure
from .rectification import Images
from .seeding import Surface, discs, lacking
from .splat_table import SplatTable
from .splats import Splats
from .views import KeyframeView


@dataclass(frozen=True)
class Observation:
    """A keyframe at the moment it is inserted, and what the map shows from its pose."""

    images: Images  # undistorted
    valid: NDArray[np.bool_]  # (H, W) pixels that the undistorted image covers
    view: View  # the camera at full resolution, in the mapper's world
    exposure: Exposure
    rendering: Rendering  # of the map before, one pixel for each shrink x shrink
    shrink: int


class Densification(Protocol):
    """Decides which Gaussians the map gains and loses; the mapper does the bookkeeping.

    The mapper calls `seed` once for each keyframe and `prune` every `mapping.prune_interval`
    steps. It assigns the ids, enforces `mapping.max_gaussians`, removes Gaussians that are not
    finite, and reports removed ones to the tracker. To try another strategy, pass it to `Mapper`:

        class TrackedOnly(DefaultDensification):
            def seed(self, seen: Observation, spawned: Surface, config: Config) -> Splats:
                return self.tracked(seen, spawned, config)

        mapper = Mapper(camera, config, strategy=TrackedOnly())

    The settings come with each call, since a node may change them while it runs.
    """

    def seed(self, seen: Observation, spawned: Surface, config: Config) -> Splats:
        """Return the Gaussians that a keyframe adds, in the mapper's world.

        The first len(spawned.points) of them are those that the tracker spawned, in the order of
        `spawned`; any others are the strategy's own.
        """
        ...

    def prune(
        self, table: SplatTable, views: Sequence[KeyframeView], config: Config
    ) -> NDArray[np.bool_]:
        """Return (N,) which of the Gaussians of `table` are kept; do not change the table."""
        ...


class DefaultDensification:
    """Flat discs where the map lacks some; drops what is transparent, too large or unused."""

    def seed(self, seen: Observation, spawned: Surface, config: Config) -> Splats:
        """Return discs for the tracker's points, then discs where the map still lacks some."""
        lacks = lacking(
            seen.images, seen.rendering, seen.shrink, seen.valid, spawned, seen.view,
            config.mapping,
        )  # fmt: skip
        tracked = self.tracked(seen, spawned, config)
        own = _discs(seen, lacks, config.mapping.spawn_stride_px, config)
        return Splats(np.concatenate([tracked.planes, own.planes], axis=1))

    def tracked(self, seen: Observation, spawned: Surface, config: Config) -> Splats:
        """Return discs for the tracker's points."""
        return _discs(seen, spawned, config.keyframes.spawn_stride_px, config)

    def prune(
        self, table: SplatTable, views: Sequence[KeyframeView], config: Config
    ) -> NDArray[np.bool_]:
        """Keep what is opaque enough, small enough, and has an effect on some image.

        The effect is judged once the Gaussian itself or its host view was optimised
        `trial_visits` times.
        """
        settings, splats = config.mapping, table.splats
        with np.errstate(invalid='ignore', over='ignore'):
            keep = 1 / (1 + np.exp(-splats.opacity_logits)) > settings.prune_opacity
            keep &= splats.log_scales.max(axis=0) < np.log(settings.prune_scale_m)
        hosts = np.array([view.visits for view in views], np.int64)
        tried = np.maximum(table.visits, hosts[table.hosts]) >= settings.trial_visits
        keep &= ~tried | (table.weights > settings.prune_weight)
        return np.asarray(keep)


def _discs(seen: Observation, surface: Surface, spacing_px: float, config: Config) -> Splats:
    return discs(surface, spacing_px, seen.images, seen.view, seen.exposure, config.mapping)
