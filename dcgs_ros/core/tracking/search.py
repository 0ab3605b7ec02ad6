# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The search for a lost camera: where it may be, and whether it is there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..camera import PinholeCamera
from ..config.stages import Config
from ..frame import RgbdFrame
from .claims import Clocks, PoseClaims
from .estimator import Estimate, Memory, RegisteredFrame, sample, to_grey
from .factors import PointFactors
from .gaussian_map import GaussianMap
from .landmarks import Landmarks
from .motion import ConstantVelocity
from .observability import observability
from .registration import DepthTerm
from .relocalization import Recogniser, Relocalizer
from .uncertainty import PoseUncertainty
from .verification import JUMP_SIGMAS, Usual
from .visited import Visited

_STEP_S = 0.2  # that a frame counts for at most in a search


@dataclass(frozen=True)
class Sought:
    """What came of a frame in which the camera was looked for."""

    estimate: Estimate  # the best there is
    uncertainty: PoseUncertainty | None  # None: the camera is not there


class Search:
    """One search for a lost camera, in the map and by what the keyframes look like."""

    def __init__(
        self,
        camera: PinholeCamera,
        motion: ConstantVelocity,
        visited: Visited,
        usual: Usual,
        recogniser: Recogniser | None,
    ) -> None:
        """Begin where the camera was last."""
        self._camera, self._visited = camera, visited
        poses = _unrecognisable(visited, recogniser)
        self._relocalizer = Relocalizer(motion.T_world_cam, poses, usual)
        self._stamp_ns = motion.stamp_ns  # of the last frame in which the camera was looked for
        self.seconds = 0.0  # of frames that found no place

    def move(self, T_world_cam: NDArray[np.float64], recogniser: Recogniser | None) -> None:
        """Go on after the map was corrected; the last pose (4, 4) is there now."""
        self._relocalizer.move(T_world_cam, _unrecognisable(self._visited, recogniser))

    def find(
        self,
        frame: RgbdFrame,
        memory: Memory,
        gaussians: GaussianMap,
        claims: PoseClaims,
        clocks: Clocks,
        recogniser: Recogniser | None,
        config: Config,
        guesses: Sequence[NDArray[np.float64]] = (),
    ) -> Sought:
        """Try a few of the places where the camera may be, the `guesses` (4, 4) among them."""
        step_s = min((frame.stamp_ns - self._stamp_ns) * 1e-9, _STEP_S)
        self._stamp_ns = frame.stamp_ns
        found = self._best(frame, memory.motion, gaussians, recogniser, config, guesses)
        uncertainty = claims.uncertainty(found.registration)
        holds = self._holds(found, uncertainty, memory.motion, gaussians, claims, clocks, config)
        if holds and self._looks_right(found, memory.motion, recogniser):
            return Sought(found, uncertainty)
        self.seconds += step_s
        return Sought(found, None)

    def _best(
        self,
        frame: RgbdFrame,
        motion: ConstantVelocity,
        gaussians: GaussianMap,
        recogniser: Recogniser | None,
        config: Config,
        guesses: Sequence[NDArray[np.float64]],
    ) -> Estimate:
        """Return the estimate at the place that explains most of the frame."""
        cloud = sample(frame, self._camera, config, config.cloud.stride_px, np.zeros(6))
        depth = DepthTerm(cloud, gaussians, self._camera.focal, config)
        if not motion.is_gap(frame.stamp_ns):
            guesses = [*guesses, motion.predict(frame.stamp_ns)]
        wanted = self._relocalizer.wants_places
        places = self._recognised(frame, recogniser, config) if wanted else []
        best = self._relocalizer.best(depth, config, guesses, places)
        T, grey = best.T_world_cam, to_grey(frame.color)
        registered = RegisteredFrame(frame, T, np.eye(4), grey, np.zeros(6), np.zeros(6))
        prior = motion.prior(frame.stamp_ns)
        return Estimate(registered, best, Landmarks.none(), None, True, prior)

    def _holds(
        self,
        found: Estimate,
        uncertainty: PoseUncertainty,
        motion: ConstantVelocity,
        gaussians: GaussianMap,
        claims: PoseClaims,
        clocks: Clocks,
        config: Config,
    ) -> bool:
        """Return whether the camera is where the estimate says."""
        best, frame, T = found.registration, found.registered.frame, found.registered.T_world_cam
        agreement = gaussians.agreement(T, frame.depth_m, self._camera, config.sensor)
        if not (found.is_trusted(config) and self._relocalizer.accepts(best, agreement)):
            return False
        spectrum = observability(best.equations.H, uncertainty.information)
        if claims.is_degenerate(spectrum, claims.measured(uncertainty, clocks)):
            return False  # it may be anywhere along that direction
        if motion.is_gap(frame.stamp_ns):
            return True
        doubt = claims.in_doubt(uncertainty, clocks)
        return found.prior.sigmas_to(T, doubt) <= JUMP_SIGMAS

    def _looks_right(
        self, found: Estimate, motion: ConstantVelocity, recogniser: Recogniser | None
    ) -> bool:
        """Return whether what the image shows was recognised, where it could be.

        Another room may have the same shape. But a camera that was tracked half a second ago is
        still in its own.
        """
        best = found.registration
        if recogniser is None or best.image is not None:
            return True
        here = int(np.bincount(best.hosts).argmax())
        return not (motion.is_gap(found.registered.frame.stamp_ns) and recogniser.knows(here))

    def _recognised(
        self, frame: RgbdFrame, recogniser: Recogniser | None, config: Config
    ) -> list[tuple[NDArray[np.float64], PointFactors]]:
        """Return where a frame may have been taken by what it shows, and what speaks for it."""
        if recogniser is None:
            return []
        focal, sensor, poses = self._camera.focal, config.sensor, self._visited.poses
        return [
            (poses[one.keyframe] @ one.T_keyframe_cam,
             one.factors(poses[one.keyframe], focal, sensor))
            for one in recogniser.recognise(frame)
        ]  # fmt: skip


def _unrecognisable(visited: Visited, recogniser: Recogniser | None) -> list[NDArray[np.float64]]:
    """Return the poses (4, 4) of the keyframes whose places are not known by appearance.

    There the camera is looked for by depth alone, which takes one doorway for the next. Where a
    place is known, what it looks like has to agree.
    """
    return [
        T for k, T in enumerate(visited.poses) if recogniser is None or not recogniser.knows(k)
    ]
