# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""How uncertainty goes on from frame to frame, and from keyframe to keyframe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..covariances import FLOOR, common_axes, surer
from ..priors.readings import MotionFactor
from .hosting import Hosts
from .motion import ACCELERATION, ANGULAR_ACCELERATION

_FRAMES = 30.0  # over which beta^2 is averaged
_ANY = np.eye(6)  # 1 m and 1 rad, and per second: where nothing is known
_ACCELERATION2 = np.diag(np.repeat([ACCELERATION**2, ANGULAR_ACCELERATION**2], 3))


@dataclass(frozen=True)
class BiasVariance:
    """beta^2 of the smooth relative bias of depth, averaged over the last frames.

    Each frame's evidence is a numerator, which is noisy and may be negative, and a denominator.
    """

    numerator: float = 0.0
    denominator: float = 0.0

    @property
    def beta2(self) -> float:
        """Estimate; 0 before any evidence."""
        return max(self.numerator, 0.0) / max(self.denominator, 1e-300)

    def observed(self, evidence: tuple[float, float]) -> BiasVariance:
        """Return the average with one more frame's evidence."""
        fade = 1.0 - 1.0 / _FRAMES
        return BiasVariance(
            fade * self.numerator + evidence[0], fade * self.denominator + evidence[1]
        )


@dataclass(frozen=True)
class MotionLimit:
    """How far a camera can have gone since it was last known: what no measurement holds drifts.

    The pose of a frame goes on at constant velocity along the directions that the frame does not
    measure. Its uncertainty along them grows by that of the velocity, to which the accelerations
    of a hand add in each frame.
    """

    T_world_cam: NDArray[np.float64]  # (4, 4)
    stamp_ns: int
    joint: NDArray[np.float64]  # (12, 12) covariance of the pose and of its twist per second
    motion_covariance: NDArray[np.float64]  # (6, 6) of the motion since the last pose, if any

    @property
    def covariance(self) -> NDArray[np.float64]:
        """(6, 6) of the pose."""
        return self.joint[:6, :6]

    @classmethod
    def begun(
        cls, measured: NDArray[np.float64], T_world_cam: NDArray[np.float64], stamp_ns: int
    ) -> MotionLimit:
        """Begin at a pose (4, 4) with the covariance `measured` (6, 6), at any velocity."""
        zero, known = np.zeros((6, 6)), surer(measured, _ANY)
        joint = np.block([[known, zero], [zero, _ANY]])
        return cls(T_world_cam, stamp_ns, joint, known)

    def updated(
        self,
        measured: NDArray[np.float64],
        T_world_cam: NDArray[np.float64],
        stamp_ns: int,
        sensed: Sequence[MotionFactor] = (),
    ) -> MotionLimit:
        """Return the limit after a frame whose measurements have the covariance `measured`.

        Along each direction the surer of measurement and prediction counts. They are not
        combined, because the estimate is not either. What that tells of the pose tells of the
        velocity too: joint' = joint + G (P' - P) G^T with the gain G = joint[:, pose] P^-1.
        What other sensors have `sensed` of the motion limits the prediction.
        """
        Ad = se3.adjoint(se3.inverse(T_world_cam) @ self.T_world_cam)
        dt = (stamp_ns - self.stamp_ns) * 1e-9
        predicted = self._predicted(Ad, dt)
        before = predicted[:6, :6]
        bounded = before if np.trace(before) < 1.0 else surer(before, _ANY)
        for one in sensed:
            bounded = surer(bounded, one.added_to(Ad @ self.covariance @ Ad.T))
        half, ratios = common_axes(measured, bounded)
        known = (half * np.minimum(ratios, 1.0)) @ half.T
        gain = np.linalg.solve(before + FLOOR, predicted[:6]).T
        joint = predicted + gain @ (known - before) @ gain.T
        joint[:6, :6] = known
        held = (half * (ratios < 1.0)) @ np.linalg.inv(half)
        motion = self._motion(measured, held, Ad, dt)
        return MotionLimit(T_world_cam, stamp_ns, 0.5 * (joint + joint.T), motion)

    def _motion(
        self,
        measured: NDArray[np.float64],
        held: NDArray[np.float64],
        Ad: NDArray[np.float64],
        dt: float,
    ) -> NDArray[np.float64]:
        """Return the covariance (6, 6) of the motion since the last pose.

        Along what the frame holds, which the projection `held` (6, 6) keeps, it is the difference
        of two measured poses, whose errors are taken as independent. Along the rest the pose goes
        on at constant velocity: there the error of the last one is in both.
        """
        both = Ad @ self.covariance @ Ad.T + measured
        coasted = dt**2 * Ad @ self.joint[6:, 6:] @ Ad.T + 0.25 * dt**4 * _ACCELERATION2
        rest = np.eye(6) - held
        return np.asarray(held @ both @ held.T + rest @ coasted @ rest.T)

    def _predicted(self, Ad: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
        """Return the joint covariance (12, 12) `dt` seconds later, before the measurement there.

        `Ad` (6, 6) takes the last camera's axes to those of the pose there.
        """
        F = np.block([[Ad, dt * Ad], [np.zeros((6, 6)), Ad]])
        kick = np.vstack([0.5 * dt * dt * np.eye(6), dt * np.eye(6)])
        return np.asarray(F @ self.joint @ F.T + kick @ _ACCELERATION2 @ kick.T)


class KeyframeChain:
    """Covariances of the keyframes' poses in the world, passed on from one to the next.

    A frame is placed relative to the Gaussians that it matches, and these are as wrong as the
    keyframes that host them. Its covariance in the world is theirs and its own in addition, see
    `Hosts`. Back where the map began it is small again.
    """

    def __init__(self) -> None:
        """Start without keyframes."""
        self._covariances = np.empty((0, 6, 6))  # of eps in exp(eps) T_world_cam

    def reset(self, keyframes: int = 0) -> None:
        """Start anew with keyframes that are certain: the world is theirs."""
        self._covariances = np.zeros((keyframes, 6, 6))

    @property
    def covariances(self) -> NDArray[np.float64]:
        """(K, 6, 6) of eps in exp(eps) T_world_cam."""
        return self._covariances

    def correct(self, covariances: NDArray[np.float64], motions: NDArray[np.float64]) -> None:
        """Take those (K, 6, 6) of the first keyframes; later ones, moved, are as sure as the last.

        `motions` (M, 4, 4), of all keyframes, is from where the world had each to where it is now.
        """
        known = len(covariances)
        Ad = se3.adjoint(motions[known:])
        later = Ad @ self._covariances[known:] @ Ad.transpose(0, 2, 1)
        self._covariances = np.concatenate([covariances, later])

    def add(self, T_world_cam: NDArray[np.float64], covariance: NDArray[np.floating]) -> None:
        """Add a keyframe with the covariance (6, 6) of its pose in the world, camera frame."""
        Ad = se3.adjoint(T_world_cam)
        self._covariances = np.concatenate([self._covariances, [Ad @ covariance @ Ad.T]])

    def in_world(
        self,
        T_world_cam: NDArray[np.float64],
        hosts: Hosts,
    ) -> NDArray[np.float64]:
        """Return the covariance (6, 6) in the world of a frame that its hosts hold."""
        return hosts.inherited(self.seen_from(T_world_cam, hosts.keyframes))

    def seen_from(
        self, T_world_cam: NDArray[np.float64], keyframes: NDArray[np.integer]
    ) -> NDArray[np.float64]:
        """Return the covariances (H, 6, 6) of keyframes, in the frame of a camera (4, 4)."""
        Ad = se3.adjoint(se3.inverse(T_world_cam))
        return np.asarray(Ad @ self._covariances[keyframes] @ Ad.T)
