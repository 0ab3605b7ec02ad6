# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The camera's automatic exposure: an affine map of each colour channel, keyframe by keyframe."""

from __future__ import annotations

import numpy as np

from ..kernels.jit import kernel
from ..render.renderer import Rendering
from .losses import Exposure, Target

_STRIDE = 3  # pixels: a ninth of them is plenty for two numbers a channel
_COVERED = 0.1  # transmittance of the pixels that the map shows
_DARK, _BRIGHT = 0.03, 0.97  # the sensor clips beyond
_OUTLIER = 0.15  # a larger difference, even after the exposure before, is not the exposure's
_MIN_PIXELS = 200
_PRIOR = 0.01  # variance of colour that stands for "gain 1": flat images tell no gain


def fitted(rendering: Rendering, target: Target, before: Exposure, share: float) -> Exposure:
    """Take a share of the least squares fit of the target by the rendering.

    With all of it the map shows colours that no camera ever had, and looks worse without exposures
    than need be. `before` is kept where too little can be compared.
    """
    fit = np.full((2, 3), np.nan, np.float32)
    _fit(rendering.planes, target.color, target.valid, before.gain, before.offset, fit)
    none = np.array([[1.0], [0.0]], np.float32)
    kept = none + np.float32(share) * (fit - none)
    gain, offset = np.where(np.isnan(fit), (before.gain, before.offset), kept)
    return Exposure(gain.astype(np.float32), offset.astype(np.float32))


def blended(old: Exposure, new: Exposure, share: float) -> Exposure:
    """Go a share of the way from the old to the new one."""
    gain = old.gain + np.float32(share) * (new.gain - old.gain)
    return Exposure(gain, old.offset + np.float32(share) * (new.offset - old.offset))


@kernel
def _fit(planes, target, valid, gain_before, offset_before, out):
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
