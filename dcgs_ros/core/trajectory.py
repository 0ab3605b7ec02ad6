# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A timed sequence of poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import DcgsError


class TrajectoryError(DcgsError):
    """Stamps or poses that do not form a trajectory."""


@dataclass(frozen=True)
class Trajectory:
    """Camera-to-world poses at strictly increasing stamps."""

    stamps_ns: NDArray[np.int64]  # (N,)
    T_world_cam: NDArray[np.float64]  # (N, 4, 4), metres

    def __post_init__(self) -> None:
        """Check shapes, order and finiteness; the error names the first bad pose."""
        n = len(self.stamps_ns)
        if self.T_world_cam.shape != (n, 4, 4):
            raise TrajectoryError(f'{n} stamps but poses of shape {self.T_world_cam.shape}')
        bad = np.flatnonzero(~np.isfinite(self.T_world_cam).all(axis=(1, 2)))
        if len(bad):
            raise TrajectoryError(f'pose {bad[0] + 1} of {n} is not finite')
        late = np.flatnonzero(np.diff(self.stamps_ns) <= 0)
        if len(late):
            raise TrajectoryError(
                f'stamps must increase: pose {late[0] + 2} of {n} comes '
                f'{(self.stamps_ns[late[0]] - self.stamps_ns[late[0] + 1]) * 1e-9:.6f} s before '
                'the one it follows'
            )

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.stamps_ns)
