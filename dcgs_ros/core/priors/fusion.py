# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What sensors say of one interval, fused with constant velocity into one prior of the pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..tracking.factors import NormalEquations, PosePrior
from .gravity import UpPrior
from .gyro import Turn
from .planar import FloorPrior
from .readings import MotionFactor

_LIKELY_SIGMAS = 6.0  # of a hand: what is beyond, no robot does either
# Shares of the limits: held by the images below the first, hardly above the second.
_HELD, _UNHELD = 1.0 / 6.0, 0.5
_OPEN = 30.0  # times the limits: sensors may know as little of what images leave open
_LEAST_TRUST = 0.1  # in the images where they hold nothing: a hundred times their sigma then
_AGREEING_CHI2 = 25.0  # of six numbers: one in three thousand is beyond by chance
_STEPS = 4  # of Gauss-Newton: the factors are nearly linear in so small a motion


@dataclass(frozen=True)
class ImagePose:
    """A pose by images alone."""

    T_world_cam: NDArray[np.float64]  # (4, 4)
    covariance: NDArray[np.float64]  # (6, 6) in the map around the camera, honestly
    limits: tuple[float, float]  # metres and radians at which a pose is degenerate

    @property
    def believed(self) -> NDArray[np.float64]:
        """(6, 6) covariance that grows beyond what is claimed, the worse the images hold the pose.

        Along a bare wall the images do not say nothing: they say that the camera moved less than
        it did, in each frame again, and any average with that drifts.
        """
        scale = np.repeat([1.0 / self.limits[0], 1.0 / self.limits[1]], 3)
        variances, axes = np.linalg.eigh(self.covariance * np.outer(scale, scale))
        sigmas = np.clip(np.sqrt(np.maximum(variances, 0.0)), 1e-6, _OPEN)
        weakness = np.clip((sigmas - _HELD) / (_UNHELD - _HELD), 0.0, 1.0)
        sigmas /= np.maximum(1.0 - weakness, _LEAST_TRUST) ** 2
        half = axes * sigmas / scale[:, None]
        return np.asarray(half @ half.T)


@dataclass(frozen=True)
class Way:
    """How the camera moved since the last pose by all sensors together."""

    T_before_now: NDArray[np.float64]  # (4, 4)
    covariance: NDArray[np.float64]  # (6, 6) of the pose after it, in the map around the camera

    @classmethod
    def of(cls, factors: Sequence[MotionFactor], before: NDArray[np.float64]) -> Way:
        """Return the way by factors that together tell all of it, from a covariance (6, 6)."""
        T = factors[-1].T_before_now
        for _ in range(_STEPS):
            system = _drawn(T, [(f.T_before_now, f.information) for f in factors])
            T = T @ se3.exp(np.linalg.solve(system.H, system.g))
        H = system.H
        shares = [np.linalg.solve(H, factor.information) for factor in factors]
        noise, drift = (
            np.sum([S @ part @ S.T for S, part in zip(shares, parts, strict=True)], axis=0)
            for parts in ([f.noise for f in factors], [f.drift for f in factors])
        )
        Ad = se3.adjoint(se3.inverse(T))
        return cls(T, MotionFactor(T, noise, drift).added_to(Ad @ before @ Ad.T))


@dataclass(frozen=True)
class Sensed:
    """What sensors beside the camera say of its motion since the last pose, if anything."""

    factors: tuple[MotionFactor, ...] = ()
    turn: Turn | None = None
    floor: FloorPrior | None = None
    T_base_cam: NDArray[np.float64] | None = None  # (4, 4), where wheels carry the camera
    way: Way | None = None  # where wheels tell how far it went
    up: UpPrior | None = None

    @property
    def spans(self) -> bool:
        """Whether it tells how the camera moved, however long the interval was."""
        return bool(self.factors)

    def fused(
        self, hand: PosePrior, T_world_cam: NDArray[np.float64], twist: NDArray[np.float64]
    ) -> PosePrior:
        """Return the prior after the interval; `hand` is what constant velocity says.

        The last pose is `T_world_cam` (4, 4), the last `twist` (6,) per second, camera frame. The
        mean is that of all together, in information form.
        """
        if self.turn is not None:  # constant velocity in a camera that turns as measured
            hand = replace(hand, T_world_cam=T_world_cam @ self.turn.pose(twist, self.T_base_cam))
        T = hand.T_world_cam
        placed = [(T_world_cam @ f.T_before_now, f.information) for f in self.factors]
        for _ in range(_STEPS):
            system = self._system(T, placed)
            T = T @ se3.exp((system + hand.normal_equations(T)).step(0.0))
        sensed = np.asarray(self._system(T, placed).H, np.float64)
        return replace(hand, T_world_cam=se3.orthonormalised(T), sensed=sensed)

    def with_images(
        self,
        images: ImagePose,
        T_last: NDArray[np.float64],  # (4, 4)
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the pose (4, 4) by images and sensors together, and its covariance (6, 6).

        It is the step of a Kalman filter of the pose in the map around the camera.
        """
        assert self.way is not None
        T, predicted = images.T_world_cam, self.way.covariance
        innovation = se3.log(se3.inverse(T) @ T_last @ self.way.T_before_now)
        seen = images.believed
        chi2 = float(innovation @ np.linalg.solve(predicted + seen, innovation))
        if chi2 > _AGREEING_CHI2:  # wheels that spin, a base that is lifted
            predicted = predicted * chi2
        by_sensors = np.linalg.inv(predicted)
        H, g = np.linalg.inv(seen) + by_sensors, by_sensors @ innovation
        covariance = np.linalg.inv(H)
        beside = self._system(T, [])  # of the same floor, the same up in each frame
        xi = np.linalg.solve(H + beside.H, g + beside.g)
        return np.asarray(T @ se3.exp(xi)), covariance

    def _system(
        self,
        T: NDArray[np.float64],
        placed: list[tuple[NDArray[np.float64], NDArray[np.float64]]],
    ) -> NormalEquations:
        total = _drawn(T, placed)
        for term in (self.floor, self.up):
            if term is not None:
                total = total + term.normal_equations(T)
        return total


def _drawn(
    T: NDArray[np.float64], placed: list[tuple[NDArray[np.float64], NDArray[np.float64]]]
) -> NormalEquations:
    """Return the equations at a pose (4, 4) that others (4, 4) draw, by information (6, 6)."""
    total = NormalEquations(np.zeros((6, 6)), np.zeros(6), 0.0)
    for T_said, information in placed:
        residual = se3.log(se3.inverse(T) @ T_said)
        g = information @ residual
        total = total + NormalEquations(information, g, float(residual @ g))
    return total


def is_likely(factor: MotionFactor, T_world_cam: NDArray[np.float64], hand: PosePrior) -> bool:
    """Return whether a hand could have moved the camera so from a pose (4, 4).

    Wheels that jump and rates out of range are left out before the images are asked.
    """
    sigmas = hand.sigmas_to(T_world_cam @ factor.T_before_now, factor.noise + factor.drift)
    return sigmas < _LIKELY_SIGMAS
