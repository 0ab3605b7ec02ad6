# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What formats that store Gaussians in a few bits have in common."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_OPAQUE = 1 - 1e-6  # as other readers have it: the logit of exactly one is infinite


def smallest_three(words: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the index of the largest part and the codes (3, N) of the others of words (N,)."""
    return words >> 30, np.stack([words >> 20, words >> 10, words]) & 1023


def unit_quaternions(largest: NDArray[Any], others: Floats) -> Floats:
    """Return quaternions (4, N): `others` (3, N) in order, with the positive rest at `largest`."""
    rest = np.sqrt(np.maximum(0.0, 1.0 - (others**2).sum(axis=0)))
    parts = np.arange(4)[:, None]
    taken = np.clip(parts - (parts > largest), 0, 2)
    return np.where(parts == largest, rest, np.take_along_axis(others, taken, axis=0))


def opacity_logits(opacities: Floats) -> Floats:
    """Return logits, finite also for opacities of zero and one."""
    opacities = np.clip(opacities, 1 - _OPAQUE, _OPAQUE)
    return np.log(opacities / (1 - opacities))
