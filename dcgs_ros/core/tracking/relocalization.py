# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Finding the camera in a map, near the poses where it has been."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..config.stages import Config
from ..frame import RgbdFrame
from ..sensor import SensorNoise
from .factors import PointFactors, covariances_along_rays, observed_from
from .registration import DepthTerm, Registration, register
from .verification import Usual

_TRIES = 3  # poses a frame: what real time has room for
# Shares of what is usual that a frame must reach: of the overlap, of the agreement of the map with
# the frame. Noisy depth is explained worse everywhere, so the wanted overlap falls with every
# frame in which nothing is found.
_OVERLAP, _AT_LEAST, _PATIENCE = 0.85, 0.7, 0.005
_AGREEMENT = 0.87
_REFINEMENTS = 4  # of the best fit
_CORNER_PX, _CORNER_HUBER = 1.5, 2.0  # of ORB, whose corners are those of a pyramid
_CHI2 = 2.0  # most of the usual median of depth's residuals


@dataclass(frozen=True)
class Recognition:
    """A keyframe whose corners an image shows, and where it was taken if they are the same."""

    keyframe: int
    T_keyframe_cam: NDArray[np.float64]  # (4, 4)
    points: NDArray[np.float64]  # (I, 3) of the corners, metres, in the keyframe's camera frame
    rays: NDArray[np.float32]  # (I, 2) undistorted x/z, y/z in the image
    depths_m: NDArray[np.float32]  # (I,) there; 0: none

    def factors(
        self, T_world_keyframe: NDArray[np.float64], focal_px: float, sensor: SensorNoise
    ) -> PointFactors:
        """Return the corners as factors of the image's pose in the world.

        Like a landmark, a corner without depth counts across its ray only.
        """
        world = se3.transform(T_world_keyframe, self.points).astype(np.float32)
        centre = np.tile(T_world_keyframe[:3, 3], (len(world), 1))
        hosts = np.full(len(world), self.keyframe, np.int32)
        anchor = _CORNER_PX / focal_px
        targets = observed_from(world, centre, sensor, anchor, hosts)
        expected = se3.transform(se3.inverse(self.T_keyframe_cam), self.points)[:, 2]
        z = np.where(self.depths_m > 0.0, self.depths_m, expected)
        points = (np.column_stack([self.rays, np.ones(len(z))]) * z[:, None]).astype(np.float32)
        ranges = np.linalg.norm(points, axis=1)
        along = np.where(self.depths_m > 0.0, np.square(sensor.sigma(ranges)), 1.0)
        covariances = covariances_along_rays(points, np.square(anchor * ranges), along)
        return PointFactors(points, covariances, targets, huber=_CORNER_HUBER)


class Recogniser(Protocol):
    """Knows places by what they look like."""

    def recognise(self, frame: RgbdFrame) -> list[Recognition]:
        """Return where a frame may have been taken, the likeliest first."""
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
        self._frames = 0
        self._wanted = _OVERLAP

    def move(
        self, T_world_cam: NDArray[np.float64], visited: Sequence[NDArray[np.float64]]
    ) -> None:
        """Go on after the map was corrected, with these poses instead."""
        self._last, self._visited = T_world_cam, list(visited[::-1])

    def best(
        self,
        depth: DepthTerm,
        config: Config,
        guesses: Sequence[NDArray[np.float64]] = (),
        recognised: Sequence[tuple[NDArray[np.float64], PointFactors]] = (),
    ) -> Registration:
        """Register the cloud from the guesses and the next few poses; return the best fit.

        Where places are `recognised`, only those are tried, and what is seen of them counts
        beside the cloud.
        """
        settings = config.registration
        self._frames += 1
        starts: list[tuple[NDArray[np.float64], PointFactors | None]] = list(recognised)
        if not starts:
            starts = [(T, None) for T in [*guesses, *self._some()]]
        found = [register(T, depth, image, config, settings.guess_radius_m) for T, image in starts]
        best = max(found, key=lambda result: result.overlap)
        for _ in range(_REFINEMENTS):  # from far away one registration does not arrive
            best = register(best.T_world_cam, depth, best.image, config, settings.radius_m)
        return best

    @property
    def wants_places(self) -> bool:
        """Whether the next frame is to be recognised: every second one, as a place may look alike.

        The first is not: most often the camera is still where it was.
        """
        return self._frames % 2 == 1

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
