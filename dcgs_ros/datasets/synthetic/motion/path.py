# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What the paths of cameras have in common."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

X, Y, Z, YAW, PITCH, ROLL = range(6)
_TYPICAL_DEPTH_M = 1.5
_BLOCK = 256  # frames


class Path(Protocol):
    """Where a camera is at any time."""

    # Camera to base (x forward, y left, z up, on the ground); None where a hand carries it.
    T_base_cam: NDArray[np.float64] | None

    def poses(self, times_s: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return T_world_cam (N, 4, 4) at times (N,), x right, y down, z forward; world z up."""
        ...

    def ground(self, times_s: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return x, y, metres, and heading, radians (N, 3), of what carries the camera."""
        ...


class Motion(Protocol):
    """What a scene intends a camera to do."""

    def path(self, seed: int, speed: float) -> Path:
        """Return the path, with the shake of a seed, at so many times the usual speed."""
        ...


def poses_of(channels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return T_world_cam (N, 4, 4) of channels (6, N): metres, degrees.

    Yaw turns from the world's x axis to its y axis, pitch looks up, roll to the right.
    """
    x, y, z, *angles = channels
    yaw, pitch, roll = np.deg2rad(angles)
    zero = np.zeros_like(yaw)
    forward = np.stack(
        [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], axis=1
    )
    level = np.stack([np.sin(yaw), -np.cos(yaw), zero], axis=1)
    down = np.cross(forward, level)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    poses = np.tile(np.eye(4), (len(yaw), 1, 1))
    poses[:, :3, 0] = c * level + s * down
    poses[:, :3, 1] = c * down - s * level
    poses[:, :3, 2] = forward
    poses[:, :3, 3] = np.stack([x, y, z], axis=1)
    return poses


class ImageMotion:
    """By how many pixels the image has moved since the first frame, things 1.5 m away.

    It only grows: the sum of what turning and moving do to the middle of the image. Summed up in
    fixed blocks, as far as it is asked for: the same for a frame however it is reached.
    """

    def __init__(self, path: Path, rate_hz: int, focal_px: float) -> None:
        """Begin at time 0."""
        self._path, self._rate_hz, self._focal_px = path, rate_hz, focal_px
        self._sums = [np.zeros(1)]

    def __call__(self, index: int) -> float:
        """Return the pixels until frame `index`."""
        while len(self._sums) <= index // _BLOCK + 1:
            first = (len(self._sums) - 1) * _BLOCK
            poses = self._path.poses(np.arange(first, first + _BLOCK + 1) / self._rate_hz)
            across = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / _TYPICAL_DEPTH_M
            # The chord between optical axes is the angle, for the small ones between frames.
            turned = np.linalg.norm(np.diff(poses[:, :3, 2], axis=0), axis=1)
            start = self._sums[-1][-1]
            self._sums.append(start + self._focal_px * np.cumsum(across + turned))
        if index == 0:
            return 0.0
        block, place = divmod(index - 1, _BLOCK)
        return float(self._sums[block + 1][place])
