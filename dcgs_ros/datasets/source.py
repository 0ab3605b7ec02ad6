# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What every sequence of RGB-D frames looks like, wherever it comes from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from ..core.camera import PinholeCamera
from ..core.errors import DcgsError
from ..core.frame import RgbdFrame
from ..core.sensor import SensorNoise
from ..core.trajectory import Trajectory


class SourceError(DcgsError):
    """A sequence cannot be opened or read."""


@dataclass(frozen=True)
class BadFrame:
    """A frame that could not be read; the sequence goes on behind it."""

    name: str
    reason: str


class Source(Protocol):
    """A finite sequence of frames in order of their colour stamps."""

    name: str
    camera: PinholeCamera
    sensor: SensorNoise

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
