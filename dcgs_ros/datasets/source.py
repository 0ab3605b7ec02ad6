# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What every sequence of RGB-D frames looks like, wherever it comes from."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from ..core.camera import PinholeCamera
from ..core.errors import DcgsError
from ..core.frame import RgbdFrame
from ..core.sensor import SensorNoise
from ..core.trajectory import Trajectory


class SourceError(DcgsError):
    """A sequence cannot be opened or read."""


def sequence_name(path: Path | str) -> str:
    """Last part of a path, also where that is `.` or `..`: what a sequence is called."""
    return os.path.basename(os.path.abspath(path))


@dataclass(frozen=True)
class BadFrame:
    """A frame that could not be read; the sequence goes on behind it."""

    name: str
    reason: str


@dataclass(frozen=True)
class ImuSample:
    """What an inertial unit measured, both or one of the two, in its own frame."""

    stamp_ns: int
    frame: str
    acceleration: tuple[float, float, float] | None  # m/s^2
    angular_velocity: tuple[float, float, float] | None  # rad/s


class Source(Protocol):
    """A finite sequence of frames in order of their colour stamps."""

    @property
    def name(self) -> str:
        """What the sequence is called in reports and file names."""
        ...

    @property
    def camera(self) -> PinholeCamera:
        """Of the frames: colour, and the depth registered to it."""
        ...

    @property
    def sensor(self) -> SensorNoise:
        """Noise of the depth."""
        ...

    @property
    def groundtruth(self) -> Trajectory | None:
        """Poses at the colour stamps; the tracker never sees them."""
        ...

    def __len__(self) -> int:
        """Count the frames, bad ones included."""
        ...

    def __iter__(self) -> Iterator[RgbdFrame | BadFrame]:
        """Read the frames anew, from the first."""
        ...

    def imu(self) -> Iterator[ImuSample]:
        """Read the inertial measurements, in order of their stamps; most sequences have none."""
        ...
