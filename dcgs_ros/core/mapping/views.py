# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What the mapper keeps of a keyframe: its images, later compressed, its pose and exposure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..backend.features import Features
from ..errors import FrameError
from ..kernels.jit import kernel
from ..kernels.workers import Workers
from .exposure import Exposure
from .losses import Target
from .rectification import DEPTH_UNIT_M, Images

_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 95]
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]
_POSE_BETA_1, _POSE_BETA_2 = 0.9, 0.99


@dataclass
class KeyframeView:
    """A keyframe in the mapper; its pose and exposure are optimised with the map."""

    index: int
    stamp_ns: int
    T_tracked: NDArray[np.float64]  # (4, 4) T_world_cam of the tracker
    T_world_cam: NDArray[np.float64]  # (4, 4) as refined by the mapper
    exposure: Exposure
    visits: int = 0  # optimisation steps so far
    keyframe: int = -1  # the tracker's number of it; -1 for a view between keyframes
    features: Features | None = None  # by which its place is known again, once they are wanted
    reference_ns: int | None = None  # stamp of the keyframe that it moves with, if that is known
    _images: Images | None = None
    _encoded: tuple[bytes, bytes] | None = None
    _moments: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, 6)))
    _turns: int = 0

    @classmethod
    def of(
        cls,
        index: int,
        stamp_ns: int,
        T_tracked: NDArray[np.float64],
        images: Images,
        last: KeyframeView | None,
    ) -> KeyframeView:
        """Return a new view that starts with the correction and exposure of the `last` one."""
        T = T_tracked @ last.correction if last else T_tracked
        exposure = last.exposure if last else Exposure.none()
        return cls(index, stamp_ns, T_tracked, T, exposure, _images=images)

    @classmethod
    def restored(
        cls,
        index: int,
        stamp_ns: int,
        poses: tuple[NDArray[np.float64], NDArray[np.float64]],  # T_tracked and T_world_cam
        exposure: Exposure,
        visits: int,
        keyframe: int,
        encoded: tuple[bytes, bytes],  # colour and depth, as `encoded` gives them
        features: Features | None = None,
    ) -> KeyframeView:
        """Return a view as it was when it was saved."""
        return cls(index, stamp_ns, *poses, exposure, visits, keyframe, features, _encoded=encoded)

    @property
    def correction(self) -> NDArray[np.float64]:
        """(4, 4) change of the pose by the mapper: T_world_cam = T_tracked correction."""
        return se3.inverse(self.T_tracked) @ self.T_world_cam

    @property
    def T_map_tracked(self) -> NDArray[np.float64]:
        """(4, 4) transform from the tracker's world to the mapper's at this view."""
        return self.T_world_cam @ se3.inverse(self.T_tracked)

    def move(self, motion: NDArray[np.float64], bend: float) -> NDArray[np.float64]:
        """Move the view by `motion` (4, 4), in the tracker's world; return that in the mapper's.

        Views were wrong by `bend` to each other, m and rad. Where that and the motion are larger
        than the view's correction, this is dropped: it was found against a map that was wrong by
        more, and has made up for some of that already. Otherwise it stays as it is. So do the
        moments of `turn`, which are along the camera's own axes.
        """
        before, correction = self.T_world_cam, self.correction
        moved = se3.inverse(self.T_tracked) @ motion @ self.T_tracked
        if min(_size(moved), bend) > _size(correction):
            correction = np.eye(4)
        self.T_tracked = se3.orthonormalised(motion @ self.T_tracked)
        self.T_world_cam = self.T_tracked @ correction
        return self.T_world_cam @ se3.inverse(before)

    @property
    def images(self) -> Images:
        """The images, decoded if they are compressed."""
        if self._images is not None:
            return self._images
        assert self._encoded is not None
        color = cv2.imdecode(np.frombuffer(self._encoded[0], np.uint8), cv2.IMREAD_COLOR)
        return Images(cv2.cvtColor(color, cv2.COLOR_BGR2RGB), _decode(self._encoded[1]))

    @property
    def depth_m(self) -> NDArray[np.float32]:
        """(H, W) metres, decoded if it is compressed, without the colour; (0, 0) if retired."""
        if self._images is not None:
            return self._images.depth_m
        depth = self.encoded[1]
        if not depth:
            return np.empty((0, 0), np.float32)
        return Images(np.empty((0, 0, 3), np.uint8), _decode(depth)).depth_m

    @property
    def encoded(self) -> tuple[bytes, bytes]:
        """The colour as JPEG and the depth as 16-bit PNG; both empty if retired."""
        if self._encoded is not None:
            return self._encoded
        images = self.images
        bgr = cv2.cvtColor(images.color, cv2.COLOR_RGB2BGR)
        pairs = (('.jpg', bgr, _JPEG), ('.png', images.depth, _PNG))
        return tuple(_encode(*pair) for pair in pairs)  # type: ignore[return-value]

    @property
    def bytes(self) -> int:
        """Memory that the images take."""
        if self._images is not None:
            return self._images.color.nbytes + self._images.depth.nbytes
        return sum(len(data) for data in self.encoded)

    def compress(self) -> None:
        """Keep the images compressed only."""
        self._encoded, self._images = self.encoded, None

    def retire(self) -> None:
        """Delete the images; pose and exposure stay as they are."""
        self._encoded, self._images = (b'', b''), None

    @property
    def active(self) -> bool:
        """Whether the view still has images."""
        return self.bytes > 0

    def target(self, valid: NDArray[np.bool_], shrink: int, workers: Workers) -> Target:
        """Return the target of a rendering with one pixel for each shrink x shrink.

        `valid` (H, W) is the rectifier's.
        """
        images = self.images
        height, width = (size // shrink for size in images.depth.shape)
        color = np.empty((3, height, width), np.float32)
        depth_m = np.empty((height, width), np.float32)
        counts = np.empty((height, width), np.bool_)
        workers.run(_unpack, images.color, images.depth, valid, shrink, color, depth_m, counts)
        return Target(color, depth_m, counts)

    def turn(self, gradient: NDArray[np.float64], rates: NDArray[np.float64]) -> None:
        """Move the pose by one step of Adam: T_world_cam exp(-rates * direction).

        `gradient` (6,) by xi, translation first; `rates` (6,) metres and radians. A gradient that
        is not finite is ignored.
        """
        if not np.all(np.isfinite(gradient)):
            return
        self._turns += 1
        betas = np.array([[_POSE_BETA_1], [_POSE_BETA_2]])
        powers = np.stack([gradient, gradient**2])
        self._moments = betas * self._moments + (1 - betas) * powers
        first, second = self._moments / (1 - betas**self._turns)
        self.T_world_cam = self.T_world_cam @ se3.exp(-rates * first / (np.sqrt(second) + 1e-12))


def shrink_memory(views: Sequence[KeyframeView], budget: float) -> bool:
    """Compress the oldest views until all fit into `budget` bytes; return whether some retired.

    If compression is not enough, every second view but the newest is retired.
    """
    held = sum(view.bytes for view in views)
    for view in views:
        if held <= budget:
            return False
        held -= view.bytes
        view.compress()
        held += view.bytes
    if held <= budget:
        return False
    for view in [view for view in views[:-1] if view.active][1::2]:
        view.retire()
    return True


def _encode(suffix: str, image: NDArray[Any], options: list[int]) -> bytes:
    done, data = cv2.imencode(suffix, image, options)
    if not done:
        raise FrameError(f'OpenCV cannot encode {image.shape} {image.dtype} as {suffix}')
    return bytes(data)


def _decode(depth: bytes) -> NDArray[np.uint16]:
    return np.asarray(cv2.imdecode(np.frombuffer(depth, np.uint8), cv2.IMREAD_UNCHANGED))


@kernel
def _unpack(piece, pieces, color, depth, valid, shrink, out, out_depth, out_valid):
    """Reduce the piece's rows of the images by a whole factor `shrink`.

    `color` (H, W, 3) uint8, `depth` (H, W) uint16 in DEPTH_UNIT_M, `valid` (H, W) bool. Writes
    `out` (3, h, w) float32 mean colours 0 to 1, `out_depth` (h, w) float32 metres at the middle of
    each block, `out_valid` (h, w) bool, true if the whole block is valid; h = H // shrink.
    """
    height, width = out_depth.shape
    scale = np.float32(1.0 / (255.0 * shrink * shrink))
    unit, middle = np.float32(DEPTH_UNIT_M), shrink // 2
    for y in range(piece * height // pieces, (piece + 1) * height // pieces):
        for x in range(width):
            red, green, blue, all_valid = 0, 0, 0, True
            for dy in range(shrink):
                for dx in range(shrink):
                    u, v = x * shrink + dx, y * shrink + dy
                    red += color[v, u, 0]
                    green += color[v, u, 1]
                    blue += color[v, u, 2]
                    all_valid &= valid[v, u]
            out[0, y, x], out[1, y, x], out[2, y, x] = red * scale, green * scale, blue * scale
            out_depth[y, x] = depth[y * shrink + middle, x * shrink + middle] * unit
            out_valid[y, x] = all_valid


def bend(views: Sequence[KeyframeView], motions: NDArray[np.float64]) -> float:
    """Return how much views move to each other, m and rad, by `motions` (K, 4, 4) in the world."""
    T = np.array([view.T_tracked for view in views])
    first = se3.inverse(motions[0])
    return max(_size(one) for one in se3.inverse(T) @ first @ motions @ T)


def _size(motion: NDArray[np.float64]) -> float:
    """Return the length of the twist of a motion (4, 4), m and rad."""
    return float(np.linalg.norm(se3.log(motion)))
