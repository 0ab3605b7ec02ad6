# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Exposure of the simulated colour camera: how long, and how much amplified."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

_UNIT_S = 0.010  # exposure that collects the scene's radiance as it is


class Exposure(Protocol):
    """Chooses exposure time and gain from one image to the next."""

    most_taps: int  # samples of the image along a pixel's motion

    @property
    def time_s(self) -> float:
        """For how long a row collects light."""
        ...

    @property
    def gain(self) -> float:
        """By how much the collected light and its noise are amplified."""
        ...

    @property
    def light(self) -> float:
        """The light that is collected, per unit of radiance."""
        ...

    def react(self, radiance: NDArray[np.float32]) -> None:
        """Choose the next image's exposure from this radiance (H, W, 3), grey levels."""
        ...


class FixedExposure:
    """A constant gain of one."""

    time_s = _UNIT_S
    gain = 1.0
    light = 1.0
    most_taps = 9

    def react(self, radiance: NDArray[np.float32]) -> None:
        """Ignore the image."""


class AutoExposure:
    """A gain that follows the mean brightness with a lag, at a constant exposure time."""

    time_s = _UNIT_S
    light = 1.0
    most_taps = 9
    target = 112.0  # grey levels
    response = 0.07  # share of the error corrected from one frame to the next, in log gain

    def __init__(self) -> None:
        """Start at unit gain."""
        self.gain = 1.0

    def react(self, radiance: NDArray[np.float32]) -> None:
        """Choose the gain of the next image from this one (H, W, 3)."""
        mean = max(_mean(radiance), 1.0)
        self.gain *= (self.target / (mean * self.gain)) ** self.response
        self.gain = min(max(self.gain, 0.4), 3.0)


class MeteredExposure:
    """As cameras meter indoors: in dim light first longer, then amplified.

    Exposure time and gain together follow the mean brightness with a lag. A row cannot collect
    light for longer than a frame lasts; what is missing then comes from the gain, which amplifies
    noise as well, up to where the image stays dark.
    """

    most_taps = 41  # of a blur of 60 pixels
    target = 112.0  # grey levels
    response = 0.12  # share of the error corrected from one frame to the next, in log exposure
    shortest_s, longest_s = 0.001, 0.033
    most_gain = 8.0

    def __init__(self, radiance: NDArray[np.float32]) -> None:
        """Start as settled on a radiance (H, W, 3), grey levels."""
        self._level = self._wanted(radiance)

    def react(self, radiance: NDArray[np.float32]) -> None:
        """Approach what this image (H, W, 3) wants."""
        self._level *= (self._wanted(radiance) / self._level) ** self.response

    def _wanted(self, radiance: NDArray[np.float32]) -> float:
        """Return the light times gain that brings the mean to its target."""
        most = self.most_gain * self.longest_s / _UNIT_S
        return min(self.target / max(_mean(radiance), 0.01), most)

    @property
    def time_s(self) -> float:
        """For how long a row collects light: 33 ms at most."""
        return min(max(self._level * _UNIT_S, self.shortest_s), self.longest_s)

    @property
    def light(self) -> float:
        """The light that is collected, per unit of radiance."""
        return self.time_s / _UNIT_S

    @property
    def gain(self) -> float:
        """What exposure time leaves to amplification."""
        return self._level / self.light


def _mean(radiance: NDArray[np.float32]) -> float:
    return float(radiance[::8, ::8].mean(dtype=np.float64))
