# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The synthetic scenes by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .corridor import corridor
from .desk import desk
from .furnished import plane, room, zigzag
from .ring import ring
from .scenario import Scenario

_HAND, _WHEELS_FIRST = ('handheld',), ('wheeled', 'handheld')


@dataclass(frozen=True)
class SceneKind:
    """How a scene is built, and what can be chosen of it."""

    build: Callable[..., Scenario]  # of a random generator, and `motion` and `extras` by name
    motions: tuple[str, ...] = _HAND  # the first is the default
    sensor: str = 'kinect'  # unless another is asked for
    extras: Mapping[str, Any] = field(default_factory=dict)  # options of its own, with defaults


SCENES = {
    'room': SceneKind(room, ('handheld', 'wheeled', 'turning'), extras={'mover': None}),
    'plane': SceneKind(plane),
    'zigzag': SceneKind(zigzag),
    'desk': SceneKind(desk, sensor='d435i_measured'),
    'corridor': SceneKind(corridor, _WHEELS_FIRST, 'd435i_measured'),
    'ring': SceneKind(
        ring, (*_WHEELS_FIRST, 'errand'), 'd435i_measured', {'period': 0.0, 'direction': 'ccw'}
    ),
}
SCENE_NAMES = tuple(SCENES)


def build_scenario(name: str, seed: int, motion: str | None = None, **extras: Any) -> Scenario:
    """Build one of `SCENE_NAMES`; the seed places the clutter."""
    kind = SCENES[name]
    chosen = {'motion': motion or kind.motions[0]} if len(kind.motions) > 1 else {}
    return kind.build(np.random.default_rng((seed, 2)), **chosen, **{**kind.extras, **extras})
