# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Ids of Gaussians between the nodes; those of two maps never coincide.

Each map has a number, its epoch, below 2^20. Between the nodes the tracker's Gaussian k
has the id epoch * 2^32 + k, which a FLOAT64 field holds exactly. Ids below 0 are those of the
Gaussians that the mapper added. The maps of one tracker share all but the last bits of the epoch.
"""

from __future__ import annotations

import hashlib
import secrets
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.errors import DcgsError

EPOCH = 1 << 32
EPOCHS = 1 << 20
_MAPS = 1 << 7  # epochs of one tracker
_CHUNK = 1 << 18  # bytes of a file read at a time


def first_epoch() -> int:
    """Draw the number of a tracker's first map, so that those of two trackers do not coincide."""
    return _MAPS + secrets.randbelow(EPOCHS - _MAPS)


def epoch_of_file(path: Path) -> int:
    """Return the number of the map in a file: tracker and mapper that read it agree on it.

    Raises a `DcgsError` where it cannot be read.
    """
    digest = hashlib.blake2b(digest_size=8)
    try:
        with path.open('rb') as file:
            while chunk := file.read(_CHUNK):
                digest.update(chunk)
    except OSError as error:
        raise DcgsError(f'{path}: cannot be read: {error.strerror or error}') from error
    return _MAPS + int.from_bytes(digest.digest(), 'little') % (EPOCHS - _MAPS)


def next_epoch(epoch: int) -> int:
    """Return the number of the next map of the tracker whose last one was `epoch`."""
    return epoch - epoch % _MAPS + (epoch + 1) % _MAPS


def is_epoch(number: int) -> bool:
    """Return whether a number can be that of a map."""
    return _MAPS <= number < EPOCHS


def same_tracker(epoch: int, other: int) -> bool:
    """Return whether two maps are of one tracker."""
    return epoch // _MAPS == other // _MAPS


def joined_ids(epoch: int, ids: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the ids (N,) between the nodes for ids (N,) of the tracker."""
    return ids + epoch * EPOCH


def split_ids(ids: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return epochs (N,), 0 for the mapper's own Gaussians, and the tracker's ids (N,)."""
    epochs = np.where(ids < 0, 0, ids // EPOCH)
    return epochs, ids - epochs * EPOCH
