# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The camera's motion by the wheels under it, whose scales are estimated against the images.

Wheels measure how the base moves over the floor: forward, sideways, turned. What is left, z, roll
and pitch, changes by no more than an uneven floor makes of it. Distances and turns are wrong by a
share that slip, tyres and the distance between the wheels make, and that changes slowly: a Kalman
filter follows both where the images are sure. A sudden slip is an innovation that contradicts.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .. import se3
from .innovation import InnovationMonitor, corrected
from .readings import BasePose, MotionFactor, Timeline

_HOLD_NS = 60_000_000  # that the last pose may be old: three intervals at 50 Hz
_GAP_NS = 500_000_000  # between two poses: slip and turns in it are not known
_SCALES = np.array([0.05, 0.1])  # of distances and of turns, before they are estimated
_SCALE_WALK = 0.002  # per sqrt(m) or sqrt(rad): standard deviation
_SLIP = np.array([0.02, 0.02, 0.03])  # forward and sideways a metre, turn a radian; unforeseen
_BEND = 2e-3  # rad a metre: wheels that differ by one in a thousand
_SIDEWAYS_PER_RAD = 0.005  # metres: a base that turns about a point that is not quite its origin
_FLOOR = np.array([1e-4, 1e-4, 1e-4])  # m, m, rad: play, vibration, resolution of the encoders
# z, roll and pitch of a base (m, rad, rad): steps of tiles, thresholds, the foot of a ramp of 5
# degrees within half a metre; and vibration, however short the way.
_UNEVEN = np.array([0.01, 0.03, 0.03])  # per sqrt(m)
_SHAKE = np.array([1e-3, 2e-3, 2e-3])
_IMAGES = np.array([2e-3, 2e-3, 3e-3])  # m, m, rad: error that their covariance may leave out
_PLANE, _REST = [0, 1, 5], [2, 3, 4]  # x, y and yaw of a twist; z, roll and pitch


class Wheels:
    """Relative poses of the base, and how far to trust them."""

    def __init__(self, T_base_cam: NDArray[np.float64]) -> None:
        """Take the transform (4, 4) from the camera to the base."""
        self._T_base_cam, self._T_cam_base = T_base_cam, se3.inverse(T_base_cam)
        self._Ad = se3.adjoint(T_base_cam)
        self._Ad_cam_base = se3.adjoint(self._T_cam_base)
        self._poses = Timeline()
        self._monitor = InnovationMonitor()
        self._published = np.zeros(3)  # variance (3,) a second that the publisher claims
        self._begin_filter()

    def _begin_filter(self) -> None:
        self.scales = np.zeros(2)  # by what share distances and turns are measured too large
        self._P = np.diag(_SCALES**2)

    def reason(self, now_ns: int) -> str | None:
        """Return why the wheels cannot be used at a stamp; None: they can."""
        return self._poses.lacks(now_ns, _HOLD_NS, 'pose') or self._monitor.reason

    def sense(self, reading: BasePose) -> None:
        """Take a pose; stamps ascend."""
        if not np.isfinite(reading.T_odom_base).all():
            return
        before_ns = self._poses.last_ns
        self._poses.add(reading.stamp_ns, reading.T_odom_base)
        if reading.variance is not None and before_ns is not None:
            interval_ns = reading.stamp_ns - before_ns
            if 0 < interval_ns < _GAP_NS:
                self._published = reading.variance * interval_ns * 1e-9

    def pose(self, stamp_ns: int) -> NDArray[np.float64] | None:
        """Return T_odom_base (4, 4), interpolated along the twist; None: not measured."""
        stamps_ns, poses = self._poses.around(stamp_ns, stamp_ns + 1)
        if len(stamps_ns) == 0 or stamp_ns < stamps_ns[0]:
            return None
        if len(stamps_ns) == 1:
            return self._extrapolated(stamp_ns) if stamp_ns - stamps_ns[0] <= _HOLD_NS else None
        before_ns, after_ns = int(stamps_ns[0]), int(stamps_ns[1])
        if after_ns - before_ns > _GAP_NS:
            return None
        share = (stamp_ns - before_ns) / (after_ns - before_ns)
        twist = se3.log(se3.inverse(poses[0]) @ poses[1])
        return np.asarray(poses[0] @ se3.exp(share * twist))

    def _extrapolated(self, stamp_ns: int) -> NDArray[np.float64]:
        """Return the pose (4, 4) after the last reading, at the speed between the last two."""
        assert self._poses.last_ns is not None
        stamps_ns, poses = self._poses.around(self._poses.last_ns - 1, self._poses.last_ns)
        if len(stamps_ns) < 2 or stamps_ns[1] - stamps_ns[0] > _GAP_NS:
            return np.asarray(poses[-1])
        share = (stamp_ns - stamps_ns[1]) / (stamps_ns[1] - stamps_ns[0])
        twist = se3.log(se3.inverse(poses[0]) @ poses[1])
        return np.asarray(poses[1] @ se3.exp(share * twist))

    def _moved(self, start_ns: int, end_ns: int) -> NDArray[np.float64] | None:
        """Return the twist (6,) of the base between two instants, as measured."""
        start, end = self.pose(start_ns), self.pose(end_ns)
        if start is None or end is None:
            return None
        return se3.log(se3.inverse(start) @ end)

    def _corrected(self, twist: NDArray[np.float64]) -> NDArray[np.float64]:
        along, turn = 1.0 / (1.0 + self.scales)
        return twist * np.array([along, along, along, turn, turn, turn])

    def factor(self, start_ns: int, end_ns: int) -> MotionFactor | None:
        """Return what the wheels say of the camera's motion between two instants."""
        measured = self._moved(start_ns, end_ns)
        if measured is None:
            return None
        twist = self._corrected(measured)
        scales = np.sqrt(np.diag(self._P))[[0, 0, 1]]
        noise, drift = np.zeros(6), np.zeros(6)  # variances, in the base's frame
        noise[_PLANE] = np.maximum(_FLOOR**2, self._published * (end_ns - start_ns) * 1e-9)
        noise[_REST] = _SHAKE**2 + math.hypot(*twist[:2]) * _UNEVEN**2
        drift[_PLANE] = (self._slip(twist) + np.abs(twist[_PLANE]) * scales) ** 2
        T, Ad = self._T_cam_base @ se3.exp(twist) @ self._T_base_cam, self._Ad_cam_base
        return MotionFactor(T, (Ad * noise) @ Ad.T, (Ad * drift) @ Ad.T)

    def _slip(self, twist: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what may be lost unforeseen (3,) of a motion (6,): forward, sideways, turn."""
        x, y, turn = np.abs(twist[_PLANE])
        way = math.hypot(x, y)
        return _SLIP * (way, way, turn) + (0.0, _SIDEWAYS_PER_RAD * turn, _BEND * way)

    def learn(
        self, start_ns: int, end_ns: int, T: NDArray[np.float64], covariance: NDArray[np.float64]
    ) -> None:
        """Compare with the motion T (4, 4) of the camera that the images tell, and its covariance.

        That (6, 6) is of xi in T exp(xi), in the camera frame.
        """
        measured = self._moved(start_ns, end_ns)
        if measured is None:
            return
        seen = se3.log(self._T_base_cam @ T @ self._T_cam_base)
        twist = self._corrected(measured)
        innovation = (seen - twist)[_PLANE]
        way, turn = math.hypot(*twist[:2]), abs(twist[5])
        self._P += _SCALE_WALK**2 * np.diag([way, turn])
        H = np.zeros((3, 2))
        H[:2, 0], H[2, 1] = -twist[:2], -twist[5]
        by_images = (self._Ad @ covariance @ self._Ad.T)[np.ix_(_PLANE, _PLANE)]
        noise = by_images + np.diag((_IMAGES + _FLOOR + self._slip(twist)) ** 2)
        scales, P, chi2 = corrected(self.scales, self._P, H, innovation, noise)
        what = (
            f'{100 * math.hypot(*innovation[:2]):.1f} cm and '
            f'{math.degrees(abs(innovation[2])):.1f} degrees off within {way:.2f} m'
        )
        if not self._monitor.agrees(chi2, what):
            if self._monitor.reason is not None:
                self._begin_filter()
            return
        self.scales, self._P = scales, P
