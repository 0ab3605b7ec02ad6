# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Whether depth lies where its sensor measures, or was read in a wrong unit."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..core.frame import RgbdFrame
from ..core.sensor import SensorNoise
from .trajectory import AteResult

_FRAMES = 60  # surveyed, from the first
_STRIDE = 8  # pixels
_HARDLY_ANY = 0.25  # of the depth, in the sensor's range
_TOO_NEAR = 0.2  # of the depth, nearer than the sensor measures
_BETTER = 0.2  # by which another unit must put more depth into the range to be named
# Millimetres, TUM's, an L515's, a D405's, Replica's; metres.
_UNITS = (1000.0, 5000.0, 4000.0, 10000.0, 6553.5, 1.0)
_WRONG_SCALE = 1.2  # of the motion: no sensor is biased by so much
_FITTING = 0.5  # of the error is left by the right scale


@dataclass
class DepthSurvey:
    """Depth of the first frames, sampled: how much of it is in the sensor's range."""

    samples: list[NDArray[np.float32]] = field(default_factory=list)  # (N,) metres, each

    def add(self, frame: RgbdFrame) -> None:
        """Sample a frame, one of the first 60."""
        if len(self.samples) < _FRAMES:
            depth_m = frame.depth_m[::_STRIDE, ::_STRIDE]
            self.samples.append(depth_m[depth_m > 0])

    def share(self, sensor: SensorNoise, factor: float = 1.0) -> float | None:
        """Return the share of the depth, times `factor`, in the sensor's range; None of none."""
        depth_m = self._depth_m * factor
        if not len(depth_m):
            return None
        within = (depth_m >= sensor.depth_min_m) & (depth_m <= sensor.depth_max_m)
        return float(within.mean())

    def summary(self, sensor: SensorNoise, per_metre: float | None) -> str | None:
        """Return where the depth lies, as read in the unit `per_metre`; None without any."""
        share, depth_m = self.share(sensor), self._depth_m
        if share is None:
            return None
        unit = '' if per_metre is None else f' at {per_metre:g} per metre'
        return (
            f"{share:.0%} of the depth lies in the sensor's range of {sensor.depth_min_m:g} to "
            f'{sensor.depth_max_m:g} m, {self._near(sensor):.0%} is nearer; the median is '
            f'{np.median(depth_m):.3g} m{unit}'
        )

    def warning(self, sensor: SensorNoise, per_metre: float | None) -> str | None:
        """Return what speaks against the unit `per_metre` of the depth, with a remedy, or None."""
        share, summary = self.share(sensor), self.summary(sensor, per_metre)
        if share is None or summary is None or per_metre is None:
            return None
        if share >= _HARDLY_ANY and self._near(sensor) <= _TOO_NEAR:
            return None
        return summary + self._remedy(sensor, per_metre, share)

    def _near(self, sensor: SensorNoise) -> float:
        return float((self._depth_m < sensor.depth_min_m).mean())

    def _remedy(self, sensor: SensorNoise, per_metre: float, share: float) -> str:
        shares = {unit: self.share(sensor, per_metre / unit) or 0.0 for unit in _UNITS}
        best = max(shares, key=lambda unit: shares[unit])
        if shares[best] < share + _BETTER:
            return ''
        return f'. With --depth-per-metre {best:g} it would be {shares[best]:.0%}'

    @property
    def _depth_m(self) -> NDArray[np.float32]:
        return np.concatenate([np.empty(0, np.float32), *self.samples])


def scale_warning(ate: AteResult | None, per_metre: float | None) -> str | None:
    """Return what the true motion says against the unit of the depth, with a remedy, or None."""
    if ate is None or per_metre is None or ate.scale <= 0:
        return None
    fits = ate.scaled_rmse_cm < _FITTING * ate.rmse_cm
    if not fits or 1 / _WRONG_SCALE < ate.scale < _WRONG_SCALE:
        return None
    unit = per_metre / ate.scale
    known = [known for known in _UNITS if 1 / 1.1 < known / unit < 1.1]
    return (
        f'the true motion is {ate.scale:.3g} times as large as the one that depth at '
        f'{per_metre:g} per metre gives. Try --depth-per-metre {(known or [round(unit)])[0]:g}'
    )
