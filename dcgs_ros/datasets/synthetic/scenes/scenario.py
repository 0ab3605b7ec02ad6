# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What a synthetic scene consists of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ..motion.path import Motion, Path
from ..raycast import Scene
from .movers import Mover


@dataclass(frozen=True)
class Scenario:
    """A scene, and the motion of the camera through it."""

    scene: Scene
    motion: Motion
    pattern: float  # contrast of an infrared dot pattern on white at 1 m, grey levels
    mover: Callable[[Path], Mover] | None = None  # what moves in front of the camera on its path
