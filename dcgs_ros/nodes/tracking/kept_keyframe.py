# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A keyframe that is kept for a mapper which lacks it, with its images compressed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core import se3
from ...core.keyframe import Keyframe
from ...io.ros_images import in_millimetres
from ..messages.packet import KeyframePacket

Alive = Callable[[NDArray[np.int64]], NDArray[np.bool_]]  # which of the ids (N,) exist: (N,)

_DEPTH_UNITS = np.float32(1000.0)  # per metre: the 16UC1 that is sent
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 95]
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]
_GAUSSIAN_BYTES = 60


@dataclass
class KeptKeyframe:
    """A packet with its colour as JPEG and its depth as PNG, exact to the millimetre sent."""

    packet: KeyframePacket  # with images of one pixel
    color: NDArray[np.uint8]
    depth: NDArray[np.uint8]

    @staticmethod
    def of(packet: KeyframePacket) -> KeptKeyframe:
        """Compress the images of a keyframe."""
        frame = packet.posed.frame
        pixel = frame.color[:1, :1].copy()  # a view would keep the whole image
        small = replace(frame, color=pixel, depth_m=np.ones((1, 1), np.float32))
        color = frame.color if frame.color.ndim == 2 else frame.color[..., ::-1]
        return KeptKeyframe(
            replace(packet, posed=replace(packet.posed, frame=small)),
            cv2.imencode('.jpg', color, _JPEG)[1],
            cv2.imencode('.png', in_millimetres(frame.depth_m), _PNG)[1],
        )

    @property
    def keyframe(self) -> Keyframe:
        """The keyframe without its images."""
        assert isinstance(self.packet.posed, Keyframe)
        return self.packet.posed

    @property
    def bytes(self) -> int:
        """Approximate size in memory."""
        return self.color.nbytes + self.depth.nbytes + _GAUSSIAN_BYTES * len(self.keyframe.ids)

    def move_to(self, T_world_cam: NDArray[np.float64]) -> None:
        """Put the keyframe, and its Gaussians with it, to a corrected pose (4, 4)."""
        motion = T_world_cam @ se3.inverse(self.keyframe.T_world_cam)
        self.packet = replace(self.packet, posed=self.keyframe.moved(motion))

    def take_over(self, other: KeptKeyframe) -> None:
        """Add the Gaussians of another keyframe, which is to be dropped; they move with this one.

        Both must be of one sub-map and have taken the same corrections.
        """
        ours, theirs = self.keyframe, other.keyframe
        keyframe = replace(
            ours, ids=np.concatenate([ours.ids, theirs.ids]),
            means=np.concatenate([ours.means, theirs.means]),
            normals=np.concatenate([ours.normals, theirs.normals]),
        )  # fmt: skip
        self.packet = replace(self.packet, posed=keyframe)

    def decoded(self, alive: Alive) -> KeyframePacket:
        """Return the packet with its images, without the Gaussians that no longer exist."""
        keyframe, grey = self.keyframe, self.keyframe.frame.color.ndim == 2
        flag = cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR
        color = cv2.imdecode(self.color, flag)
        depth = cv2.imdecode(self.depth, cv2.IMREAD_UNCHANGED)
        frame = replace(
            keyframe.frame, color=np.ascontiguousarray(color if grey else color[..., ::-1]),
            depth_m=depth.astype(np.float32) / _DEPTH_UNITS,
        )  # fmt: skip
        here = alive(keyframe.ids)
        keyframe = replace(
            keyframe, frame=frame, ids=keyframe.ids[here], means=keyframe.means[here],
            normals=keyframe.normals[here],
        )  # fmt: skip
        return replace(self.packet, posed=keyframe)
