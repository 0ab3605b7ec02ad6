# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What a simulated depth camera is, and the one without errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ....core.camera import PinholeCamera
from ....core.sensor import SensorNoise
from ..raycast import SceneView

DEPTH_NOISE = 20  # stream of `white_noise`


@dataclass(frozen=True)
class Shot:
    """What a measurement depends on besides the view."""

    seed: int
    index: int  # of the frame
    pattern: float  # `Scenario.pattern`
    light: float = 1.0  # ambient, as a share of the scene's own
    travel_px: float = 0.0  # by how much the image has moved since the first frame


class DepthCamera(Protocol):
    """One kind of depth camera."""

    noise: SensorNoise
    lag_ms: tuple[float, float]  # least and most by which a depth stamp precedes colour's
    offset_ms: float  # true time of depth less its stamp
    sees_texture: bool  # whether `measure` wants the view's radiance
    shift_px: tuple[float, float]  # x, y: by how much depth is registered beside colour

    def measure(self, view: SceneView, camera: PinholeCamera, shot: Shot) -> NDArray[np.float32]:
        """Return measured depth (H, W) in metres, 0 = none."""
        ...


class IdealDepth:
    """True depth at the instant of colour."""

    noise = SensorNoise.floor(0.001)
    lag_ms = (0.0, 0.0)
    offset_ms = 0.0
    sees_texture = False
    shift_px = (0.0, 0.0)

    def measure(self, view: SceneView, camera: PinholeCamera, shot: Shot) -> NDArray[np.float32]:
        """Return the true depth."""
        return view.depth_m
