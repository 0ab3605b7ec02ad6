# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Which frames become keyframes, and which Gaussians they spawn."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..camera import PinholeCamera
from ..config.stages import Config, KeyframeConfig
from ..sensor import SensorNoise
from .cloud import FrameCloud
from .estimator import RegisteredFrame, sample
from .gaussian_map import GaussianMap

_CONFIRM_SIGMAS = 3.0 * np.sqrt(2.0)  # largest difference of two measurements of a surface
_SPAWN_SIGMAS = 3.0  # a Gaussian this near along the ray is on the same surface
_URGENT = 0.6  # of either threshold: below it a keyframe is made at once


class KeyframePolicy:
    """Decides when the view has changed enough for a new keyframe."""

    def __init__(self, config: KeyframeConfig) -> None:
        """Start without a keyframe."""
        self.config = config
        self._T_world_cam = np.eye(4)
        self._stamp_ns = 0
        self._overlap = 0.0
        self._landmarks = 0

    def took(self, T_world_cam: NDArray[np.float64], stamp_ns: int, landmarks: int) -> None:
        """Remember the last keyframe."""
        self._T_world_cam, self._stamp_ns = T_world_cam, stamp_ns
        self._landmarks, self._overlap = landmarks, 0.0

    def move(self, motion: NDArray[np.float64]) -> None:
        """Move the last keyframe by `motion` (4, 4), in the world."""
        self._T_world_cam = motion @ self._T_world_cam

    def wants(
        self,
        T_world_cam: NDArray[np.float64],  # (4, 4)
        stamp_ns: int,
        turn_rad_s: float,
        overlap: float,
        landmarks: int,
    ) -> bool:
        """Return whether a frame should become a keyframe.

        `overlap` is the share of its points that the map explains, `landmarks` the number tracked.
        A frame of a fast turn is blurred and its depth is least certain in place: Gaussians from
        it would spoil the map, so it becomes a keyframe only if it is urgent. The overlap is
        compared with the best one since the last keyframe, not with 1: a noisy sensor has points
        that are never explained, not even just after a keyframe.
        """
        c = self.config
        self._overlap = max(self._overlap, overlap)
        seen = overlap / (c.overlap * max(self._overlap, 1e-9))
        few = self._landmarks < c.min_landmarks  # no corners there: a keyframe is no help
        kept = 1.0 if few else landmarks / (c.landmarks * self._landmarks)
        if min(seen, kept) < _URGENT:
            return True
        if (stamp_ns - self._stamp_ns) * 1e-9 < c.min_interval_s or turn_rad_s > c.max_turn_rad_s:
            return False
        moved = se3.log(se3.inverse(self._T_world_cam) @ T_world_cam)
        far = np.linalg.norm(moved[:3]) > c.translation_m
        turned = np.linalg.norm(moved[3:]) > c.rotation_rad
        return bool(far or turned or seen < 1.0 or kept < 1.0)


def candidates(
    registered: RegisteredFrame,
    last: RegisteredFrame | None,
    camera: PinholeCamera,
    config: Config,
) -> FrameCloud:
    """Sample the points that a keyframe may spawn, in the camera frame at the depth's instant.

    Only those remain that the depth of the `last` frame, if there is one, confirms, and that are
    not of a thing that moves.
    """
    frame, settings = registered.frame, config.keyframes
    cloud = sample(frame, camera, config, settings.spawn_stride_px, registered.twist_at_depth)
    cloud = registered.corners.standing(thinned(cloud, settings.spawn_min_m))
    if last is None:
        return cloud
    T_last_now = se3.inverse(last.T_world_cam @ last.T_cam_cam_at_depth) @ (
        registered.T_world_cam @ registered.T_cam_cam_at_depth
    )
    return confirmed(cloud, T_last_now, last.frame.depth_m, camera, config.sensor)


def spawn(
    cloud: FrameCloud,
    T_world_cam: NDArray[np.float64],
    gaussians: GaussianMap,
    host: int,
    focal_px: float,
    sensor: SensorNoise,
    config: KeyframeConfig,
    certain_m: float,
) -> NDArray[np.int64]:
    """Spawn Gaussians at the points of a keyframe's cloud that none covers; return the new ids.

    A Gaussian covers a point within `spawn_px` across its ray and the depth's noise along it.
    Points with sigma_z above `certain_m` are left out.
    """
    R, t = T_world_cam[:3, :3], T_world_cam[:3, 3]
    z = cloud.points[:, 2]
    sigma = sensor.sigma(z)
    turned = cloud.points @ R.T
    world = (turned + t).astype(np.float32)
    rays = (turned / np.linalg.norm(turned, axis=1, keepdims=True)).astype(np.float32)
    across = np.maximum(config.spawn_min_m, config.spawn_px / focal_px * z).astype(np.float32)
    along = np.maximum(across, _SPAWN_SIGMAS * sigma).astype(np.float32)
    new = (sigma <= certain_m) & ~gaussians.index.covered(
        gaussians.means, world, rays, across, along
    )
    normals = (cloud.normals[new] @ R.T).astype(np.float32)
    return gaussians.add(world[new], normals, cloud.flatness[new], t, host)


def thinned(cloud: FrameCloud, voxel_m: float) -> FrameCloud:
    """Return the first point of each voxel: nearby, pixels are closer than Gaussians may be."""
    cells = np.floor(cloud.points / voxel_m).astype(np.int64) & 0x1FFFFF
    keys = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
    return cloud[np.sort(np.unique(keys, return_index=True)[1])]


def confirmed(
    cloud: FrameCloud,
    T_other_cam: NDArray[np.float64],
    other_depth_m: NDArray[np.float32],
    camera: PinholeCamera,
    sensor: SensorNoise,
) -> FrameCloud:
    """Return the points that another depth image (H, W) also measures, within the noise."""
    there = se3.transform(T_other_cam, cloud.points)
    keep = there[:, 2] > 0.05
    pixels = np.round(camera.project(there[keep])).astype(int)
    inside = np.all((pixels >= 0) & (pixels < (camera.width, camera.height)), axis=1)
    keep[keep] = inside
    x, y = pixels[inside].T
    z = there[keep, 2]
    measured = other_depth_m[y, x]
    keep[keep] = np.abs(measured - z) <= _CONFIRM_SIGMAS * sensor.sigma(z)
    return cloud[keep]
