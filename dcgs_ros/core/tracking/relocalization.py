# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Looking for the camera in a map it has been in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..config.stages import Config
from .registration import DepthTerm, Registration, register

_TRIES = 3  # poses a frame: what real time has room for
# Share of a frame that the map explains where the camera really is. Noisy depth is explained
# worse everywhere: who finds nothing for long becomes less demanding.
_EXPLAINED, _AT_LEAST, _PATIENCE = 0.7, 0.5, 0.005
_AGREEMENT = 0.87  # of the map with the frame: what it should see and does


class Relocalizer:
    """Starts the registration from where the camera was, a few of those poses with each frame."""

    def __init__(
        self, T_world_cam: NDArray[np.float64], visited: Sequence[NDArray[np.float64]]
    ) -> None:
        """Begin at the last pose (4, 4); then the visited ones take turns, the newest first."""
        self._last = T_world_cam
        self._visited = list(visited[::-1])
        self._next = 0
        self._wanted = _EXPLAINED

    def best(self, depth: DepthTerm, config: Config) -> Registration:
        """Register the cloud from the next few poses; returns what explains most of it."""
        settings = config.registration
        found = (register(T, depth, None, config, settings.guess_radius_m) for T in self._some())
        best = max(found, key=lambda result: result.overlap)
        return register(best.T_world_cam, depth, None, config, settings.radius_m)

    def accepts(self, result: Registration, agreement: float) -> bool:
        """Return whether that is the place; otherwise the next one has to explain a bit less.

        A frame may fit to a wrong place. The map then shows what the frame looks through: such an
        `agreement` (`GaussianMap.agreement`) is not enough, however long it takes.
        """
        if result.overlap >= self._wanted and agreement >= _AGREEMENT:
            return True
        self._wanted = max(self._wanted - _PATIENCE, _AT_LEAST)
        return False

    def _some(self) -> list[NDArray[np.float64]]:
        """Take the last pose and the visited ones whose turn it is."""
        n = len(self._visited)
        turn = [self._visited[(self._next + k) % n] for k in range(min(_TRIES - 1, n))]
        self._next = (self._next + len(turn)) % max(n, 1)
        return [self._last, *turn]
