# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Ray caster for scenes of textured boxes and spheres."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core.camera import PinholeCamera
from .raycast_kernels import BOX, FAR, NEAR_M, SPHERE, cast_rolling_tiles, cast_tiles
from .textures import Textures

_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))  # (8, 3)
_EDGES = np.array([(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit])  # (12, 2)


@dataclass(frozen=True)
class Scene:
    """P primitives as arrays.

    A box around the camera is a room: it is seen from inside, and everything must be inside it.
    """

    kinds: NDArray[np.int64]  # (P,) BOX or SPHERE
    centres: NDArray[np.float64]  # (P, 3) metres, world
    halves: NDArray[np.float64]  # (P, 3) half extents, metres; of a sphere its radius, three times
    R_world_local: NDArray[np.float64]  # (P, 3, 3)
    textures: NDArray[np.int64]  # (P,) index into `TEXTURE_NAMES`, -1 = plain
    mappings: NDArray[np.float32]  # (P, 3) texture repeats per metre, offset u, offset v
    tints: NDArray[np.float32]  # (P, 3) albedo, RGB
    lamp: NDArray[np.float32]  # (3,) position, metres, world
    ambient: float  # share of the light that is ambient

    def clearance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distance (N,) of points (N, 3) to the nearest surface, metres."""
        offsets = points[:, None] - self.centres
        local = np.abs(np.einsum('pji,npj->npi', self.R_world_local, offsets)) - self.halves
        outside = np.linalg.norm(np.maximum(local, 0), axis=2)
        box = np.where(outside > 0, outside, -local.max(axis=2))
        sphere = np.abs(np.linalg.norm(offsets, axis=2) - self.halves[:, 0])
        return np.where(self.kinds == SPHERE, sphere, box).min(axis=1)

    def beside(self, other: Scene) -> Scene:
        """Return it with the primitives of another scene, in its own light."""
        names = ('kinds', 'centres', 'halves', 'R_world_local', 'textures', 'mappings', 'tints')
        both: dict[str, Any] = {
            k: np.concatenate([getattr(self, k), getattr(other, k)]) for k in names
        }
        return replace(self, **both)


@dataclass(frozen=True)
class SceneView:
    """What a camera sees of a scene from one pose, before lens and noise."""

    depth_m: NDArray[np.float32]  # (H, W) along the optical axis, 0 = nothing hit
    cosine: NDArray[np.float32]  # (H, W) between the ray and the surface's normal
    radiance: NDArray[np.float32]  # (H, W, 3) RGB, grey levels at gain 1; (0, 0, 3) if unwanted


class Primitives(NamedTuple):
    """The kernels' input: the P visible primitives from front to back, in their own frames."""

    kinds: NDArray[np.int64]  # (P,)
    origins: NDArray[np.float32]  # (P, 3) camera centre
    rotations: NDArray[np.float32]  # (P, 3, 3) camera to primitive
    halves: NDArray[np.float32]  # (P, 3)
    nearest: NDArray[np.float32]  # (P,) least depth, metres
    bounds: NDArray[np.int64]  # (P, 4) range of pixels, x0 x1 y0 y1
    textures: NDArray[np.int64]  # (P,)
    mappings: NDArray[np.float32]  # (P, 3)
    tints: NDArray[np.float32]  # (P, 3)
    lamps: NDArray[np.float32]  # (P, 3) position of the lamp


class RowMotion(NamedTuple):
    """Where the camera of each row is, in the camera at the middle of the readout."""

    turns: NDArray[np.float32]  # (H, 3, 3) rotation from the row's camera
    offsets: NDArray[np.float32]  # (H, 3) metres


def cast(
    scene: Scene,
    textures: Textures,
    camera: PinholeCamera,
    T_world_cam: NDArray[np.float64],
    *,
    color: bool,
    T_world_rows: NDArray[np.float64] | None = None,
) -> SceneView:
    """Render depth, and colour if wanted, for a camera without distortion at a pose (4, 4).

    With a rolling shutter `T_world_rows` (H, 4, 4) are the poses of the rows. Depth is then that
    in the row's camera.
    """
    height, width = camera.height, camera.width
    view = SceneView(
        np.empty((height, width), np.float32),
        np.empty((height, width), np.float32),
        np.empty((height, width, 3) if color else (0, 0, 3), np.float32),
    )
    rays = (
        ((np.arange(width) - camera.cx) / camera.fx).astype(np.float32),
        ((np.arange(height) - camera.cy) / camera.fy).astype(np.float32),
    )
    prims = _visible(scene, camera, T_world_cam, T_world_rows)
    light = np.float32(1 / camera.focal), np.float32(scene.ambient)
    planes = view.depth_m, view.cosine, view.radiance
    if T_world_rows is None:
        cast_tiles(prims, rays, *light, textures, planes)
    else:
        T_cam_rows = (np.linalg.inv(T_world_cam) @ T_world_rows).astype(np.float32)
        rows = RowMotion(T_cam_rows[:, :3, :3].copy(), T_cam_rows[:, :3, 3].copy())
        cast_rolling_tiles(prims, rows, rays, *light, textures, planes)
    return view


def _visible(
    scene: Scene,
    camera: PinholeCamera,
    T_world_cam: NDArray[np.float64],
    T_world_rows: NDArray[np.float64] | None,
) -> Primitives:
    """Transform camera and lamp to each primitive's frame, drop invisible ones, sort by depth."""
    R_local_world = scene.R_world_local.transpose(0, 2, 1)
    origins = np.einsum('pij,pj->pi', R_local_world, T_world_cam[:3, 3] - scene.centres)
    lamps = np.einsum('pij,pj->pi', R_local_world, scene.lamp - scene.centres)
    rotations = R_local_world @ T_world_cam[:3, :3]
    room = (scene.kinds == BOX) & (np.abs(origins) < scene.halves).all(axis=1)
    nearest, bounds = _screen_bounds(origins, rotations, scene.halves, room, camera)
    for T in () if T_world_rows is None else T_world_rows[[0, -1]]:
        other = np.einsum('pij,pj->pi', R_local_world, T[:3, 3] - scene.centres)
        least, box = _screen_bounds(other, R_local_world @ T[:3, :3], scene.halves, room, camera)
        nearest = np.minimum(nearest, least)
        bounds[:, ::2] = np.minimum(bounds[:, ::2], box[:, ::2] - 1)
        bounds[:, 1::2] = np.maximum(bounds[:, 1::2], box[:, 1::2] + 1)
    order = np.argsort(nearest, kind='stable')  # front to back: most tiles stop early
    order = order[bounds[order, 0] <= bounds[order, 1]]
    return Primitives(
        scene.kinds[order],
        origins[order].astype(np.float32),
        rotations[order].astype(np.float32),
        scene.halves[order].astype(np.float32),
        nearest[order].astype(np.float32),
        bounds[order],
        scene.textures[order],
        scene.mappings[order],
        scene.tints[order],
        lamps[order].astype(np.float32),
    )


def _screen_bounds(
    origins: NDArray[np.float64],
    rotations: NDArray[np.float64],
    halves: NDArray[np.float64],
    room: NDArray[np.bool_],
    camera: PinholeCamera,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return least depth (P,) and range of pixels (P, 4), x0 x1 y0 y1, of the primitives' boxes.

    `origins` (P, 3), `rotations` (P, 3, 3) and `halves` (P, 3) as in `Primitives`; `room` (P,)
    tells which boxes hold the camera.
    """
    corners = _CORNERS * halves[:, None] - origins[:, None]
    corners = np.einsum('pji,pcj->pci', rotations, corners)  # (P, 8, 3) camera
    a, b = corners[:, _EDGES[:, 0]], corners[:, _EDGES[:, 1]]
    crossing = (a[..., 2] < NEAR_M) != (b[..., 2] < NEAR_M)
    share = (NEAR_M - a[..., 2]) / np.where(crossing, b[..., 2] - a[..., 2], 1.0)
    points = np.concatenate([corners, a + share[..., None] * (b - a)], axis=1)
    valid = np.concatenate([corners[..., 2] >= NEAR_M, crossing], axis=1)
    z = np.maximum(points[..., 2], NEAR_M)
    u = camera.fx * points[..., 0] / z + camera.cx
    v = camera.fy * points[..., 1] / z + camera.cy
    lowest = [np.where(valid, w, 1e6).min(axis=1) for w in (u, v)]
    highest = [np.where(valid, w, -1e6).max(axis=1) for w in (u, v)]
    bounds = np.stack([lowest[0], highest[0], lowest[1], highest[1]], axis=1)
    bounds = np.clip(np.floor(bounds) + np.array([0, 1, 0, 1]), -1e6, 1e6).astype(np.int64)
    bounds[room] = 0, camera.width, 0, camera.height
    # A room is behind everything inside it: it is last, and traced only by rays that hit nothing.
    return np.where(room, float(FAR), np.maximum(corners[..., 2].min(axis=1), 0)), bounds
