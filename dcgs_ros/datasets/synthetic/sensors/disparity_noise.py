# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Disparity noise of a real active stereo camera: smooth over tens of pixels, and lasting."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from ..noise import smoothed, white_noise

# Cell size and standard deviation, pixels at f = 615 and a baseline of 50 mm. Fitted to the rms of
# residuals of planes within windows on a D435: 0.014 within 5 pixels, 0.03 within 11, 0.06 within
# 21, 0.08 within 41. These say nothing about more than 40 pixels; the last two levels are from the
# correlation of a tracker's residuals on that recording, 0.14 at 25-40 pixels, 0.05 at 60-100.
_LEVELS = ((2, 0.049), (4, 0.088), (16, 0.058), (32, 0.035))
_SIGMA_CELLS = 1.5  # of each level's blur, enough for cubic interpolation
_WHITE_PX = 0.011
# Share of the variance that stays where the camera does. Dots, texture and rectification err alike
# in each frame, only the imagers' noise is new: Intel specifies a temporal noise of half the
# spatial one (D400 datasheet, depth quality: 1 % and 2 %).
_LASTING = 0.75
_LIFE_PX = 20.0  # image motion that replaces the lasting part: it then matches other texture
_STREAM = 30


def disparity_noise(
    seed: int, index: int, travel_px: float, shape: tuple[int, int]
) -> NDArray[np.float32]:
    """Return errors (H, W) of frame `index` in pixels of disparity, of an overall 0.12 px.

    `travel_px` is the motion of the image since the first frame. Any frame is made without those
    before it: the lasting part turns from one white image to the next in each `_LIFE_PX`, at
    constant variance.
    """
    total = np.zeros((1, 1), np.float32)
    for level, (cell, sigma_px) in reversed(list(enumerate(_LEVELS))):
        size = -(-shape[0] // cell), -(-shape[1] // cell)
        white = _lasting_white(seed, index, travel_px, _STREAM + level, size)
        total = cv2.resize(total, size[::-1], interpolation=cv2.INTER_CUBIC)
        total += np.float32(sigma_px) * smoothed(white, _SIGMA_CELLS)
    total = cv2.resize(total, shape[::-1], interpolation=cv2.INTER_CUBIC)
    fine = white_noise(seed, index, _STREAM + len(_LEVELS), (1, *shape))[0]
    return total + np.float32(_WHITE_PX) * fine


def _lasting_white(
    seed: int, index: int, travel_px: float, stream: int, size: tuple[int, int]
) -> NDArray[np.float32]:
    """Return standard normals (h, w), independent of each other but not from frame to frame."""
    block, share = divmod(travel_px / _LIFE_PX, 1.0)
    angle = 0.5 * math.pi * share
    fresh = white_noise(seed, index, stream, (1, *size))[0]
    old, new = (
        white_noise(seed, int(block) + k, stream + 2 * len(_LEVELS), (1, *size))[0] for k in (0, 1)
    )
    lasting = np.float32(math.cos(angle)) * old + np.float32(math.sin(angle)) * new
    return np.float32(math.sqrt(_LASTING)) * lasting + np.float32(math.sqrt(1 - _LASTING)) * fresh
