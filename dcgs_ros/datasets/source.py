# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The interface of every sequence of RGB-D frames."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..core.camera import PinholeCamera
from ..core.errors import DcgsError
from ..core.frame import RgbdFrame
from ..core.sensor import SensorNoise
from ..core.trajectory import Trajectory


class SourceError(DcgsError):
    """A sequence cannot be opened or read."""


def sequence_name(path: Path | str) -> str:
    """Return the last part of a path, resolved if it is `.` or `..`, as a sequence's name."""
    return os.path.basename(os.path.abspath(path))


@dataclass(frozen=True)
class BadFrame:
    """A frame that could not be read; the frames after it follow."""

    name: str
    reason: str


@dataclass(frozen=True)
class ImuSample:
    """One measurement of an IMU, of one or both quantities, in the IMU's frame."""

    stamp_ns: int
    frame: str
    acceleration: tuple[float, float, float] | None  # m/s^2
    angular_velocity: tuple[float, float, float] | None  # rad/s


@dataclass(frozen=True)
class OdometrySample:
    """What the wheels say: where the base has come, and how it moves."""

    stamp_ns: int
    frame: str  # of the pose: that of the base somewhere, as where the wheels began
    base_frame: str  # x forward, y left, z up, on the ground
    pose: tuple[float, float, float]  # x, y, metres, and heading, radians
    velocity: tuple[float, float, float]  # of the base: forward, left, m/s, turning left, rad/s


class Source(Protocol):
    """A finite sequence of frames in order of their colour stamps."""

    @property
    def name(self) -> str:
        """The sequence's name in reports and file names."""
        ...

    @property
    def camera(self) -> PinholeCamera:
        """Camera of the frames: of colour, and of depth registered to it."""
        ...

    @property
    def sensor(self) -> SensorNoise:
        """Noise of the depth."""
        ...

    @property
    def depth_per_metre(self) -> float | None:
        """Value of a stored depth pixel at one metre; None: depth is made in metres."""
        ...

    @property
    def groundtruth(self) -> Trajectory | None:
        """Poses at the colour stamps; the tracker never sees them."""
        ...

    @property
    def notes(self) -> Sequence[str]:
        """What was repaired, left out or decided at opening, a line each."""
        ...

    def __len__(self) -> int:
        """Return the number of frames, bad ones included."""
        ...

    def __iter__(self) -> Iterator[RgbdFrame | BadFrame]:
        """Read the frames from the first; each call starts again."""
        ...

    def imu(self) -> Iterator[ImuSample]:
        """Read the IMU's measurements in order of their stamps; nothing where there is no IMU."""
        ...


@runtime_checkable
class RobotSource(Source, Protocol):
    """A sequence of a robot: it may tell where its sensors are, and what its wheels measured."""

    @property
    def T_cam_imu(self) -> NDArray[np.float64] | None:
        """(4, 4) IMU to colour camera; None: not known."""
        ...

    @property
    def imu_frames(self) -> Sequence[str]:
        """Frames of the samples of that IMU; others may be of other IMUs."""
        ...

    @property
    def T_base_cam(self) -> NDArray[np.float64] | None:
        """(4, 4) colour camera to base; None: not known, or it is not fixed to one."""
        ...

    @property
    def base_frame(self) -> str:
        """Frame of the base; empty where there is none."""
        ...

    def odometry(self) -> Iterator[OdometrySample]:
        """Read what the wheels say in order of its stamps."""
        ...
