# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What travels from tracker to mapper, as arrays; no ROS in it."""

from __future__ import annotations

from dataclasses import dataclass

from ...core.camera import PinholeCamera
from ...core.keyframe import Keyframe, PosedFrame


@dataclass(frozen=True)
class KeyframePacket:
    """A keyframe, or a view between keyframes, for the mapper."""

    epoch: int  # of the map; 0 where a view does not tell it
    camera: PinholeCamera
    posed: PosedFrame
    camera_frame: str  # frame_id of the images

    @property
    def stamp_ns(self) -> int:
        """Stamp of the colour image, which is the keyframe's name too."""
        return self.posed.frame.stamp_ns

    @property
    def carries_gaussians(self) -> bool:
        """Return whether the mapper's map is incomplete without it."""
        return isinstance(self.posed, Keyframe) and len(self.posed.ids) > 0
