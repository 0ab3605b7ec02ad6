# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Camera poses that datasets store as 4x4 matrices, checked before they are used."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core import se3
from ...core.trajectory import Trajectory
from ..source import SourceError
from .text_files import read_text

# Published matrices are right to five decimals or more; a larger error means no rotation at all.
ROTATION_TOLERANCE = 1e-2
MAX_TRANSLATION_M = 1e6  # a pose farther from the origin is a corrupt number
_MAX_MATRIX_BYTES = 2**16  # of a file with sixteen numbers


def parse_matrix(text: str, side: int = 4) -> NDArray[np.float64]:
    """Parse sixteen numbers, row by row, as (4, 4); raises `ValueError` for anything else.

    With another `side` that matrix is taken too. Numbers are separated by blanks or commas.
    """
    words = text.replace(',', ' ').split()
    if len(words) == side**2:
        return np.array([float(word) for word in words]).reshape(side, side)
    if len(words) != 16:
        raise ValueError(f'{len(words)} numbers, not the 16 of a 4x4 matrix')
    return np.array([float(word) for word in words]).reshape(4, 4)


def read_matrix(path: Path, side: int = 4) -> NDArray[np.float64]:
    """Read a file as `parse_matrix` does; raises `SourceError`."""
    try:
        return parse_matrix(read_text(path, _MAX_MATRIX_BYTES), side)
    except ValueError as error:
        raise SourceError(f'{path}: {error}') from None


def read_pose(path: Path) -> NDArray[np.float64]:
    """Read a file of sixteen numbers as (4, 4); NaN if it is missing or holds anything else."""
    try:
        return read_matrix(path)
    except SourceError:
        return np.full((4, 4), np.nan)


def are_rigid(T: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return which of the matrices (N, 4, 4) are finite rigid transforms, (N,)."""
    usable = np.isfinite(T).all(axis=(1, 2)) & (np.abs(T).max(axis=(1, 2)) < MAX_TRANSLATION_M)
    T = np.where(usable[:, None, None], T, 0.0).astype(np.float64)
    R = T[:, :3, :3]
    off = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    affine = np.abs(T[:, 3] - (0, 0, 0, 1)).max(axis=1) < ROTATION_TOLERANCE
    return usable & affine & (off < ROTATION_TOLERANCE) & (np.linalg.det(R) > 0)


def rigid_trajectory(
    stamps_ns: NDArray[np.int64], T_world_cam: NDArray[np.floating]
) -> Trajectory | None:
    """Return the trajectory of those poses (N, 4, 4) at stamps (N,) that are rigid.

    Datasets mark frames without a pose by invalid matrices. None if no pose is rigid.
    """
    valid = are_rigid(T_world_cam)
    if not valid.any():
        return None
    poses = T_world_cam[valid].astype(np.float64)
    poses[:, 3] = 0, 0, 0, 1
    return Trajectory(stamps_ns[valid], np.array([se3.orthonormalised(T) for T in poses]))
