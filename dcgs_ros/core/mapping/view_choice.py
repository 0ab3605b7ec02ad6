# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Which view the mapper's next step optimises, and at which resolution."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from ..config.stages import MappingConfig
from .views import KeyframeView

COARSE = 2  # a coarse step renders one pixel for COARSE x COARSE of the image


class ViewScheduler:
    """Alternates between the least visited view and rounds that visit every view once."""

    def __init__(self, random: np.random.Generator) -> None:
        """Start without a round; `random` may be shared with others."""
        self._random = random
        self._round: list[KeyframeView] = []  # views still to be visited in this round

    def choose(
        self, views: Sequence[KeyframeView], config: MappingConfig, replay: bool
    ) -> tuple[KeyframeView, int]:
        """Return the next view, one of those that still have images, and its shrink factor.

        The shrink factor is 1 or COARSE. With `replay` all views take turns at full resolution.
        """
        active = [view for view in views if view.active]
        if not replay and self._random.random() < config.newest_share:
            chosen = min(reversed(active), key=lambda view: view.visits)
        else:
            if not self._round:
                self._round = [active[k] for k in self._random.permutation(len(active))]
            chosen = self._round.pop()
        coarse = not replay and self._random.random() < config.coarse_share
        return chosen, COARSE if coarse else 1

    def begin_with(self, views: Sequence[KeyframeView], first: Collection[int]) -> None:
        """Begin a round of all views in which those with the indices `first` come first."""
        order = [views[k] for k in self._random.permutation(len(views)) if views[k].active]
        self._round = sorted(order, key=lambda view: view.index in first)  # taken from the end

    def restart(self) -> None:
        """Begin a new round with the next call: some views have lost their images."""
        self._round.clear()
