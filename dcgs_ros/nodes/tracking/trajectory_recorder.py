# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Keeps the tracked poses of the base, to be written at the end."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core import se3
from ...core.trajectory import Trajectory
from ...io.trajectory import write_tum


class TrajectoryRecorder:
    """Records poses where a folder is given."""

    def __init__(self, folder: str) -> None:
        """Write into `folder`, which may not exist yet; '' records nothing."""
        self._folder = folder
        self._poses: list[tuple[int, NDArray[np.float64]]] = []

    def add(self, stamp_ns: int, T_world_base: NDArray[np.float64]) -> None:
        """Record a pose (4, 4); one that is not newer than the last begins a new trajectory."""
        if not self._folder:
            return
        if self._poses and stamp_ns <= self._poses[-1][0]:  # a recording is played again
            self._poses.clear()
        self._poses.append((stamp_ns, T_world_base))

    def remount(self, assumed: NDArray[np.float64], T_base_cam: NDArray[np.float64]) -> None:
        """Correct the poses so far, for which the camera (4, 4) was assumed elsewhere."""
        T = T_base_cam @ se3.inverse(assumed)  # from the world assumed to the right one
        self._poses = [(stamp, T @ pose @ se3.inverse(T)) for stamp, pose in self._poses]

    def write(self) -> str | None:
        """Write `trajectory.tum`; return what was written, None where there is nothing."""
        if not self._poses:
            return None
        path = Path(self._folder, 'trajectory.tum')
        path.parent.mkdir(parents=True, exist_ok=True)
        stamps, poses = zip(*self._poses, strict=True)
        write_tum(path, Trajectory(np.array(stamps), np.array(poses)))
        return f'{len(stamps)} poses in {path}'
