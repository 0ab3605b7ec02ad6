# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What other sensors of a robot measure, and what follows for the camera's motion."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..covariances import common_axes

UNKNOWN = 1e6  # m^2, rad^2: variance in directions of which a sensor says nothing
_KEPT_NS = 10_000_000_000  # of the past: more than any window or bridged gap
_FORGET = 256  # readings that may be too old before they are dropped


@dataclass(frozen=True)
class AngularRate:
    """One measurement of a gyro."""

    stamp_ns: int
    rate: NDArray[np.float64]  # (3,) rad/s, in the IMU's frame


@dataclass(frozen=True)
class SpecificForce:
    """One measurement of an accelerometer."""

    stamp_ns: int
    force: NDArray[np.float64]  # (3,) m/s^2, in the IMU's frame: at rest it points up


@dataclass(frozen=True)
class BasePose:
    """One pose of the base by its wheels, in a frame that drifts but does not step."""

    stamp_ns: int
    T_odom_base: NDArray[np.float64]  # (4, 4); base: x forward, y left, z up
    # (3,) of a velocity as it is published: forward and left, (m/s)^2, turn, (rad/s)^2.
    variance: NDArray[np.float64] | None = None


Reading = AngularRate | SpecificForce | BasePose


@dataclass(frozen=True)
class MotionFactor:
    """What one sensor says of the camera's motion between two instants.

    Both covariances are of xi in T_before_now exp(xi). Noise is independent from interval to
    interval, and `UNKNOWN` in the directions of which the sensor says nothing; drift is what
    intervals share: errors of bias and scale, and slip.
    """

    T_before_now: NDArray[np.float64]  # (4, 4)
    noise: NDArray[np.float64]  # (6, 6)
    drift: NDArray[np.float64]  # (6, 6)

    @property
    def information(self) -> NDArray[np.float64]:
        """(6, 6) of both."""
        return np.asarray(np.linalg.inv(self.noise + self.drift))

    def added_to(self, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the covariance (6, 6) of a pose after the motion, its own before being given.

        Drift goes on as it was, so that along each of their common principal axes its standard
        deviation adds up with the pose's, not its variance.
        """
        half, ratios = common_axes(self.drift, covariance)
        sums = np.square(1.0 + np.sqrt(np.maximum(ratios, 0.0)))
        return np.asarray((half * sums) @ half.T + self.noise)


class Timeline:
    """Readings in order of their stamps, of the last seconds."""

    def __init__(self) -> None:
        """Begin without any."""
        self._stamps_ns: list[int] = []
        self._values: list[NDArray[np.float64]] = []

    def add(self, stamp_ns: int, value: NDArray[np.float64]) -> None:
        """Add a reading; one that is not newer than the last is of another clock, or a repetition.

        Of another clock, a second back or more, nothing of before holds.
        """
        if self._stamps_ns and stamp_ns <= self._stamps_ns[-1]:
            if stamp_ns > self._stamps_ns[-1] - 1_000_000_000:
                return
            self._stamps_ns, self._values = [], []
        self._stamps_ns.append(stamp_ns)
        self._values.append(value)
        old = bisect_left(self._stamps_ns, stamp_ns - _KEPT_NS)
        if old > _FORGET:
            del self._stamps_ns[:old], self._values[:old]

    @property
    def last_ns(self) -> int | None:
        """Stamp of the last reading."""
        return self._stamps_ns[-1] if self._stamps_ns else None

    def lacks(self, now_ns: int, hold_ns: int, what: str) -> str | None:
        """Return why there is no reading of a stamp, in words with `what` a reading is, or None.

        The last one stands for `hold_ns` after it.
        """
        if not self._stamps_ns:
            return f'no {what} yet'
        late_s, early_s = (now_ns - self._stamps_ns[-1]) * 1e-9, self._stamps_ns[0] - now_ns
        if late_s * 1e9 > hold_ns:
            return f'no {what} for {late_s:.2f} s'
        if early_s > hold_ns:
            return f'no {what} before {early_s * 1e-9:.2f} s after the images: of another clock'
        return None

    def around(
        self, start_ns: int, end_ns: int
    ) -> tuple[NDArray[np.int64], list[NDArray[np.float64]]]:
        """Return stamps and values from the last before `start_ns` to the first after `end_ns`.

        Where there is none before or after, they begin later or end earlier.
        """
        first = max(bisect_left(self._stamps_ns, start_ns + 1) - 1, 0)
        last = bisect_left(self._stamps_ns, end_ns) + 1
        return np.array(self._stamps_ns[first:last], np.int64), self._values[first:last]
