# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The camera's rotation by a gyro, whose bias and delay are estimated against the images.

Over an interval the integrated rates give a rotation R_g, the images give R_v, and

    log(R_g^T R_v) = -J b + (w_end - R_g^T w_start) tau + noise

to first order in the errors b of the bias and tau of the clock, with J = integral of R(t)_end^T
dt. A Kalman filter of (b, tau) takes one such innovation every half second in which the images
are sure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se3
from .innovation import InnovationMonitor, corrected
from .readings import UNKNOWN, AngularRate, MotionFactor, Timeline

_HOLD_NS = 25_000_000  # that the last rate stands for, on either side of what was measured
_GAP_NS = 100_000_000  # between two readings: what the camera did meanwhile is not known
_DENSITY = 1e-3  # rad/s per sqrt(Hz), at least: four times the data sheet of a D435i's gyro
_BIAS, _WALK = 0.05, 1e-4  # rad/s, and per sqrt(s): standard deviations
_DELAY_S, _DELAY_WALK_S = 0.01, 1e-4  # of the gyro's clock, and per sqrt(s)
_MOST_DELAY_S = 0.04
_SCALE = 0.01  # error of a turn that is left after calibration, as a share
_IMAGES_RAD = 2e-3  # error of the images' rotation that their covariance may leave out
_FROZEN = 8  # equal readings in a row: noise does not repeat
_SETTLING = 0.02  # share by which a reading changes the density that is estimated


@dataclass(frozen=True)
class Turn:
    """A rotation by the gyro, in the camera frame."""

    R: NDArray[np.float64]  # (3, 3) from the end to the start
    J: NDArray[np.float64]  # (3, 3) by how much an error of the bias turns it at its end, seconds
    steps: NDArray[np.float64]  # (N, 4) seconds and rotation vector of each part
    start_rate: NDArray[np.float64]  # (3,) rad/s, without the bias
    end_rate: NDArray[np.float64]  # (3,)
    end_acceleration: NDArray[np.float64]  # (3,) rad/s^2

    @property
    def seconds(self) -> float:
        """How long it took."""
        return float(self.steps[:, 0].sum())

    def pose(
        self, twist: NDArray[np.float64], T_base_cam: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return T_start_end (4, 4) of a camera that turned so, going on with its `twist` (6,).

        In the hand its velocity in its own frame stays. On wheels, at `T_base_cam` (4, 4), the
        base's does, which rolls forward only: what the camera does beside is the turn's.
        """
        T_body_cam = np.eye(4) if T_base_cam is None else T_base_cam
        velocity = (se3.adjoint(T_body_cam) @ twist)[:3]
        if T_base_cam is not None:
            velocity[1:] = 0.0
        T = np.eye(4)
        for seconds, *phi in self.steps:
            T = T @ se3.exp(np.array([*(seconds * velocity), *(T_body_cam[:3, :3] @ phi)]))
        return np.asarray(se3.inverse(T_body_cam) @ T @ T_body_cam)


class Gyro:
    """Integrates rates, and watches them."""

    def __init__(self, R_cam_imu: NDArray[np.float64]) -> None:
        """Take the rotation (3, 3) from the IMU's frame to the camera's."""
        self._R_cam_imu = R_cam_imu
        self._rates = Timeline()
        self._monitor = InnovationMonitor()
        self._last: list[NDArray[np.float64]] = []  # three, in the camera frame
        self._equal = 0
        self._variance = 0.0  # of a reading's noise, (rad/s)^2, as the readings show it
        self._interval_s = 0.005  # between readings
        self._begin_filter()

    def _begin_filter(self) -> None:
        self._state = np.zeros(4)  # bias, rad/s, camera frame; delay of the stamps, s
        self._P = np.diag([_BIAS**2] * 3 + [_DELAY_S**2])

    @property
    def bias(self) -> NDArray[np.float64]:
        """(3,) rad/s, in the camera frame."""
        return self._state[:3]

    @property
    def delay_s(self) -> float:
        """How much later than the images' the stamps of the same instant are."""
        return float(self._state[3])

    def reason(self, now_ns: int) -> str | None:
        """Return why the gyro cannot be used at a stamp; None: it can."""
        hold_ns = _HOLD_NS + round(_MOST_DELAY_S * 1e9)
        lacks = self._rates.lacks(now_ns, hold_ns, 'reading')
        if lacks is not None:
            return lacks
        if self._equal >= _FROZEN:
            return f'frozen: {self._equal} equal readings'
        return self._monitor.reason

    def sense(self, reading: AngularRate) -> None:
        """Take a reading; stamps ascend."""
        rate = self._R_cam_imu @ reading.rate
        if not np.isfinite(rate).all():
            return
        before_ns = self._rates.last_ns
        self._rates.add(reading.stamp_ns, rate)
        if before_ns is not None and 0 < reading.stamp_ns - before_ns < _GAP_NS:
            self._interval_s += _SETTLING * (
                (reading.stamp_ns - before_ns) * 1e-9 - self._interval_s
            )
        repeats = bool(self._last) and np.array_equal(rate, self._last[-1]) and rate.any()
        self._equal = self._equal + 1 if repeats else 0
        self._last = [*self._last[-2:], rate]
        if len(self._last) == 3:  # white noise has six times its variance in second differences
            a, b, c = self._last
            noise = float(np.square(a - 2.0 * b + c).mean()) / 6.0
            self._variance += _SETTLING * (noise - self._variance)

    def turn(self, start_ns: int, end_ns: int) -> Turn | None:
        """Return the rotation between two instants of the images' clock; None: not measured."""
        delay_ns = round(self.delay_s * 1e9)
        start_ns, end_ns = start_ns + delay_ns, end_ns + delay_ns
        stamps_ns, rates = self._rates.around(start_ns, end_ns)
        if len(stamps_ns) < 2 or np.diff(stamps_ns).max() > _GAP_NS:
            return None
        if stamps_ns[0] > start_ns + _HOLD_NS or stamps_ns[-1] < end_ns - _HOLD_NS:
            return None
        inner = stamps_ns[(stamps_ns > start_ns) & (stamps_ns < end_ns)]
        times_s = (np.array([start_ns, *inner, end_ns]) - start_ns) * 1e-9
        known_s = (stamps_ns - start_ns) * 1e-9
        values = np.array(rates)
        at = np.column_stack([np.interp(times_s, known_s, values[:, k]) for k in range(3)])
        at -= self.bias
        slope = (values[-1] - values[max(len(values) - 4, 0)]) / max(
            known_s[-1] - known_s[max(len(values) - 4, 0)], 1e-9
        )
        return _integrated(times_s, at, slope)

    def factor(self, turn: Turn) -> MotionFactor:
        """Return what a turn says of the camera's motion."""
        T, noise, drift = np.eye(4), np.diag([UNKNOWN] * 3 + [1.0] * 3), np.zeros((6, 6))
        T[:3, :3] = turn.R
        noise[3:, 3:] *= self.density**2 * turn.seconds
        phi = turn.steps[:, 1:].sum(axis=0)
        drift[3:, 3:] = turn.J @ self._P[:3, :3] @ turn.J.T + _SCALE**2 * np.outer(phi, phi)
        by_delay = turn.end_rate - turn.R.T @ turn.start_rate
        drift[3:, 3:] += self._P[3, 3] * np.outer(by_delay, by_delay)
        return MotionFactor(T, noise, drift)

    @property
    def density(self) -> float:
        """Noise density in rad/s per sqrt(Hz), as the readings show it, or the floor."""
        return max(_DENSITY, math.sqrt(self._variance * self._interval_s))

    def learn(
        self, start_ns: int, end_ns: int, R: NDArray[np.float64], covariance: NDArray[np.float64]
    ) -> None:
        """Compare with the rotation R (3, 3) that the images tell, covariance (3, 3)."""
        turn = self.turn(start_ns, end_ns)
        if turn is None:
            return
        self._P += turn.seconds * np.diag([_WALK**2] * 3 + [_DELAY_WALK_S**2])
        innovation = _rotation_vector(turn.R.T @ R)
        by_delay = turn.end_rate - turn.R.T @ turn.start_rate
        H = np.column_stack([-turn.J, by_delay])
        noise = covariance + self.density**2 * turn.seconds * np.eye(3)
        angle = float(np.linalg.norm(turn.steps[:, 1:].sum(axis=0)))
        noise = noise + (_IMAGES_RAD**2 + (_SCALE * angle) ** 2) * np.eye(3)
        state, P, chi2 = corrected(self._state, self._P, H, innovation, noise)
        off_deg = math.degrees(float(np.linalg.norm(innovation)))
        what = f'{off_deg:.1f} degrees off after {turn.seconds:.1f} s'
        if not self._monitor.agrees(chi2, what):
            if self._monitor.reason is not None:
                self._begin_filter()
            return
        self._state, self._P = state, P
        self._state[3] = min(max(self._state[3], -_MOST_DELAY_S), _MOST_DELAY_S)


def _integrated(
    times_s: NDArray[np.float64], rates: NDArray[np.float64], slope: NDArray[np.float64]
) -> Turn:
    """Integrate rates (N, 3) at times (N,), linear between them; `slope` (3,) at their end."""
    dt = np.diff(times_s)
    steps = np.column_stack([dt, 0.5 * (rates[1:] + rates[:-1]) * dt[:, None]])
    R, J = np.eye(3), np.zeros((3, 3))
    for seconds, *phi in steps:
        step = se3.exp(np.array([0.0, 0.0, 0.0, *phi]))[:3, :3]
        R = R @ step
        J = step.T @ J + seconds * np.eye(3)
    return Turn(R, J, steps, rates[0], rates[-1], slope)


def _rotation_vector(R: NDArray[np.float64]) -> NDArray[np.float64]:
    T = np.eye(4)
    T[:3, :3] = R
    return se3.log(T)[3:]
