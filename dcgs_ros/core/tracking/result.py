# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What the tracker says of each frame."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from ..keyframe import Keyframe
from .observability import Observability


class TrackingState(Enum):
    """What a pose is worth."""

    OK = 'ok'
    DEGENERATE = 'degenerate'  # tracked, or carried, but one direction is badly constrained
    LOST = 'lost'  # the pose is the last good one, or a guess from it
    RELOCALISED = 'relocalised'  # a lost camera is found again, which is not confirmed yet


@dataclass(frozen=True)
class Reference:
    """Where a frame is relative to a keyframe, which stays true when the map is corrected."""

    keyframe: int  # the newest one, or the frame itself
    T_keyframe_cam: NDArray[np.float64]  # (4, 4)
    submap: int  # of the keyframe; above 0: not joined to the map, whose place is not known
    stamp_ns: int  # of the keyframe
    revision: int  # of the last correction; 0: none yet
    # (4, 4) from the world to what it would be here without corrections: with them the pose steps.
    T_uncorrected_world: NDArray[np.float64]


@dataclass(frozen=True)
class TrackResult:
    """One tracked frame."""

    stamp_ns: int  # of the colour image
    T_world_cam: NDArray[np.float64]  # (4, 4)
    T_cam_cam_at_depth: NDArray[np.float64]  # (4, 4) camera at the depth's instant to colour's
    # Of xi in T_world_cam exp(xi), (6, 6) each, translation first, m and rad: of the pose in the
    # map around the camera, and of the pose in the world, which the map itself adds to.
    covariance: NDArray[np.floating]
    covariance_world: NDArray[np.floating]
    state: TrackingState
    observability: Observability | None  # None: first frame, or lost
    points: int
    inliers: int  # depth pairs
    landmarks: int
    keyframe: bool  # whether this frame is one
    keyframes: tuple[Keyframe, ...]  # finished with this frame: the first one with the second
    colour_depth_offset_ms: float
    reference: Reference | None = None  # None: there is no keyframe yet
    # (6, 6) of the motion since the last frame that was tracked, in the camera frame of this one;
    # None: not known.
    motion_covariance: NDArray[np.floating] | None = None
    carried: bool = False  # whether only other sensors tell the pose: the images show nothing

    @property
    def submap(self) -> int:
        """In which sub-map it is; 0, that of the map itself, before the first keyframe."""
        return 0 if self.reference is None else self.reference.submap
