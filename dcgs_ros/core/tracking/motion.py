# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The camera's motion: its prediction for the next frame, and between colour and depth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..config.stages import TimingConfig
from .factors import NormalEquations, PosePrior

_MAX_GAP_S = 0.5  # over a longer one nothing is extrapolated
_LONG_AGO_NS = -(1 << 62)  # longer ago than any stamp
_MIN_INTERVAL_S = 0.005  # a shorter one, by a faulty clock, would make a velocity out of noise
ACCELERATION = 10.0  # m / s^2 of a hand-held camera, standard deviation
ANGULAR_ACCELERATION = 30.0  # rad / s^2
_WEAK = np.eye(6)  # 1 / m^2, 1 / rad^2: keeps a system that says nothing solvable
_JERKY = 1.0  # m / s^2 that change within a frame, standard deviation
_ANGULAR_JERKY = 3.0  # rad / s^2


@dataclass(frozen=True)
class LocalMotion:
    """Motion about one instant, uniformly accelerated, in the camera frame of that instant."""

    twist: NDArray[np.float64]  # (6,) per second
    acceleration: NDArray[np.float64]  # (6,) per second squared

    def pose_after(self, seconds: float) -> NDArray[np.float64]:
        """Return the pose `seconds` later, or earlier, in the frame of the instant: T_now_then."""
        return se3.exp(seconds * (self.twist + 0.5 * seconds * self.acceleration))

    def twist_after(self, seconds: float) -> NDArray[np.float64]:
        """Return the twist `seconds` later, to first order in the same frame."""
        return self.twist + seconds * self.acceleration


@dataclass(frozen=True)
class ConstantVelocity:
    """Extrapolates the last pose with the last twist."""

    T_world_cam: NDArray[np.float64]  # (4, 4) last pose
    stamp_ns: int
    twist: NDArray[np.float64]  # (6,) mean over the last frame interval, per second, camera frame
    interval_s: float = 0.0  # the last frame interval; 0: none yet

    @classmethod
    def at_rest(
        cls, T_world_cam: NDArray[np.float64], stamp_ns: int = _LONG_AGO_NS
    ) -> ConstantVelocity:
        """Begin at a pose (4, 4), standing still; without a stamp, at a time that is not known."""
        return cls(T_world_cam, stamp_ns, np.zeros(6))

    def _since_last_s(self, stamp_ns: int) -> float:
        return max((stamp_ns - self.stamp_ns) * 1e-9, _MIN_INTERVAL_S)

    def is_gap(self, stamp_ns: int) -> bool:
        """Return whether the motion since the last pose is unknown."""
        return self._since_last_s(stamp_ns) > _MAX_GAP_S

    def predict(self, stamp_ns: int) -> NDArray[np.float64]:
        """Return the pose (4, 4) at a later stamp."""
        dt = self._since_last_s(stamp_ns)
        if dt > _MAX_GAP_S:
            return self.T_world_cam
        return self.T_world_cam @ se3.exp(self.twist * dt)

    def prior(self, stamp_ns: int) -> PosePrior:
        """Return the predicted pose, as uncertain as a hand's acceleration makes it."""
        dt = self._since_last_s(stamp_ns)
        half_dt2 = 0.5 * dt * dt
        return PosePrior(
            self.predict(stamp_ns), ACCELERATION * half_dt2, ANGULAR_ACCELERATION * half_dt2
        )

    def arriving(self, T_world_cam: NDArray[np.float64], stamp_ns: int) -> LocalMotion:
        """Return the motion on arrival at this pose, coming from the last one.

        The mean twist is the displacement over the interval. The acceleration is its change since
        the interval before; without it a fast turn is off by tenths of a degree between depth and
        colour.
        """
        dt = self._since_last_s(stamp_ns)
        if dt > _MAX_GAP_S:
            return LocalMotion(np.zeros(6), np.zeros(6))
        mean = se3.log(se3.inverse(self.T_world_cam) @ T_world_cam) / dt
        if self.interval_s == 0.0:
            return LocalMotion(mean, np.zeros(6))
        acceleration = (mean - self.twist) * 2.0 / (dt + self.interval_s)
        return LocalMotion(mean + 0.5 * dt * acceleration, acceleration)

    def passage_covariance(self, stamp_ns: int, lag_s: float) -> NDArray[np.float64]:
        """Return the covariance (6, 6) of the motion between the colour's and depth's instants.

        A path through the last pose and this one deviates by half a (t - t_last) (t - t_now) under
        an acceleration a that differs from the uniform one.
        """
        dt = self._since_last_s(stamp_ns)
        bend = 0.5 * abs(lag_s * (dt + lag_s))
        sigmas = np.repeat([_JERKY * bend, _ANGULAR_JERKY * bend], 3)
        return np.diag(np.square(sigmas) + 1e-14)

    def advanced(self, T_world_cam: NDArray[np.float64], stamp_ns: int) -> ConstantVelocity:
        """Return the motion after a registered pose (4, 4)."""
        dt = self._since_last_s(stamp_ns)
        if dt > _MAX_GAP_S:
            return ConstantVelocity.at_rest(T_world_cam, stamp_ns)
        twist = se3.log(se3.inverse(self.T_world_cam) @ T_world_cam) / dt
        return ConstantVelocity(T_world_cam, stamp_ns, twist, dt)


class ColorDepthOffset:
    """Constant offset of the depth's true time from its stamp, estimated while tracking.

    A depth point reaches the colour's instant as exp(v (dt + tau)) a, so an error of tau moves the
    depth term along the twist v as a pose error would: depth and image then disagree by
    delta = tau v + b, with information S = H_d - H_d (H_d + H_l)^-1 H_d. Here b is the error of
    the map, which includes tau's error when it was spawned, along the velocity at that time. It is
    constant between two keyframes and is marginalised out, so only changes of velocity count.
    """

    def __init__(self, config: TimingConfig) -> None:
        """Start at zero with the prior's information, or at a fixed value."""
        fixed = config.colour_depth_offset_ms
        self.seconds = 0.0 if fixed is None else 1e-3 * fixed
        self._estimating = fixed is None
        self._memory_s = config.memory_s
        self._limit_s = 3e-3 * config.prior_ms
        self._prior = (1e-3 * config.prior_ms) ** -2
        self._information = self._prior  # of the intervals that are over, and the prior
        self._weighted = 0.0  # information times offset
        self._begin_interval()

    @property
    def sigma_s(self) -> float:
        """Standard deviation of the estimate, seconds; 0 of a fixed value."""
        if not self._estimating:
            return 0.0
        return (self._information + self._marginal()[0]) ** -0.5

    def _begin_interval(self) -> None:
        self._system = np.zeros((7, 7))  # information on (b, tau) in the interval under way
        self._right = np.zeros(7)
        self._span_s = 0.0

    def observe(
        self,
        depth: NormalEquations,
        image: NormalEquations,
        twist: NDArray[np.float64],
        dt_s: float,
    ) -> None:
        """Update the estimate from one frame: the equations of depth and image alone.

        `twist` (6,) is that of the depth's instant, per second, camera frame.
        """
        if not self._estimating:
            return
        apart = depth.apart_from(image)
        J = np.column_stack([np.eye(6), twist])
        self._system += J.T @ apart.H @ J
        # delta is what remains with the offset in use: in total it is delta + v tau.
        self._right += J.T @ (apart.g + apart.H @ twist * self.seconds)
        self._span_s += dt_s
        information, weighted = self._marginal()
        estimate = (self._weighted + weighted) / (self._information + information)
        self.seconds = min(max(estimate, -self._limit_s), self._limit_s)

    def _marginal(self) -> tuple[float, float]:
        """Return the current interval's information on tau, and it times tau, without b."""
        S = self._system[:6, :6]
        gain = np.linalg.solve(S + _WEAK, self._system[:6, 6])
        information = float(self._system[6, 6] - gain @ self._system[:6, 6])
        weighted = float(self._right[6] - gain @ self._right[:6])
        return (information, weighted) if information > 0 else (0.0, 0.0)

    def map_changes(self) -> None:
        """End the interval over which b is constant."""
        if self._span_s == 0.0:
            return
        information, weighted = self._marginal()
        fade = math.exp(-self._span_s / self._memory_s)
        # The evidence fades, the prior does not.
        self._information = self._prior + fade * (self._information - self._prior) + information
        self._weighted = fade * self._weighted + weighted
        self._begin_interval()
