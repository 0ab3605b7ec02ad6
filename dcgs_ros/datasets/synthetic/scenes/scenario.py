# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What a synthetic scene consists of."""

from __future__ import annotations

from dataclasses import dataclass

from ..motion.path import Motion
from ..raycast import Scene


@dataclass(frozen=True)
class Scenario:
    """A scene, and the motion of the camera through it."""

    scene: Scene
    motion: Motion
    pattern: float  # contrast of an infrared dot pattern on white at 1 m, grey levels
