# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What tracker, mapper and back end hand each other."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from . import se3
from .frame import RgbdFrame


@dataclass(frozen=True)
class KeyframePose:
    """A keyframe by its name, and where it is."""

    stamp_ns: int  # of its colour image: its name between tracker, mapper and back end
    T_world_cam: NDArray[np.float64]  # (4, 4)


@dataclass(frozen=True)
class PosedFrame:
    """A tracked frame for the mapper to look at: a view between keyframes, or a `Keyframe`."""

    frame: RgbdFrame
    T_world_cam: NDArray[np.float64]  # (4, 4) at the colour's instant
    T_cam_cam_at_depth: NDArray[np.float64]  # (4, 4) camera at the depth's instant to colour's
    # The keyframe that it was placed relative to, and where that was then: if it is corrected
    # meanwhile, the frame goes with it. None: itself if it is a keyframe, else not known.
    reference: KeyframePose | None = field(default=None, kw_only=True)


@dataclass(frozen=True)
class Odometry:
    """Where a keyframe was tracked relative to the ones whose Gaussians it matched."""

    keyframe: int  # its index, from 0, which never changes
    submap: int  # in which it is, from 0
    hosts: NDArray[np.int32]  # (H,) earlier keyframes, ascending; none begin a map
    T_host_cam: NDArray[np.float64]  # (H, 4, 4)
    information: NDArray[np.float64]  # (H, 6, 6) of each host on xi; their sum is C^-1
    covariance: NDArray[np.float64]  # (6, 6) of xi in T_host_cam exp(xi), m and rad, of all hosts


@dataclass(frozen=True)
class Sightings:
    """The corners that a keyframe sees, which are tracked from frame to frame."""

    ids: NDArray[np.int64]  # (L,) of the landmarks
    rays: NDArray[np.float32]  # (L, 2) undistorted x/z, y/z
    depths_m: NDArray[np.float32]  # (L,) 0: none

    @classmethod
    def none(cls) -> Sightings:
        """Return an empty set."""
        rays = np.empty((0, 2), np.float32)
        return cls(np.empty(0, np.int64), rays, rays[:, 0])


@dataclass(frozen=True)
class Keyframe(PosedFrame):
    """A frame that extended the tracker's map, with the Gaussians it spawned."""

    ids: NDArray[np.int64]  # (N,)
    means: NDArray[np.float32]  # (N, 3) metres, world
    normals: NDArray[np.float32]  # (N, 3) unit, world
    odometry: Odometry | None = None  # None: from another process
    sightings: Sightings | None = None  # None: likewise
    submap: int = 0  # in which it was made

    @property
    def has_image(self) -> bool:
        """Return whether its images are there."""
        return self.frame.depth_m.size > 1

    def without_image(self) -> Keyframe:
        """Return it with images of one pixel."""
        color, depth_m = self.frame.color[:1, :1].copy(), np.ones((1, 1), np.float32)
        return replace(self, frame=replace(self.frame, color=color, depth_m=depth_m))

    def moved(self, motion: NDArray[np.float64]) -> Keyframe:
        """Return it and its Gaussians moved by `motion` (4, 4), in the world."""
        return replace(
            self, T_world_cam=motion @ self.T_world_cam,
            means=se3.transform(motion, self.means).astype(np.float32),
            normals=(self.normals @ motion[:3, :3].T).astype(np.float32),
        )  # fmt: skip


@dataclass(frozen=True)
class Correction:
    """Better poses of all keyframes that the back end knows; later ones go with the last."""

    revision: int  # rising
    stamps_ns: NDArray[np.int64]  # (K,) of the first K keyframes, which name them everywhere
    T_world_cam: NDArray[np.float64]  # (K, 4, 4)
    covariances: NDArray[np.float64]  # (K, 6, 6) in the world: of eps in exp(eps) T_world_cam
    submaps: NDArray[np.int32]  # (K,) in which each is; those that were joined have one number


@dataclass(frozen=True)
class MapUpdate:
    """The mapper's answer: how the tracker's Gaussians changed, and which were removed."""

    ids: NDArray[np.int64]  # (N,)
    means: NDArray[np.float32]  # (N, 3) metres, world
    normals: NDArray[np.float32]  # (N, 3) unit, world: axis of the smallest scale of Sigma_r
    flatness: NDArray[np.float32]  # (N,) lambda3 / lambda2 of Sigma_r
    removed: NDArray[np.int64]  # (R,)
    revision: int = 0  # of the last correction that the mapper had taken: whose world it is in
