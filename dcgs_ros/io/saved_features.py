# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Features of a map's views in its file; files from before they were kept have none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.backend.features import Features
from .map_parts import MapFileError, check, check_finite, part

_COUNTS = 'feature_counts'  # (V,) of each view
_DESCRIPTORS, _RAYS = 'feature_descriptors', 'feature_rays'  # (F, 32) and (F, 2)
_DEPTHS = 'feature_depths_m'  # (F,)
_NONE = Features(
    np.empty((0, 32), np.uint8), np.empty((0, 2), np.float32), np.empty(0, np.float32)
)


def parts_of(features: Sequence[Features | None]) -> dict[str, NDArray[Any]]:
    """Return the arrays of the file for V views; none where no view's features are known."""
    if all(one is None for one in features):
        return {}
    known = [_NONE, *(one or _NONE for one in features)]
    return {
        _COUNTS: np.array([len(one) for one in known[1:]], np.int32),
        _DESCRIPTORS: np.concatenate([one.descriptors for one in known]),
        _RAYS: np.concatenate([one.rays for one in known]),
        _DEPTHS: np.concatenate([one.depths_m for one in known]),
    }


def from_parts(arrays: Mapping[str, NDArray[Any]], views: int) -> list[Features | None]:
    """Return the features of each view, None where the file has none.

    Raises `MapFileError` for parts that are missing or do not fit.
    """
    if _COUNTS not in arrays:
        return [None] * views
    counts = arrays[_COUNTS]
    check(_COUNTS, counts, np.int32, (views,))
    if (counts < 0).any():
        raise MapFileError(f'{_COUNTS}: one is {counts.min()}')
    ends = np.cumsum(counts, dtype=np.int64)
    total = int(ends[-1]) if views else 0
    descriptors, rays, depths_m = (part(arrays, name) for name in (_DESCRIPTORS, _RAYS, _DEPTHS))
    check(_DESCRIPTORS, descriptors, np.uint8, (total, 32))
    check(_RAYS, rays, np.float32, (total, 2))
    check(_DEPTHS, depths_m, np.float32, (total,))
    check_finite(_RAYS, rays)
    check_finite(_DEPTHS, depths_m)
    found: list[Features | None] = []
    for count, end in zip(counts.tolist(), ends.tolist(), strict=True):
        of_one = slice(end - count, end)
        one = Features(descriptors[of_one], rays[of_one], depths_m[of_one])
        found.append(one if count else None)
    return found
