# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The camera's automatic exposure: an affine map of each colour channel, view by view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import DcgsError
from ..kernels.jit import kernel
from ..render.renderer import Rendering

_STRIDE = 3  # pixels: a ninth of them is enough for two numbers of a channel
_COVERED = 0.1  # largest transmittance of the pixels that are compared
_DARK, _BRIGHT = 0.03, 0.97  # the sensor clips beyond
_OUTLIER = 0.15  # a larger difference, even with the exposure before, has another cause
_MIN_PIXELS = 200
_PRIOR = 0.01  # variance of colour that stands for "gain 1": a flat image does not give the gain


class ExposureError(DcgsError):
    """Gains or offsets of the wrong shape or type."""


@dataclass(frozen=True)
class Exposure:
    """The exposure of a view relative to the map: shown = gain * color + offset."""

    gain: NDArray[np.float32]  # (3,)
    offset: NDArray[np.float32]  # (3,) colour from 0 to 1

    def __post_init__(self) -> None:
        """Check shapes and types."""
        for name, array in (('gain', self.gain), ('offset', self.offset)):
            if array.shape != (3,) or array.dtype != np.float32:
                raise ExposureError(f'{name} is {array.shape} {array.dtype}, not (3,) float32')

    @classmethod
    def none(cls) -> Exposure:
        """Return the exposure that changes nothing."""
        return cls(np.ones(3, np.float32), np.zeros(3, np.float32))

    def relative_to(self, other: Exposure) -> Exposure:
        """Return the exposure that, applied after `other`, gives this one."""
        gain = self.gain / other.gain
        return Exposure(gain, self.offset - gain * other.offset)


def mean(exposures: Sequence[Exposure]) -> Exposure:
    """Return the exposure with the mean gain and the mean offset."""
    gain = np.mean([exposure.gain for exposure in exposures], axis=0)
    return Exposure(gain, np.mean([exposure.offset for exposure in exposures], axis=0))


def fitted(
    rendering: Rendering,
    color: NDArray[np.float32],  # (3, H, W) of the view, 0 to 1
    valid: NDArray[np.bool_],  # (H, W)
    before: Exposure,
    share: float,
) -> Exposure:
    """Return a share of the exposure that fits the rendering to the view by least squares.

    With the whole of it the map would show colours that no camera had, and look worse without
    exposures. Channels with too few pixels to compare keep `before`.
    """
    fit = np.full((2, 3), np.nan, np.float32)
    _fit(rendering.planes, color, valid, before.gain, before.offset, fit)
    none = np.array([[1.0], [0.0]], np.float32)
    kept = none + np.float32(share) * (fit - none)
    gain, offset = np.where(np.isnan(fit), (before.gain, before.offset), kept)
    return Exposure(gain.astype(np.float32), offset.astype(np.float32))


def blended(old: Exposure, new: Exposure, share: float) -> Exposure:
    """Return the exposure a share of the way from the old to the new one."""
    gain = old.gain + np.float32(share) * (new.gain - old.gain)
    return Exposure(gain, old.offset + np.float32(share) * (new.offset - old.offset))


@kernel
def _fit(planes, target, valid, gain_before, offset_before, out):
    """Write gain and offset of each channel into `out` (2, 3); left alone with too few pixels.

    `planes` (5, H, W) float32 as in `Rendering`, `target` (3, H, W) float32 colours 0 to 1,
    `valid` (H, W) bool, `gain_before` and `offset_before` (3,).
    """
    height, width = valid.shape
    for c in range(3):
        n, sum_x, sum_y, sum_xx, sum_xy = 0, 0.0, 0.0, 0.0, 0.0
        for v in range(0, height, _STRIDE):
            for u in range(0, width, _STRIDE):
                x, y = planes[c, v, u], target[c, v, u]
                if not valid[v, u] or planes[4, v, u] > _COVERED:
                    continue
                error = min(abs(x - y), abs(gain_before[c] * x + offset_before[c] - y))
                if _DARK < y < _BRIGHT and error < _OUTLIER:
                    n += 1
                    sum_x += x
                    sum_y += y
                    sum_xx += x * x
                    sum_xy += x * y
        if n >= _MIN_PIXELS:
            mean_x, mean_y = sum_x / n, sum_y / n
            variance = sum_xx / n - mean_x * mean_x
            gain = (sum_xy / n - mean_x * mean_y + _PRIOR) / (variance + _PRIOR)
            out[0, c], out[1, c] = gain, mean_y - gain * mean_x
