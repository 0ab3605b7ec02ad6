# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What the mapper keeps of a keyframe: its images, small or compressed, its pose and exposure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..camera import PinholeCamera
from ..errors import FrameError
from ..frame import RgbdFrame
from ..kernels.jit import kernel
from ..kernels.workers import Workers
from .losses import Exposure, Target

_DEPTH_UNIT_M = 5e-4  # of the 16 bits a depth is kept in
_DEPTH_LIMIT_M = 65535 * _DEPTH_UNIT_M
_CRACK = 0.02  # of the depth: both sides of a crack are one surface
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 95]
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]
_POSE_BETA_1, _POSE_BETA_2 = 0.9, 0.99


@dataclass(frozen=True)
class Images:
    """Colour and depth as a pinhole camera without distortion sees them."""

    color: NDArray[np.uint8]  # (H, W, 3)
    depth: NDArray[np.uint16]  # (H, W) in _DEPTH_UNIT_M, 0 = none

    @property
    def depth_m(self) -> NDArray[np.float32]:
        """(H, W) metres."""
        return self.depth * np.float32(_DEPTH_UNIT_M)


class Rectifier:
    """Resamples images so that straight lines are straight; the intrinsics stay."""

    def __init__(self, camera: PinholeCamera) -> None:
        """Compute the maps; a camera without distortion has none."""
        self._camera = camera
        self._maps: tuple[NDArray, NDArray] | None = None
        self.valid = np.ones((camera.height, camera.width), np.bool_)
        if not any(camera.distortion):
            return
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)]
        pixels = camera.project(np.stack(rays, axis=-1).reshape(-1, 3)).reshape(*u.shape, 2)
        self._maps = np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1])
        limits = np.array([camera.width - 1, camera.height - 1])
        self.valid = np.all((pixels >= 0) & (pixels <= limits), axis=-1)

    def __call__(
        self, frame: RgbdFrame, T_cam_cam_at_depth: NDArray[np.float64] | None = None
    ) -> Images:
        """Colour bilinearly, (0, 0, 0) outside; depth as it was at the colour's instant.

        Each depth pixel goes as a point to where the camera was then, by `T_cam_cam_at_depth`
        (identity by default), and from there onto the image; the nearest one counts.
        """
        color = frame.color
        if color.ndim == 2:
            color = np.repeat(color[..., None], 3, axis=2)
        if self._maps is not None:
            color = np.asarray(cv2.remap(color, *self._maps, cv2.INTER_LINEAR))
        T = np.eye(4) if T_cam_cam_at_depth is None else T_cam_cam_at_depth
        depth_m = np.zeros_like(frame.depth_m)
        rays, intrinsics = self._camera.undistortion_map, self._camera.parameters[:4]
        _reproject(frame.depth_m, rays, T, intrinsics, _DEPTH_LIMIT_M, depth_m)
        if self._maps is not None or T_cam_cam_at_depth is not None:
            depth_m = _without_cracks(depth_m)
        depth = depth_m / np.float32(_DEPTH_UNIT_M) + np.float32(0.5)
        return Images(np.ascontiguousarray(color), depth.astype(np.uint16))


@dataclass
class KeyframeView:
    """A keyframe; pose and exposure are optimised with the map."""

    index: int
    stamp_ns: int
    T_tracked: NDArray[np.float64]  # (4, 4) T_world_cam as the tracker gave it
    T_world_cam: NDArray[np.float64]  # (4, 4) as the mapper has it
    exposure: Exposure
    visits: int = 0
    _images: Images | None = None
    _encoded: tuple[bytes, bytes] | None = None
    _moments: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, 6)))
    _turns: int = 0

    @classmethod
    def of(
        cls,
        index: int,
        stamp_ns: int,
        T_tracked: NDArray,
        images: Images,
        last: KeyframeView | None,
    ) -> KeyframeView:
        """Begin with the correction and the exposure of the last keyframe."""
        T = T_tracked @ last.correction if last else T_tracked
        exposure = (
            last.exposure if last else Exposure(np.ones(3, np.float32), np.zeros(3, np.float32))
        )
        return cls(index, stamp_ns, T_tracked, T, exposure, _images=images)

    @property
    def correction(self) -> NDArray[np.float64]:
        """(4, 4) what the mapper has changed: T_world_cam = T_tracked correction."""
        return se3.inverse(self.T_tracked) @ self.T_world_cam

    @property
    def T_map_tracked(self) -> NDArray[np.float64]:
        """(4, 4) from the tracker's world to the mapper's, as this view sees both."""
        return self.T_world_cam @ se3.inverse(self.T_tracked)

    @property
    def images(self) -> Images:
        """The images, decoded where they are compressed."""
        if self._images is not None:
            return self._images
        assert self._encoded is not None
        color, depth = (
            cv2.imdecode(np.frombuffer(data, np.uint8), flag)
            for data, flag in zip(
                self._encoded, (cv2.IMREAD_COLOR, cv2.IMREAD_UNCHANGED), strict=True
            )
        )
        return Images(cv2.cvtColor(color, cv2.COLOR_BGR2RGB), depth)

    @property
    def encoded(self) -> tuple[bytes, bytes]:
        """Colour as JPEG, depth as PNG of 16 bits."""
        if self._encoded is not None:
            return self._encoded
        images = self.images
        bgr = cv2.cvtColor(images.color, cv2.COLOR_RGB2BGR)
        pairs = (('.jpg', bgr, _JPEG), ('.png', images.depth, _PNG))
        return tuple(_encode(*pair) for pair in pairs)  # type: ignore[return-value]

    @property
    def bytes(self) -> int:
        """Memory the images take."""
        if self._images is not None:
            return self._images.color.nbytes + self._images.depth.nbytes
        return sum(len(data) for data in self.encoded)

    def compress(self) -> None:
        """Keep the images compressed from now on."""
        self._encoded, self._images = self.encoded, None

    def retire(self) -> None:
        """Give the images up; pose and exposure stay as they are."""
        self._encoded, self._images = (b'', b''), None

    @property
    def active(self) -> bool:
        """Whether there still are images to optimise for."""
        return self.bytes > 0

    def target(self, valid: NDArray[np.bool_], shrink: int, workers: Workers) -> Target:
        """Unpack what a rendering with one pixel for each shrink x shrink should look like."""
        images = self.images
        height, width = (size // shrink for size in images.depth.shape)
        color = np.empty((3, height, width), np.float32)
        depth_m = np.empty((height, width), np.float32)
        counts = np.empty((height, width), np.bool_)
        workers.run(_unpack, images.color, images.depth, valid, shrink, color, depth_m, counts)
        return Target(color, depth_m, counts)

    def turn(self, gradient: NDArray[np.float64], rates: NDArray[np.float64]) -> None:
        """Move the pose by one step of Adam: T_world_cam exp(-rates * direction)."""
        if not np.all(np.isfinite(gradient)):
            return
        self._turns += 1
        betas = np.array([[_POSE_BETA_1], [_POSE_BETA_2]])
        powers = np.stack([gradient, gradient**2])
        self._moments = betas * self._moments + (1 - betas) * powers
        first, second = self._moments / (1 - betas**self._turns)
        self.T_world_cam = self.T_world_cam @ se3.exp(-rates * first / (np.sqrt(second) + 1e-12))


def shrink_memory(views: Sequence[KeyframeView], budget: float) -> bool:
    """Compress the oldest views until all fit into `budget` bytes.

    If that is not enough, every second one of the older views gives up its images. Return
    whether some did.
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


def _encode(suffix: str, image: NDArray, options: list[int]) -> bytes:
    done, data = cv2.imencode(suffix, image, options)
    if not done:
        raise FrameError(f'OpenCV cannot write {image.shape} {image.dtype} as {suffix}')
    return bytes(data)


@kernel
def _reproject(depth_m, rays, T, intrinsics, limit_m, out):
    height, width = out.shape
    for v in range(height):
        for u in range(width):
            z = depth_m[v, u]
            if not 0 < z < limit_m:  # also where it is NaN
                continue
            x, y = rays[v, u, 0] * z, rays[v, u, 1] * z
            there_z = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            if not 0 < there_z < limit_m:
                continue
            there_x = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            there_y = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            to_u = math.floor(intrinsics[0] * there_x / there_z + intrinsics[2] + 0.5)
            to_v = math.floor(intrinsics[1] * there_y / there_z + intrinsics[3] + 0.5)
            if 0 <= to_u < width and 0 <= to_v < height:
                before = out[to_v, to_u]
                if before == 0 or there_z < before:
                    out[to_v, to_u] = there_z


@kernel
def _without_cracks(depth_m):
    """Close gaps of one pixel that resampling leaves in a surface."""
    out = depth_m.copy()
    height, width = depth_m.shape
    for axis in range(2):  # where gaps cross, the second one meets what closed the first
        dv, du = axis, 1 - axis
        for v in range(dv, height - dv):
            for u in range(du, width - du):
                a, b = out[v - dv, u - du], out[v + dv, u + du]
                if out[v, u] == 0 and a > 0 and b > 0 and abs(a - b) < _CRACK * a:
                    out[v, u] = np.float32(0.5) * (a + b)
    return out


@kernel
def _unpack(piece, pieces, color, depth, valid, shrink, out, out_depth, out_valid):
    """Average colours; take the depth at the middle; valid is what is so all over."""
    height, width = out_depth.shape
    scale = np.float32(1.0 / (255.0 * shrink * shrink))
    unit, middle = np.float32(_DEPTH_UNIT_M), shrink // 2
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
