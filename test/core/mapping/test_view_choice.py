# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The order in which views are optimised: rounds, the least visited one, coarse steps."""

from __future__ import annotations

import numpy as np

from dcgs_ros.core.config.stages import MappingConfig
from dcgs_ros.core.mapping.rectification import Images
from dcgs_ros.core.mapping.view_choice import COARSE, ViewScheduler
from dcgs_ros.core.mapping.views import KeyframeView

IMAGES = Images(np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2), np.uint16))


def views_of(count: int) -> list[KeyframeView]:
    return [KeyframeView.of(k, k, np.eye(4), IMAGES, None) for k in range(count)]


def scheduler(seed: int = 0) -> ViewScheduler:
    return ViewScheduler(np.random.default_rng(seed))


def test_a_round_visits_every_view_once_in_another_order_each_time() -> None:
    chooser, views, config = scheduler(), views_of(8), MappingConfig()
    rounds = [
        [chooser.choose(views, config, replay=True)[0].index for _ in views] for _ in range(4)
    ]
    assert all(sorted(order) == list(range(8)) for order in rounds)
    assert len({tuple(order) for order in rounds}) == 4


def test_the_least_visited_view_is_the_newest_of_equals() -> None:
    chooser, views, config = scheduler(), views_of(3), MappingConfig(newest_share=1.0)
    assert chooser.choose(views, config, replay=False)[0].index == 2
    views[0].visits, views[1].visits, views[2].visits = 4, 2, 3
    assert chooser.choose(views, config, replay=False)[0].index == 1


def test_coarse_steps_have_their_share_and_replay_has_none() -> None:
    chooser, views, config = scheduler(), views_of(2), MappingConfig(coarse_share=0.25)
    steps = 2000
    coarse = [chooser.choose(views, config, replay=False)[1] == COARSE for _ in range(steps)]
    assert abs(np.mean(coarse) - 0.25) < 4 * np.sqrt(0.25 * 0.75 / steps)
    assert all(chooser.choose(views, config, replay=True)[1] == 1 for _ in range(20))


def test_views_without_images_are_not_chosen_after_a_restart() -> None:
    chooser, views, config = scheduler(), views_of(6), MappingConfig()
    chooser.choose(views, config, replay=True)
    for view in views[::2]:
        view.retire()
    chooser.restart()
    chosen = {chooser.choose(views, config, replay=True)[0].index for _ in range(6)}
    assert chosen == {1, 3, 5}
