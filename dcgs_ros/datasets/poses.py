# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Poses that datasets write as matrices of four by four, checked before they are used."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core import se3
from ..core.trajectory import Trajectory
from .source import SourceError

# Published matrices are right to five decimals or more; what is farther off is no rotation.
ROTATION_TOLERANCE = 1e-2
MAX_TRANSLATION_M = 1e6  # farther away, a pose is a number that went wrong
_MAX_MATRIX_BYTES = 2**16  # of a file with sixteen numbers


def read_text(path: Path, max_bytes: int) -> str:
    """Read a text file; raises `SourceError` where it cannot be, or is larger than `max_bytes`."""
    try:
        size = path.stat().st_size
        if size > max_bytes:
            raise SourceError(f'{path}: has {size} bytes, more than the {max_bytes} it may have')
        return path.read_text(encoding='utf-8', errors='replace')
    except OSError as error:
        raise SourceError(f'{path}: cannot be read: {error.strerror}') from error


def parse_matrix(text: str) -> NDArray[np.float64]:
    """Sixteen numbers, row by row, to (4, 4); raises `ValueError` for anything else."""
    words = text.split()
    if len(words) != 16:
        raise ValueError(f'{len(words)} numbers, not the 16 of a 4x4 matrix')
    return np.array([float(word) for word in words]).reshape(4, 4)


def read_matrix(path: Path) -> NDArray[np.float64]:
    """Read a file of sixteen numbers (4, 4); raises `SourceError`."""
    try:
        return parse_matrix(read_text(path, _MAX_MATRIX_BYTES))
    except ValueError as error:
        raise SourceError(f'{path}: {error}') from None


def read_pose(path: Path) -> NDArray[np.float64]:
    """Read a file of sixteen numbers (4, 4); NaN where it holds something else, or is missing."""
    try:
        return read_matrix(path)
    except SourceError:
        return np.full((4, 4), np.nan)


def are_rigid(T: NDArray) -> NDArray[np.bool_]:
    """Tell which of the matrices (N, 4, 4) are finite rotations and translations."""
    usable = np.isfinite(T).all(axis=(1, 2)) & (np.abs(T).max(axis=(1, 2)) < MAX_TRANSLATION_M)
    T = np.where(usable[:, None, None], T, 0.0).astype(np.float64)
    R = T[:, :3, :3]
    off = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    affine = np.abs(T[:, 3] - (0, 0, 0, 1)).max(axis=1) < ROTATION_TOLERANCE
    return usable & affine & (off < ROTATION_TOLERANCE) & (np.linalg.det(R) > 0)


def rigid_trajectory(stamps_ns: NDArray[np.int64], T_world_cam: NDArray) -> Trajectory | None:
    """Poses (N, 4, 4) at stamps (N,), those that are such: where a dataset was lost it has none.

    None where no pose is.
    """
    valid = are_rigid(T_world_cam)
    if not valid.any():
        return None
    poses = T_world_cam[valid].astype(np.float64)
    poses[:, 3] = 0, 0, 0, 1
    return Trajectory(stamps_ns[valid], np.array([se3.orthonormalised(T) for T in poses]))
