# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Roll and pitch of the camera against gravity, by an accelerometer and the gyro beside it.

Over a window of T seconds the specific forces f, turned into the camera's frame at its end, tell
where up is there,

    g up = 1/T (integral of f dt - change of velocity by the poses) - b + noise,

b being the accelerometer's bias. The gyro carries up from frame to frame, whatever the map says. A
Kalman filter follows the error of up, in a level frame of its own, and b, which is what turns with
the camera. The prior of each pose holds up where it was in the world when the map began.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..tracking.factors import NormalEquations
from .gyro import Gyro
from .innovation import InnovationMonitor, corrected
from .readings import SpecificForce, Timeline

_G = 9.81  # m/s^2; from 9.78 to 9.83 on Earth, which changes no direction
_WINDOW_S = 1.0  # long against the noise of the velocities at its ends
_GAP_NS = 100_000_000  # between two frames, or two readings: what is between is not known
_HOLD_NS = 25_000_000  # that the last reading stands for
_NOISE = 5e-3  # rad: velocities to 2 cm/s at both ends, and the IMU's place beside the camera
_TURNING = 1.5e-3  # rad per sqrt(s) that the gyro's noise and bias turn up
_BIAS, _BIAS_WALK = 0.1, 1e-3  # m/s^2, and per sqrt(s)
_NORM = 0.3  # m/s^2 that a mean force may be off from g, bias included: else no measurement


@dataclass(frozen=True)
class UpPrior:
    """A term of the cost: where up is, seen from the camera."""

    up_world: NDArray[np.float64]  # (3,) unit vector
    up_cam: NDArray[np.float64]  # (3,) the same by gravity
    sigma_rad: float

    def normal_equations(self, T_world_cam: NDArray[np.float64]) -> NormalEquations:
        """Return the term of the residual up_cam - R^T up_world (3,), in sigmas."""
        seen = T_world_cam[:3, :3].T @ self.up_world
        J = np.zeros((3, 6))
        J[:, 3:] = np.cross(seen, np.eye(3)).T / self.sigma_rad  # of seen x turn
        residual = (self.up_cam - seen) / self.sigma_rad
        return NormalEquations(J.T @ J, J.T @ residual, float(residual @ residual))


@dataclass(frozen=True)
class _Followed:
    """A frame of a window."""

    stamp_ns: int
    T_world_cam: NDArray[np.float64]
    R_before_now: NDArray[np.float64]  # (3, 3) by the gyro
    force: NDArray[np.float64]  # (3,) mean since the frame before, m/s^2, in the camera's frame


class Gravity:
    """Forces of an accelerometer, and where up is by them."""

    def __init__(self, R_cam_imu: NDArray[np.float64], gyro: Gyro) -> None:
        """Take the rotation (3, 3) from the IMU's frame to the camera's, and the gyro beside."""
        self._R_cam_imu, self._gyro = R_cam_imu, gyro
        self._forces = Timeline()
        self._monitor = InnovationMonitor()
        self._state = np.zeros(5)  # (2,) rad that up is off in the level frame; (3,) bias
        self._P = np.diag([1.0, 1.0, _BIAS**2, _BIAS**2, _BIAS**2])
        self.begin()

    def begin(self) -> None:
        """Take note of a new world."""
        self._window: list[_Followed] = []
        self._R_level_cam: NDArray[np.float64] | None = None  # (3, 3), z up; None: not known
        self._known_ns = 0  # when that was
        self._E_first = np.zeros((2, 3))  # its level rows, as the first window's bias turned
        self._odd = ''  # why the last window was no measurement
        self._up_world: NDArray[np.float64] | None = None  # (3,) when the map began

    def forget(self) -> None:
        """Forget the window: the last pose was not sure, or the map has moved."""
        self._window = []

    @property
    def bias(self) -> NDArray[np.float64]:
        """(3,) m/s^2, in the camera frame."""
        return self._state[2:]

    def sense(self, reading: SpecificForce) -> None:
        """Take a reading; stamps ascend."""
        force = self._R_cam_imu @ reading.force
        if np.isfinite(force).all():
            self._forces.add(reading.stamp_ns, force)

    def reason(self, now_ns: int) -> str | None:
        """Return why gravity cannot be used at a stamp; None: it can."""
        lacks = self._forces.lacks(now_ns, 3 * _HOLD_NS, 'reading') or self._gyro.reason(now_ns)
        looking = f'looking for up{self._odd}' if self._up_world is None else None
        return lacks or self._monitor.reason or looking

    def prior(self, stamp_ns: int) -> UpPrior | None:
        """Return where up is at a stamp; the gyro carries it on from where it was known."""
        if self._up_world is None or self._R_level_cam is None:
            return None
        if self._monitor.reason is not None or self._gyro.reason(stamp_ns) is not None:
            return None
        R, seconds = np.eye(3), (stamp_ns - self._known_ns) * 1e-9
        if stamp_ns != self._known_ns:
            turn = self._gyro.turn(self._known_ns, stamp_ns)
            if turn is None:
                return None
            R = turn.R
        variance = float(np.linalg.eigvalsh(self._P[:2, :2])[-1]) + _TURNING**2 * abs(seconds)
        sigma_rad = math.sqrt(variance + _NOISE**2)
        return UpPrior(self._up_world, (self._R_level_cam @ R)[2], sigma_rad)

    def follow(self, stamp_ns: int, T_world_cam: NDArray[np.float64]) -> None:
        """Take a pose (4, 4) that images are sure of."""
        step = self._step(stamp_ns, T_world_cam) if self._window else None
        if self._R_level_cam is not None:
            turn = self._gyro.turn(self._known_ns, stamp_ns)
            self._R_level_cam = None if turn is None else self._R_level_cam @ turn.R
        self._known_ns = stamp_ns
        if step is None:
            self._window = [_Followed(stamp_ns, T_world_cam, np.eye(3), np.zeros(3))]
            return
        self._window.append(step)
        first = self._window[1] if len(self._window) > 3 else self._window[-2]
        if self._window[-2].stamp_ns - first.stamp_ns >= _WINDOW_S * 1e9:
            self._measure()
            self._window = self._window[-2:]

    def _step(self, stamp_ns: int, T_world_cam: NDArray[np.float64]) -> _Followed | None:
        """Take the forces since the last frame; None where they were not measured."""
        last_ns = self._window[-1].stamp_ns
        turn = self._gyro.turn(last_ns, stamp_ns)
        stamps_ns, forces = self._forces.around(last_ns, stamp_ns)
        if turn is None or not 0 < stamp_ns - last_ns <= _GAP_NS or len(stamps_ns) < 2:
            return None
        if np.diff(stamps_ns).max() > _GAP_NS or stamps_ns[-1] < stamp_ns - _HOLD_NS:
            return None
        return _Followed(stamp_ns, T_world_cam, turn.R, np.mean(forces, axis=0))

    def _measure(self) -> None:
        """Update the filter with what a window shows."""
        mean, R_mean = self._mean_force()
        norm = float(np.linalg.norm(mean))
        self._odd = f': a mean force of {norm:.2f} m/s^2' if abs(norm - _G) > _NORM else ''
        if self._odd:
            return
        if self._R_level_cam is None:
            self._R_level_cam = self._first_level(mean / norm, R_mean)
        self._P += _WINDOW_S * np.diag([_TURNING**2] * 2 + [_BIAS_WALK**2] * 3)
        E = self._R_level_cam[:2]
        H = np.column_stack([np.eye(2), (E @ R_mean - self._E_first) / _G])
        innovation = E @ mean / norm - H @ self._state
        state, P, chi2 = corrected(self._state, self._P, H, innovation, _NOISE**2 * np.eye(2))
        off_deg = math.degrees(float(np.linalg.norm(innovation)))
        if self._monitor.agrees(chi2, f'{off_deg:.1f} degrees off within {_WINDOW_S:.1f} s'):
            self._state, self._P = state, P
            self._turn_level()
        if self._up_world is None and self._monitor.reason is None:
            self._up_world = self._window[-1].T_world_cam[:3, :3] @ self._R_level_cam[2]

    def _first_level(
        self, up: NDArray[np.float64], R_mean: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return R_level_cam (3, 3), z up, whatever the heading is.

        The first one of a map is what up is there, the bias of then included: what counts is
        the change. In a map whose first one was lost, it may be off by that bias.
        """
        again = self._up_world is not None
        R = _level(up)
        self._E_first = np.zeros((2, 3)) if again else R[:2] @ R_mean
        self._state[:2], self._P[:2, :], self._P[:, :2] = 0.0, 0.0, 0.0
        self._P[:2, :2] = (1.0 if again else _NOISE**2) * np.eye(2)
        return R

    def _mean_force(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the mean force (3,) less the accelerations, in the last frame of the window.

        And the mean rotation (3, 3) to that frame, by which a bias is in it.
        """
        window, between = self._window, self._window[2:-1]  # of the velocities
        seconds = (between[-1].stamp_ns - window[1].stamp_ns) * 1e-9
        total, R_total = np.zeros(3), np.zeros((3, 3))
        R_now_then, after_ns = window[-1].R_before_now.T, between[-1].stamp_ns
        for step, before in zip(between[::-1], window[-3:0:-1], strict=True):
            R = R_now_then @ _half(step.R_before_now).T * (after_ns - before.stamp_ns) * 1e-9
            total, R_total = total + R @ step.force, R_total + R
            R_now_then, after_ns = R_now_then @ step.R_before_now.T, before.stamp_ns
        change = _velocity(*window[-3:]) - _velocity(*window[:3])
        R_world_now = window[-1].T_world_cam[:3, :3]
        return (total - R_world_now.T @ change) / seconds, R_total / seconds

    def _turn_level(self) -> None:
        """Put the error of up into the level frame."""
        assert self._R_level_cam is not None
        x, y = self._state[:2]
        turn = se3.exp(np.array([0.0, 0.0, 0.0, -y, x, 0.0]))[:3, :3].T
        self._R_level_cam = turn @ self._R_level_cam
        self._state[:2] = 0.0


def _half(R: NDArray[np.float64]) -> NDArray[np.float64]:
    T = np.eye(4)
    T[:3, :3] = R
    return se3.exp(0.5 * se3.log(T))[:3, :3]


def _velocity(before: _Followed, _: _Followed, after: _Followed) -> NDArray[np.float64]:
    moved = after.T_world_cam[:3, 3] - before.T_world_cam[:3, 3]
    return np.asarray(moved / ((after.stamp_ns - before.stamp_ns) * 1e-9))


def _level(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return R_level_cam (3, 3): two rows that are level, and up."""
    level = np.eye(3)[int(np.argmin(np.abs(up)))]
    first = np.cross(up, level)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first), up])
