# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Ids of Gaussians between the nodes; those of two maps never coincide.

Each map has a number, its epoch, from 1 to 2^20 - 1. Between the nodes the tracker's Gaussian k
has the id epoch * 2^32 + k, which a FLOAT64 field holds exactly. Ids below 0 are those of the
Gaussians that the mapper added.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

EPOCH = 1 << 32
EPOCHS = 1 << 20


def joined_ids(epoch: int, ids: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the ids (N,) between the nodes for ids (N,) of the tracker."""
    return ids + epoch * EPOCH


def split_ids(ids: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return epochs (N,), 0 for the mapper's own Gaussians, and the tracker's ids (N,)."""
    epochs = np.where(ids < 0, 0, ids // EPOCH)
    return epochs, ids - epochs * EPOCH
