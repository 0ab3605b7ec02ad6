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
from .expectation import ExpectedPlace
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
_EXPECTED_S = 5.0  # for which the camera is looked for where somebody says it is, and only there


@dataclass(frozen=True)
class Known:
    """What a frame is looked for with."""

    memory: Memory  # of the camera, as it was before it was lost
    gaussians: GaussianMap
    claims: PoseClaims
    clocks: Clocks
    recogniser: Recogniser | None
    config: Config


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
        expected: ExpectedPlace | None = None,
    ) -> None:
        """Begin where the camera was last, or where it is `expected`: for 5 s only there."""
        self._camera, self._visited, self._expected = camera, visited, expected
        poses = _unrecognisable(visited, recogniser)
        self._everywhere = Relocalizer(motion.T_world_cam, poses, usual)
        self._relocalizer = self._everywhere
        if expected is not None:
            self._relocalizer = Relocalizer(expected.T_world_cam, expected.poses(), usual)
        # Where all places are known by their looks, depth alone is not believed around it.
        self._by_looks = expected is not None and not poses
        self._stamp_ns = motion.stamp_ns  # of the last frame in which the camera was looked for
        self._expected_s = 0.0  # of frames that found no place where it was expected
        self.seconds = 0.0  # of frames that found no place

    def move(self, T_world_cam: NDArray[np.float64], recogniser: Recogniser | None) -> None:
        """Go on after the map was corrected; the last pose (4, 4) is there now."""
        self._everywhere.move(T_world_cam, _unrecognisable(self._visited, recogniser))

    def find(
        self, frame: RgbdFrame, known: Known, guesses: Sequence[NDArray[np.float64]] = ()
    ) -> Sought:
        """Try a few of the places where the camera may be, the `guesses` (4, 4) among them."""
        step_s = min((frame.stamp_ns - self._stamp_ns) * 1e-9, _STEP_S)
        self._stamp_ns = frame.stamp_ns
        found = self._best(frame, known, guesses)
        uncertainty = known.claims.uncertainty(found.registration)
        if self._holds(found, uncertainty, known):
            return Sought(found, uncertainty)
        if self._expected is None:
            self.seconds += step_s
        else:
            self._expected_s += step_s
            if self._expected_s >= _EXPECTED_S:
                self._expected, self._relocalizer = None, self._everywhere
                self._by_looks = False
        return Sought(found, None)

    def _best(
        self, frame: RgbdFrame, known: Known, guesses: Sequence[NDArray[np.float64]]
    ) -> Estimate:
        """Return the estimate at the place that explains most of the frame."""
        config, memory = known.config, known.memory
        prior = memory.prior(frame.stamp_ns)
        cloud = sample(frame, self._camera, config, config.cloud.stride_px, np.zeros(6))
        depth = DepthTerm(cloud, known.gaussians, self._camera.focal, config)
        if not memory.is_gap(frame.stamp_ns) and self._expected is None:
            guesses = [*guesses, prior.T_world_cam]
        recognises = self._relocalizer.wants_places or self._by_looks
        places = self._recognised(frame, known) if recognises else []
        best = self._relocalizer.best(depth, config, guesses, places)
        T, grey = best.T_world_cam, to_grey(frame.color)
        registered = RegisteredFrame(frame, T, np.eye(4), grey, np.zeros(6), np.zeros(6))
        return Estimate(registered, best, Landmarks.none(), None, True, prior)

    def _holds(self, found: Estimate, uncertainty: PoseUncertainty, known: Known) -> bool:
        """Return whether the camera is where the estimate says."""
        best, frame, T = found.registration, found.registered.frame, found.registered.T_world_cam
        config, claims, clocks = known.config, known.claims, known.clocks
        if self._expected is not None and not self._expected.admits(T):
            return False
        if self._by_looks and best.image is None:
            return False
        agreement = known.gaussians.agreement(T, frame.depth_m, self._camera, config.sensor)
        if not (found.is_trusted(config) and self._relocalizer.accepts(best, agreement)):
            return False
        spectrum = observability(best.equations.H, uncertainty.information)
        measured = claims.measured(uncertainty, clocks)
        if claims.is_degenerate(spectrum, measured):
            return False  # it may be anywhere along that direction
        if known.memory.is_gap(frame.stamp_ns):
            return True
        return found.prior.sigmas_to(T, claims.in_doubt(measured)) <= JUMP_SIGMAS

    def _recognised(
        self, frame: RgbdFrame, known: Known
    ) -> list[tuple[NDArray[np.float64], PointFactors]]:
        """Return where a frame may have been taken by what it shows, and what speaks for it."""
        if known.recogniser is None:
            return []
        focal, sensor, poses = self._camera.focal, known.config.sensor, self._visited.poses
        expected = self._expected
        places = [
            (poses[one.keyframe] @ one.T_keyframe_cam,
             one.factors(poses[one.keyframe], focal, sensor))
            for one in known.recogniser.recognise(frame)
        ]  # fmt: skip
        return [place for place in places if expected is None or expected.admits(place[0])]


def _unrecognisable(visited: Visited, recogniser: Recogniser | None) -> list[NDArray[np.float64]]:
    """Return the poses (4, 4) of the keyframes whose places are not known by appearance.

    There the camera is looked for by depth alone, which takes one doorway for the next. Where a
    place is known, what it looks like has to agree.
    """
    return [
        T for k, T in enumerate(visited.poses) if recogniser is None or not recogniser.knows(k)
    ]
