# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Finding the camera in a map, near the poses where it has been."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..config.stages import Config
from ..frame import RgbdFrame
from .registration import DepthTerm, Registration, register
from .verification import Usual

_TRIES = 3  # poses a frame: what real time has room for
# Shares of what is usual that a frame must reach: of the overlap, of the agreement of the map with
# the frame. Noisy depth is explained worse everywhere, so the wanted overlap falls with every
# frame in which nothing is found.
_OVERLAP, _AT_LEAST, _PATIENCE = 0.85, 0.7, 0.005
_AGREEMENT = 0.87
_REFINEMENTS = 4  # of the best fit
_CHI2 = 2.0  # most of the usual median of depth's residuals


class Recogniser(Protocol):
    """Knows places by what they look like."""

    def recognise(self, frame: RgbdFrame) -> list[tuple[int, NDArray[np.float64]]]:
        """Return keyframes and T_keyframe_cam (4, 4) where a frame may be, the likeliest first."""
        ...


class Relocalizer:
    """Tries to register each frame from a few of the poses where the camera has been."""

    def __init__(
        self,
        T_world_cam: NDArray[np.float64],
        visited: Sequence[NDArray[np.float64]],
        usual: Usual,
    ) -> None:
        """Try the last pose (4, 4) always, and the visited ones in turn, the newest first."""
        self._last = T_world_cam
        self._visited = list(visited[::-1])
        self._next = 0
        self._usual = usual
        self._wanted = _OVERLAP

    def move(
        self, T_world_cam: NDArray[np.float64], visited: Sequence[NDArray[np.float64]]
    ) -> None:
        """Go on after the map was corrected, with these poses instead."""
        self._last, self._visited = T_world_cam, list(visited[::-1])

    def best(
        self, depth: DepthTerm, config: Config, guesses: Sequence[NDArray[np.float64]] = ()
    ) -> Registration:
        """Register the cloud from the guesses and the next few poses; return the best fit."""
        settings = config.registration
        starts = [*guesses, *self._some()]
        found = (register(T, depth, None, config, settings.guess_radius_m) for T in starts)
        best = max(found, key=lambda result: result.overlap)
        for _ in range(_REFINEMENTS):  # from far away one registration does not arrive
            best = register(best.T_world_cam, depth, None, config, settings.radius_m)
        return best

    def accepts(self, result: Registration, agreement: float) -> bool:
        """Return whether the camera is there; if not, the next frame has to explain a bit less.

        A frame may fit a wrong place. The map then shows surfaces that the frame looks through, so
        its `agreement` (`GaussianMap.agreement`) is low; the limit on that never falls.
        """
        usual = self._usual
        if (
            result.overlap >= self._wanted * usual.overlap
            and agreement >= _AGREEMENT * usual.agreement
            and result.median_chi2 <= _CHI2 * usual.expected_chi2
        ):
            return True
        self._wanted = max(self._wanted - _PATIENCE, _AT_LEAST)
        return False

    def _some(self) -> list[NDArray[np.float64]]:
        """Return the last pose and the visited ones whose turn it is."""
        n = len(self._visited)
        turn = [self._visited[(self._next + k) % n] for k in range(min(_TRIES - 1, n))]
        self._next = (self._next + len(turn)) % max(n, 1)
        return [self._last, *turn]
