# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Polygons in an image, as text."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .schema import ConfigError

_EXAMPLE = '[[0.3, 0.8], [0.7, 0.8], [0.7, 1], [0.3, 1]]'


def polygons(text: str) -> tuple[NDArray[np.float64], ...]:
    """Return the polygons (K, 2), x y as shares of width and height, of `Config.self_mask`.

    Raises `ConfigError` for anything but a list of corners, or a list of such lists.
    """
    if not text.strip():
        return ()
    try:
        given = json.loads(text)
        listed = given if _depth(given) == 3 else [given]
        found = tuple(np.array(polygon, np.float64) for polygon in listed)
    except (ValueError, TypeError, RecursionError):
        found = ()
    for polygon in found or (np.empty(0),):
        if polygon.ndim != 2 or polygon.shape[1] != 2 or len(polygon) < 3:
            raise ConfigError(
                f'self_mask is {text!r}, not the corners of a polygon such as {_EXAMPLE}, '
                'or a list of such polygons'
            )
        if not ((polygon >= 0.0) & (polygon <= 1.0)).all():
            raise ConfigError(
                f'self_mask has a corner at {polygon[np.abs(polygon - 0.5).argmax() // 2]}; '
                'corners are shares of width and height, from 0 to 1'
            )
    return found


def _depth(given: Any) -> int:
    """Return how deeply lists are nested."""
    return 1 + _depth(given[0]) if isinstance(given, list) and given else 0
