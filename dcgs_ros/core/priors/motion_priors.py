# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The sensors that a robot has beside its camera, together: read, believed, learned about."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..config.stages import PriorsConfig
from ..errors import DcgsError
from ..tracking.motion import ConstantVelocity
from .fusion import ImagePose, Sensed, Way, is_likely
from .gravity import Gravity
from .gyro import Gyro
from .planar import FloorPrior, on_floor
from .readings import AngularRate, Reading, SpecificForce
from .wheels import Wheels

_WINDOW_NS = 500_000_000  # over which images and sensors are compared: long against their noise
_LONGEST_NS = 1_500_000_000  # with frames missing in between
_NO_IMU = 'it is not known how the IMU is turned to the camera'
_NO_BASE = 'it is not known where on the base the camera is'

# Share of the variance of a pose's error that is another one after the window: 0.02 to 0.05 of
# what is claimed of the pose in the map, in a corridor.
_RENEWED = 0.03
_HELD = np.diag(np.repeat([1e-2**2, 1e-2**2], 3))  # m, rad: of a pose that images alone hold


class PriorsError(DcgsError):
    """A sensor is asked for whose place is not known."""


class MotionPriors:
    """Gyro, wheels and floor, each if its extrinsics are given and the configuration wants it."""

    def __init__(
        self,
        config: PriorsConfig,
        R_cam_imu: NDArray[np.float64] | None = None,
        T_base_cam: NDArray[np.float64] | None = None,
    ) -> None:
        """Take the rotation (3, 3) of the IMU and the place (4, 4) of the camera on the base.

        What is not known yet may come later, by `mount`.
        """
        self._config = config
        self._T_base_cam: NDArray[np.float64] | None = None
        self.gyro: Gyro | None = None
        self.gravity: Gravity | None = None
        self.wheels: Wheels | None = None
        self._floor: FloorPrior | None = None
        self._T_world_first: NDArray[np.float64] | None = None  # where the camera's map began
        self._known: tuple[int, ImagePose] | None = None  # stamp, and where the images are sure
        self._covariance = _HELD  # (6, 6) of the last pose, as images and sensors hold it
        self.mount(R_cam_imu, T_base_cam)

    def mount(
        self,
        R_cam_imu: NDArray[np.float64] | None = None,
        T_base_cam: NDArray[np.float64] | None = None,
    ) -> None:
        """Take where a sensor is, once that is known; what is sensed from then on is used."""
        config = self._config
        if config.needs_gyro and R_cam_imu is not None:
            self.gyro = Gyro(R_cam_imu)
        if config.gravity and R_cam_imu is not None and self.gyro is not None:
            self.gravity = Gravity(R_cam_imu, self.gyro)
        if T_base_cam is not None:
            self._T_base_cam = T_base_cam
            self.wheels = Wheels(T_base_cam) if config.wheels else None
            if self._T_world_first is not None:
                self._lay_floor(self._T_world_first)

    @property
    def unmounted(self) -> dict[str, str]:
        """Of the sensors that the configuration asks for, those whose place is not known."""
        config, no_base = self._config, self._T_base_cam is None
        asked = {
            'gyro': (config.needs_gyro and self.gyro is None, _NO_IMU),
            'gravity': (config.gravity and self.gravity is None, _NO_IMU),
            'wheels': (config.wheels and no_base, _NO_BASE),
            'planar': (config.planar_m is not None and no_base, _NO_BASE),
        }
        return {name: why for name, (lacks, why) in asked.items() if lacks}

    @property
    def on_wheels(self) -> bool:
        """Whether wheels carry the camera: it cannot dart aside as in a hand."""
        return self._T_base_cam is not None

    def sense(self, reading: Reading) -> None:
        """Take a reading, in order of the stamps of its kind."""
        if isinstance(reading, AngularRate):
            if self.gyro is not None:
                self.gyro.sense(reading)
        elif isinstance(reading, SpecificForce):
            if self.gravity is not None:
                self.gravity.sense(reading)
        elif self.wheels is not None:
            self.wheels.sense(reading)

    def begin(self, T_world_cam: NDArray[np.float64]) -> None:
        """Take the floor from where the camera is when its map begins."""
        self._known, self._T_world_first = None, T_world_cam
        if self.gravity is not None:
            self.gravity.begin()
        self._lay_floor(T_world_cam)

    def _lay_floor(self, T_world_cam: NDArray[np.float64]) -> None:
        planar_m, T_base_cam = self._config.planar_m, self._T_base_cam
        if planar_m is not None and T_base_cam is not None:
            self._floor = on_floor(T_world_cam, T_base_cam, planar_m, self._config.planar_deg)

    def since(self, motion: ConstantVelocity, end_ns: int) -> Sensed | None:
        """Return what the sensors that can be used say of the time since the last pose, if any."""
        start_ns, gyro, wheels = motion.stamp_ns, self.gyro, self.wheels
        turn = way = turned = None
        if gyro is not None and gyro.reason(end_ns) is None:
            turn = gyro.turn(start_ns, end_ns)
            turned = None if turn is None else gyro.factor(turn)
        if wheels is not None and wheels.reason(end_ns) is None:
            way = wheels.factor(start_ns, end_ns)
        up = None if self.gravity is None else self.gravity.prior(end_ns)
        if turned is None and way is None and self._floor is None and up is None:
            return None
        T, hand = motion.T_world_cam, motion.prior(end_ns)
        turned, way = (
            f if f is not None and is_likely(f, T, hand) else None for f in (turned, way)
        )
        factors = tuple(factor for factor in (turned, way) if factor is not None)
        if not factors and self._floor is None and up is None:
            return None
        turn = None if turned is None else turn
        moved = None if way is None else Way.of(factors, self._covariance)
        self._covariance = _HELD if moved is None else moved.covariance
        return Sensed(factors, turn, self._floor, self._T_base_cam, moved, up)

    def with_images(
        self, sensed: Sensed, images: ImagePose, T_last: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the pose (4, 4) by images and sensors; the last one is `T_last` (4, 4)."""
        if sensed.way is None:
            return images.T_world_cam
        T, self._covariance = sensed.with_images(images, T_last)
        return T

    def learn(self, stamp_ns: int, images: ImagePose, T_world_cam: NDArray[np.float64]) -> None:
        """Compare with a pose that the images are sure of; with sensors it became (4, 4)."""
        if self.gravity is not None:
            self.gravity.follow(stamp_ns, T_world_cam)
        start_ns, start = self._known or (stamp_ns, images)
        if not 0 < stamp_ns - start_ns <= _LONGEST_NS:
            self._known = stamp_ns, images
        elif stamp_ns - start_ns >= _WINDOW_NS:
            self._known = stamp_ns, images
            T = se3.inverse(start.T_world_cam) @ images.T_world_cam
            Ad = se3.adjoint(se3.inverse(T))
            if self.gyro is not None:  # no images drag a turn as they do a way
                both = images.covariance + Ad @ start.covariance @ Ad.T
                self.gyro.learn(start_ns, stamp_ns, T[:3, :3], _RENEWED * both[3:, 3:])
            if self.wheels is not None:
                both = images.believed + Ad @ start.believed @ Ad.T
                self.wheels.learn(start_ns, stamp_ns, T, _RENEWED * both)

    def forget(self) -> None:
        """Forget the window: the images are not sure, or the map has moved."""
        self._known = None
        if self.gravity is not None:
            self.gravity.forget()

    def reasons(self, now_ns: int) -> dict[str, str]:
        """Return for each prior 'used', or why it is not, in words."""
        sensors = {'gyro': self.gyro, 'gravity': self.gravity, 'wheels': self.wheels}
        said = {
            name: sensor.reason(now_ns) or 'used'
            for name, sensor in sensors.items()
            if sensor is not None
        }
        floor = {'planar': 'used'} if self._floor is not None else {}
        return said | floor | self.unmounted
