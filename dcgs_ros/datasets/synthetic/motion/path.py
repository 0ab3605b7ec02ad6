# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What the paths of cameras have in common."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

X, Y, Z, YAW, PITCH, ROLL = range(6)
_TYPICAL_DEPTH_M = 1.5


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


def image_motion(T_world_cam: NDArray[np.float64], focal_px: float) -> NDArray[np.float64]:
    """Return by how many pixels the image has moved (N,) along poses (N, 4, 4), things 1.5 m away.

    It only grows: the sum of what turning and moving do to the middle of the image.
    """
    steps = np.diff(T_world_cam[:, :3, 3], axis=0)
    across = np.linalg.norm(steps, axis=1) / _TYPICAL_DEPTH_M
    # The chord between optical axes is the angle, for the small ones between frames.
    turned = np.linalg.norm(np.diff(T_world_cam[:, :3, 2], axis=0), axis=1)
    return focal_px * np.concatenate([[0.0], np.cumsum(across + turned)])
