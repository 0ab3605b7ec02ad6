# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""New Gaussians: where the map lacks some, and their first parameters."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..config.stages import MappingConfig
from ..render.renderer import Rendering, View
from .exposure import Exposure
from .rectification import Images
from .splats import PLANES, SH_C0, Splats

_MIN_COSINE = 0.3  # of the angle between normal and ray: limits the size of discs seen at a slant
_NEIGHBOUR_PX = 4  # distance of the pixels whose difference gives the normal
_EDGE = 0.1  # share of the depth: a larger difference is a depth edge
_FILL_SHRINK = 4  # holes are filled at a quarter of the resolution
_NEARER, _NEARER_M = 0.93, 0.02  # depth measured in front of the map: share of it, and metres


@dataclass(frozen=True)
class Surface:
    """Points with normals, in the world."""

    points: NDArray[np.float32]  # (N, 3) metres
    normals: NDArray[np.float32]  # (N, 3) unit
    measured: NDArray[np.bool_]  # (N,) whether the depth was measured, not taken from a neighbour


def discs(
    surface: Surface,
    spacing_px: float,
    images: Images,
    view: View,
    exposure: Exposure,
    config: MappingConfig,
) -> Splats:
    """Return flat Gaussians on a surface, wide enough for neighbours `spacing_px` apart to meet.

    Their third axis is the normal, their colour the mean of the image around them.
    """
    pixels, z = _pixels(surface.points, view)
    towards = view.T_world_cam[:3, 3] - surface.points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    cosine = np.abs(np.einsum('ij,ij->i', surface.normals, towards)).clip(_MIN_COSINE, 1)
    focal = 0.5 * (view.fx + view.fy)
    width = config.spawn_scale * spacing_px * z / focal / np.sqrt(cosine)
    planes = np.zeros((len(PLANES), len(z)), np.float32)
    planes[0:3] = surface.points.T
    planes[3:5] = np.log(width)
    planes[5] = np.log(config.spawn_flatness * width)
    planes[6:10] = _turning_z_to(surface.normals)
    opacity = np.where(surface.measured, config.spawn_opacity, config.fill_opacity)
    planes[10] = np.log(opacity / (1 - opacity))
    seen = _colors_at(images.color, pixels, spacing_px)
    planes[11:14] = ((seen - exposure.offset) / exposure.gain - 0.5).T / SH_C0
    return Splats(planes)


def lacking(
    images: Images,
    rendering: Rendering,
    shrink: int,
    valid: NDArray[np.bool_],  # (H, W)
    spawned: Surface,
    view: View,
    config: MappingConfig,
) -> Surface:
    """Return the surface at the points of a grid where the map shows nothing or is far behind.

    The rendering has one pixel for each shrink x shrink. Cells of the grid with a point of
    `spawned` are left out. Depth holes are filled from the nearest pixel with depth; without any
    depth the result is empty.
    """
    stride = config.spawn_stride_px
    depth_m = images.depth_m
    filled = _filled(depth_m)
    height, width = (size // stride * stride for size in depth_m.shape)
    v, u = (
        k.ravel() for k in np.mgrid[stride // 2 : height : stride, stride // 2 : width : stride]
    )
    rows, columns = rendering.depth.shape  # an image of odd size has one more
    at = np.minimum(v // shrink, rows - 1), np.minimum(u // shrink, columns - 1)
    T = rendering.transmittance[at]
    shown_m = rendering.depth[at] / np.maximum(1 - T, 1e-3)
    measured = depth_m[v, u] > 0
    nearer = measured & (depth_m[v, u] < _NEARER * shown_m - _NEARER_M)
    lacks = ((T > config.spawn_transmittance) | nearer) & valid[v, u] & (filled[v, u] > 0)
    taken = np.zeros((height // stride, width // stride), np.bool_)
    cells = _pixels(spawned.points, view)[0].astype(int) // stride
    inside = np.all((cells >= 0) & (cells < taken.shape[::-1]), axis=1)
    taken[cells[inside, 1], cells[inside, 0]] = True
    lacks &= ~taken.ravel()
    u, v, measured = u[lacks], v[lacks], measured[lacks]
    points, normals = _surface_at(filled, measured, u, v, view)
    T_world_cam = view.T_world_cam
    return Surface(
        se3.transform(T_world_cam, points).astype(np.float32),
        (normals @ T_world_cam[:3, :3].T).astype(np.float32),
        measured,
    )


def _pixels(
    points: NDArray[np.float32], view: View
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return pixels (N, 2) and depths (N,), metres, of points (N, 3) in the world."""
    T_cam_world = se3.inverse(view.T_world_cam)
    p_cam = se3.transform(T_cam_world, points)
    z = np.maximum(p_cam[:, 2], 1e-3)
    return p_cam[:, :2] / z[:, None] * (view.fx, view.fy) + (view.cx, view.cy), z


def _filled(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return depth (H, W), metres, with holes filled from the nearest pixel with depth, if any."""
    if not (depth_m <= 0).any():
        return depth_m
    block = np.ones((_FILL_SHRINK, _FILL_SHRINK), np.uint8)
    farthest = cv2.dilate(depth_m, block, anchor=(0, 0))  # of the block that starts at each pixel
    small = np.asarray(farthest)[::_FILL_SHRINK, ::_FILL_SHRINK]
    holes = (small <= 0).astype(np.uint8)
    if holes.all():
        return depth_m
    _, labels = cv2.distanceTransformWithLabels(
        holes, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    depth_of_label = np.zeros(int(labels.max()) + 1, np.float32)
    depth_of_label[labels[holes == 0]] = small[holes == 0]
    nearest = depth_of_label[labels]
    v, u = (np.arange(size) // _FILL_SHRINK for size in depth_m.shape)
    return np.where(depth_m > 0, depth_m, nearest[v[:, None], u])


def _surface_at(
    depth_m: NDArray[np.float32],  # (H, W) filled
    measured: NDArray[np.bool_],  # (N,)
    u: NDArray[np.int64],  # (N,)
    v: NDArray[np.int64],  # (N,)
    view: View,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points and normals (N, 3), camera frame; filled points and edges face the camera."""
    height, width = depth_m.shape

    def point(u: NDArray[np.int64], v: NDArray[np.int64]) -> NDArray[np.float64]:
        z = depth_m[v, u].astype(np.float64)
        return np.stack([(u - view.cx) / view.fx * z, (v - view.cy) / view.fy * z, z], axis=1)

    step = _NEIGHBOUR_PX
    along_x = point(np.minimum(u + step, width - 1), v) - point(np.maximum(u - step, 0), v)
    along_y = point(u, np.minimum(v + step, height - 1)) - point(u, np.maximum(v - step, 0))
    points = point(u, v)
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    normals = np.cross(along_y, along_x)
    norms = np.linalg.norm(normals, axis=1, keepdims=True)
    edge = np.maximum(np.abs(along_x[:, 2]), np.abs(along_y[:, 2])) > _EDGE * points[:, 2]
    bad = edge | ~measured | (norms[:, 0] < 1e-12)
    return points, np.where(bad[:, None], -rays, normals / np.maximum(norms, 1e-12))


def _turning_z_to(normals: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return (4, N) quaternions wxyz, shortest rotations of (0, 0, 1) to unit normals (N, 3)."""
    x, y, z = normals.astype(np.float64).T
    quats = np.stack([1 + z, -y, x, np.zeros_like(x)])
    quats[:, z < -1 + 1e-9] = np.array([0.0, 1.0, 0.0, 0.0])[:, None]  # half a turn about x
    return np.asarray(quats / np.linalg.norm(quats, axis=0))


def _colors_at(
    color: NDArray[np.uint8], pixels: NDArray[np.float64], spacing_px: float
) -> NDArray[np.float32]:
    """Return colours (N, 3) from 0 to 1: means over `spacing_px` around pixels (N, 2)."""
    side = max(1, round(spacing_px) | 1)
    mean = np.asarray(cv2.blur(color, (side, side)))
    height, width = color.shape[:2]
    u = np.round(pixels[:, 0]).astype(int).clip(0, width - 1)
    v = np.round(pixels[:, 1]).astype(int).clip(0, height - 1)
    return mean[v, u].astype(np.float32) / np.float32(255.0)
