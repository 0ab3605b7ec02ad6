# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The tracker's map: Gaussians as a structure of arrays."""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from numba import prange
from numpy.typing import NDArray

from ..camera import PinholeCamera
from ..kernels.jit import CHUNKS, kernel, parallel_kernel
from ..kernels.lens import distortion_at
from ..kernels.spatial_index import VoxelIndex
from ..sensor import SensorNoise

_IN_VIEW_SIGMAS = 4.0  # a Gaussian is seen if the measured depth agrees within this many sigma_z
_IN_VIEW_FLOOR_M = 0.01  # ... plus this
# Verdict of a depth image on a point in view; 0: none.
AGREES, _LOOKED_THROUGH, EMPTY = 1, 2, 3  # the last: so all around it, and by far
_EMPTY_M, _BESIDE_PX = 0.1, 3  # of depth behind it, besides the noise; so far around it
_EMPTIED = 3  # images that must see an empty place, so that what was there is gone


Scalar = TypeVar('Scalar', bound=np.generic)


class GaussianMap:
    """Means, normals, and the viewpoints that determine Sigma_t.

    Arrays have one row for each slot; the properties show the used ones. The slot of a removed
    Gaussian is used again, its id is not.
    """

    def __init__(self, cell_m: float) -> None:
        """Start empty; `cell_m` is the size of the cells of the spatial index, metres."""
        self._cell_m = cell_m
        self.index = VoxelIndex(cell_m)
        self._means = np.empty((0, 3), np.float32)
        self._normals = np.empty((0, 3), np.float32)
        self._viewpoints = np.empty((0, 3), np.float32)
        self._flatness = np.empty(0, np.float32)
        self._ids = np.empty(0, np.int64)
        self._hosts = np.empty(0, np.int32)
        self._observers = np.empty(0, np.int32)  # keyframe of each viewpoint
        self._emptied = np.empty(0, np.uint8)  # images that saw its place empty since
        self._slot_of_id = np.empty(0, np.int32)
        self._used = 0
        self._free: list[int] = []
        self._next_id = 0

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return self._used - len(self._free)

    @property
    def means(self) -> NDArray[np.float32]:
        """(M, 3) metres, world; NaN in a free slot."""
        return self._means[: self._used]

    @property
    def normals(self) -> NDArray[np.float32]:
        """(M, 3) unit, world: minimum-scale axis n_j of Sigma_r; until mapped, of the scatter."""
        return self._normals[: self._used]

    @property
    def viewpoints(self) -> NDArray[np.float32]:
        """(M, 3) optical centre o_k of the keyframe that observed each last, metres, world."""
        return self._viewpoints[: self._used]

    @property
    def flatness(self) -> NDArray[np.float32]:
        """(M,) lambda3 / lambda2 of Sigma_r; until mapped, of the scatter."""
        return self._flatness[: self._used]

    @property
    def ids(self) -> NDArray[np.int64]:
        """(M,) ids, which never change; -1 in a free slot."""
        return self._ids[: self._used]

    @property
    def hosts(self) -> NDArray[np.int32]:
        """(M,) keyframe that spawned each."""
        return self._hosts[: self._used]

    @property
    def observers(self) -> NDArray[np.int32]:
        """(M,) keyframe of each viewpoint."""
        return self._observers[: self._used]

    @property
    def next_id(self) -> int:
        """The id of the next Gaussian: lower ones were given out."""
        return self._next_id

    def add(
        self,
        means: NDArray[np.float32],  # (N, 3) metres, world
        normals: NDArray[np.float32],  # (N, 3) unit, world
        flatness: NDArray[np.float32],  # (N,)
        viewpoint: NDArray[np.float64],  # (3,) metres, world
        host: int,
    ) -> NDArray[np.int64]:
        """Add Gaussians; return their ids (N,)."""
        ids = np.arange(self._next_id, self._next_id + len(means), dtype=np.int64)
        self._next_id += len(means)
        self._insert(ids, means, normals, flatness, viewpoint, host)
        return ids

    def restore(
        self,
        ids: NDArray[np.int64],  # (N,) unique, >= 0
        means: NDArray[np.float32],  # (N, 3) metres, world
        normals: NDArray[np.float32],  # (N, 3) unit, world
        flatness: NDArray[np.float32],  # (N,)
        viewpoints: NDArray[np.float32],  # (N, 3) metres, world
        hosts: NDArray[np.int32],  # (N,)
        next_id: int,
        observers: NDArray[np.int32] | None = None,  # (N,) keyframe of each viewpoint
    ) -> None:
        """Fill an empty map with saved Gaussians; new ids start at `next_id`.

        Without `observers` the viewpoints are of the hosts.
        """
        self._next_id = next_id
        self._insert(ids, means, normals, flatness, viewpoints, hosts)
        if observers is not None:
            self.observers[:] = observers

    def _insert(
        self,
        ids: NDArray[np.int64],
        means: NDArray[np.float32],
        normals: NDArray[np.float32],
        flatness: NDArray[np.float32],
        viewpoints: NDArray[np.floating],  # (N, 3) or (3,)
        hosts: NDArray[np.int32] | int,
    ) -> None:
        slots = self._claim(len(ids))
        held = len(self._slot_of_id)
        self._slot_of_id = _grown(self._slot_of_id, self._next_id)
        self._slot_of_id[held:] = -1
        self._slot_of_id[ids] = slots
        self._means[slots] = means
        self._normals[slots] = normals
        self._viewpoints[slots] = viewpoints
        self._flatness[slots] = flatness
        self._ids[slots] = ids
        self._hosts[slots] = self._observers[slots] = hosts
        self._emptied[slots] = 0
        self.index.insert(self._means, slots)

    def remove(self, ids: NDArray[np.int64]) -> None:
        """Remove Gaussians; unknown ids and those already removed are ignored."""
        slots = np.unique(self._slots(ids))
        self.index.remove(self._means, slots)
        self._slot_of_id[self._ids[slots]] = -1
        self._ids[slots] = -1
        self._means[slots] = np.nan
        self._free.extend(slots.tolist())

    def reshape(
        self,
        ids: NDArray[np.int64],  # (N,) unique
        normals: NDArray[np.float32],  # (N, 3) unit, world
        flatness: NDArray[np.float32],  # (N,)
    ) -> None:
        """Update normals and flatness from the mapper's Sigma_r; removed ids are ignored.

        A normal moves half the way to the new axis: the axes of Sigma_r fluctuate while it is
        optimised, and taken as they are they cost the tracker 5 %. The sign of an axis does not
        matter.
        """
        alive = self.alive(ids)
        slots, normals = self._slot_of_id[ids[alive]], normals[alive]
        before = self._normals[slots]
        facing = np.einsum('ij,ij->i', normals, before)
        between = before + np.where(facing[:, None] < 0, -normals, normals)
        self._normals[slots] = between / np.linalg.norm(between, axis=1, keepdims=True)
        self._flatness[slots] = flatness[alive]

    def move(self, motions: NDArray[np.float64]) -> None:
        """Move each Gaussian with its host, and each viewpoint with the keyframe it is of.

        `motions` (K, 4, 4) is, for each keyframe, from where the world had it to where it is now.
        """
        _move(
            self.means, self.normals, self.viewpoints, self.hosts,
            self._observers[: self._used], np.ascontiguousarray(motions),
        )  # fmt: skip
        self.index = VoxelIndex(self._cell_m)
        self.index.insert(self._means, np.flatnonzero(self.ids >= 0).astype(np.int32))

    def alive(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return (N,) whether each id is of a Gaussian in the map."""
        known = (ids >= 0) & (ids < self._next_id)
        known[known] = self._slot_of_id[ids[known]] >= 0
        return known

    def of(self, ids: NDArray[np.int64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return means (K, 3), metres, and normals (K, 3) of the ids that are in the map."""
        slots = self._slots(ids)
        return self._means[slots], self._normals[slots]

    def _slots(self, ids: NDArray[np.int64]) -> NDArray[np.int32]:
        return np.asarray(self._slot_of_id[ids[self.alive(ids)]])

    def _claim(self, n: int) -> NDArray[np.int32]:
        """Return slots (n,) for new Gaussians: free ones first, then new ones."""
        reused = [self._free.pop() for _ in range(min(n, len(self._free)))]
        fresh = range(self._used, self._used + n - len(reused))
        self._used = fresh.stop
        for name in (
            '_means',
            '_normals',
            '_viewpoints',
            '_flatness',
            '_ids',
            '_hosts',
            '_observers',
            '_emptied',
        ):
            setattr(self, name, _grown(getattr(self, name), self._used))
        return np.array([*reused, *fresh], dtype=np.int32)

    def tracking_covariances(
        self, slots: NDArray[np.int32], sensor: SensorNoise, anchor_px: float, focal_px: float
    ) -> NDArray[np.float64]:
        """Return Sigma_t,j = S(u_j, z_j; p), (N, 3, 3) square metres, world."""
        rays = (self._means[slots] - self._viewpoints[slots]).astype(np.float64)
        ranges = np.linalg.norm(rays, axis=1)
        return sensor.covariance(rays / ranges[:, None], ranges, anchor_px, focal_px)

    def refresh(
        self,
        T_world_cam: NDArray[np.float64],
        depth_m: NDArray[np.float32],
        camera: PinholeCamera,
        sensor: SensorNoise,
        keyframe: int,
    ) -> float:
        """Make T's optical centre the viewpoint of the Gaussians that a depth image (H, W) sees.

        Sigma_t is then the noise of the most recent observation (paper, tracking covariance), of
        this keyframe. Return the `agreement`.
        """
        verdicts = verdicts_on(self.means, T_world_cam, depth_m, camera, sensor)
        seen = verdicts == AGREES
        self.viewpoints[seen] = T_world_cam[:3, 3]
        self._observers[: self._used][seen] = keyframe
        return _agreement(verdicts)

    def notice(
        self,
        T_world_cam: NDArray[np.float64],
        depth_m: NDArray[np.float32],
        camera: PinholeCamera,
        sensor: SensorNoise,
    ) -> None:
        """Count for each Gaussian how many depth images (H, W) have seen its place empty since."""
        verdicts = verdicts_on(self.means, T_world_cam, depth_m, camera, sensor)
        emptied = self._emptied[: self._used]
        emptied[verdicts == AGREES] = 0
        emptied += (verdicts == EMPTY) & (emptied < _EMPTIED)

    def remove_gone(self, first_host: int) -> NDArray[np.int64]:
        """Remove what some images did not see any more where it was; return its ids (N,).

        Of Gaussians that keyframes before `first_host` spawned it may be the map that is wrong.
        """
        gone = (self._emptied[: self._used] >= _EMPTIED) & (self.hosts >= first_host)
        ids = self.ids[gone & (self.ids >= 0)]
        self.remove(ids)
        return ids

    def agreement(
        self,
        T_world_cam: NDArray[np.float64],
        depth_m: NDArray[np.float32],
        camera: PinholeCamera,
        sensor: SensorNoise,
    ) -> float:
        """Return the share of the Gaussians in view that a depth image (H, W) from T sees.

        Those behind the measured depth are hidden and do not count. Those in front of it should
        have been seen: if there are many, the pose is wrong, however well the frame fits the rest
        of the map.
        """
        return _agreement(verdicts_on(self.means, T_world_cam, depth_m, camera, sensor))


def verdicts_on(
    points: NDArray[np.float32],
    T: NDArray[np.float64],
    depth_m: NDArray[np.float32],
    camera: PinholeCamera,
    sensor: SensorNoise,
) -> NDArray[np.uint8]:
    """Return (N,) what a depth image (H, W) from T (4, 4) says of points (N, 3) in the world."""
    verdicts = np.zeros(len(points), np.uint8)
    _compare(points, T, depth_m, camera.parameters, sensor.a_m, sensor.b_per_m, verdicts)
    return verdicts


def _agreement(verdicts: NDArray[np.uint8]) -> float:
    seen = int(np.count_nonzero(verdicts == AGREES))
    looked_through = int(np.count_nonzero(verdicts >= _LOOKED_THROUGH))
    return seen / max(seen + looked_through, 1)


def _grown(array: NDArray[Scalar], needed: int) -> NDArray[Scalar]:
    """Return `array` with room for `needed` rows, at least doubled: appending costs O(1) each."""
    if needed <= len(array):
        return array
    grown = np.empty((max(needed, 2 * len(array), 1 << 14), *array.shape[1:]), array.dtype)
    grown[: len(array)] = array
    return grown


@parallel_kernel
def _compare(means, T, depth, camera, noise_a, noise_b, verdicts):
    """Write into `verdicts` (M,) uint8, zeros before, what a depth image says of each Gaussian.

    `means` (M, 3) metres, world, NaN in a free slot; `T` (4, 4) T_world_cam; `depth` (H, W)
    metres; `camera` (12,) of `PinholeCamera.parameters`; noise in metres and 1/metre.
    """
    height, width = depth.shape
    n = means.shape[0]
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    for chunk in prange(CHUNKS):
        for j in range(chunk * n // CHUNKS, (chunk + 1) * n // CHUNKS):
            dx, dy, dz = means[j, 0] - T[0, 3], means[j, 1] - T[1, 3], means[j, 2] - T[2, 3]
            z = T[0, 2] * dx + T[1, 2] * dy + T[2, 2] * dz
            if not z > 0.1:  # also the NaN of a free slot
                continue
            x = (T[0, 0] * dx + T[1, 0] * dy + T[2, 0] * dz) / z
            y = (T[0, 1] * dx + T[1, 1] * dy + T[2, 1] * dz) / z
            if abs(x) * fx > 2 * width or abs(y) * fy > 2 * height:  # outside the lens model
                continue
            radial, shift_x, shift_y = distortion_at(camera, x, y)
            u = math.floor(fx * (x * radial + shift_x) + cx + 0.5)
            v = math.floor(fy * (y * radial + shift_y) + cy + 0.5)
            if u < 0 or v < 0 or u >= width or v >= height:
                continue
            measured = depth[v, u]
            tolerance = _IN_VIEW_SIGMAS * (noise_a + noise_b * z * z) + _IN_VIEW_FLOOR_M
            if abs(measured - z) <= tolerance:
                verdicts[j] = AGREES
            elif measured > z:
                clear = z + tolerance + _EMPTY_M
                empty = measured > clear and _is_empty(depth, u, v, clear)
                verdicts[j] = EMPTY if empty else _LOOKED_THROUGH


@kernel
def _is_empty(depth, u, v, clear):
    """Return whether no `depth` (H, W) at or around a pixel is less than `clear`, metres."""
    height, width = depth.shape
    if not (_BESIDE_PX <= u < width - _BESIDE_PX and _BESIDE_PX <= v < height - _BESIDE_PX):
        return False
    for y in range(v - _BESIDE_PX, v + _BESIDE_PX + 1, _BESIDE_PX):
        for x in range(u - _BESIDE_PX, u + _BESIDE_PX + 1, _BESIDE_PX):
            if 0.0 < depth[y, x] <= clear:
                return False
    return True


@kernel
def _move(means, normals, viewpoints, hosts, observers, motions):
    """Move `means`, `normals` and `viewpoints` (M, 3) in place.

    `hosts` and `observers` (M,) are rows of `motions` (K, 4, 4), of means and of viewpoints.
    """
    for j in range(means.shape[0]):
        T, V = motions[hosts[j]], motions[observers[j]]
        x, y, z = means[j, 0], means[j, 1], means[j, 2]
        a, b, c = normals[j, 0], normals[j, 1], normals[j, 2]
        u, v, w = viewpoints[j, 0], viewpoints[j, 1], viewpoints[j, 2]
        for k in range(3):
            means[j, k] = T[k, 0] * x + T[k, 1] * y + T[k, 2] * z + T[k, 3]
            normals[j, k] = T[k, 0] * a + T[k, 1] * b + T[k, 2] * c
            viewpoints[j, k] = V[k, 0] * u + V[k, 1] * v + V[k, 2] * w + V[k, 3]
