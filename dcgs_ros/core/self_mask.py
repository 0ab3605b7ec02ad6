# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The parts of the robot that its own camera sees: of the image there nothing is used."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from .config.outlines import polygons
from .frame import RgbdFrame

_MARGIN = 7 / 640  # of the width: half of the window that KLT tracks, which is not to see them


@lru_cache(maxsize=4)
def covered(text: str, width: int, height: int) -> NDArray[np.bool_] | None:
    """Return the pixels (H, W) of the robot's parts and close beside them; None: there are none.

    It is read-only.
    """
    outlines = polygons(text)
    if not outlines:
        return None
    mask = np.zeros((height, width), np.uint8)
    for polygon in outlines:
        corners = np.round(polygon * (width, height) - 0.5).astype(np.int32)
        cv2.fillPoly(mask, [corners], 1)
    side = 2 * round(_MARGIN * width) + 1
    found = cv2.dilate(mask, np.ones((side, side), np.uint8)) > 0
    found.setflags(write=False)
    return found


def without_robot(frame: RgbdFrame, text: str) -> RgbdFrame:
    """Return a frame without depth where the robot's parts are.

    Raises `FrameError` where no depth is left.
    """
    height, width = frame.depth_m.shape
    mask = covered(text, width, height)
    if mask is None:
        return frame
    return replace(frame, depth_m=np.where(mask, np.float32(0.0), frame.depth_m))


def seen_beside(pixels: NDArray[np.floating], mask: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """Return which pixels (N, 2) are not on the robot's parts."""
    if mask is None:
        return np.ones(len(pixels), np.bool_)
    height, width = mask.shape
    x, y = np.round(pixels).astype(np.int64).T
    return ~mask[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
