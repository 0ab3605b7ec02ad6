# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The map: Gaussians as a structure of arrays, with what the tracker owns of each."""

from __future__ import annotations

import math

import numpy as np
from numba import prange
from numpy.typing import NDArray

from ..camera import PinholeCamera
from ..kernels.jit import CHUNKS, parallel_kernel
from ..kernels.lens import distortion_at
from ..kernels.spatial_index import VoxelIndex
from ..sensor import SensorNoise

_IN_VIEW_SIGMAS = 4.0  # a Gaussian is seen where the measured depth agrees with it to this
_IN_VIEW_FLOOR_M = 0.01
_AGREES, _LOOKED_THROUGH = 1, 2  # what a depth image says of a Gaussian in view; 0: nothing


class GaussianMap:
    """Means, normals and the viewpoints from which Sigma_t follows.

    Arrays have one row a slot; the properties show the used ones. The slot of a removed Gaussian
    is used again, its id never.
    """

    def __init__(self, cell_m: float) -> None:
        """Start empty; `cell_m` is the cell of the spatial index."""
        self.index = VoxelIndex(cell_m)
        self._means = np.empty((0, 3), np.float32)
        self._normals = np.empty((0, 3), np.float32)
        self._viewpoints = np.empty((0, 3), np.float32)
        self._flatness = np.empty(0, np.float32)
        self._ids = np.empty(0, np.int64)
        self._hosts = np.empty(0, np.int32)
        self._slot_of_id = np.empty(0, np.int32)
        self._used = 0
        self._free: list[int] = []
        self._next_id = 0

    def __len__(self) -> int:
        """Count the Gaussians alive."""
        return self._used - len(self._free)

    @property
    def means(self) -> NDArray[np.float32]:
        """(M, 3) metres, world; NaN in a free slot."""
        return self._means[: self._used]

    @property
    def normals(self) -> NDArray[np.float32]:
        """(M, 3) unit, world: minimum-scale axis n_j of Sigma_r, of the scatter until mapped."""
        return self._normals[: self._used]

    @property
    def viewpoints(self) -> NDArray[np.float32]:
        """(M, 3) optical centre o_k of the keyframe that observed each last, metres, world."""
        return self._viewpoints[: self._used]

    @property
    def flatness(self) -> NDArray[np.float32]:
        """(M,) lambda3 / lambda2 of Sigma_r (of the scatter until mapped)."""
        return self._flatness[: self._used]

    @property
    def ids(self) -> NDArray[np.int64]:
        """(M,) identity over the map's whole life, -1 in a free slot."""
        return self._ids[: self._used]

    @property
    def hosts(self) -> NDArray[np.int32]:
        """(M,) keyframe that spawned each."""
        return self._hosts[: self._used]

    def add(
        self,
        means: NDArray[np.float32],  # (N, 3) metres, world
        normals: NDArray[np.float32],  # (N, 3) unit, world
        flatness: NDArray[np.float32],  # (N,)
        viewpoint: NDArray,  # (3,) metres, world
        host: int,
    ) -> NDArray[np.int64]:
        """Spawn Gaussians; returns their ids."""
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
    ) -> None:
        """Fill an empty map with Gaussians of an earlier life; new ids begin at `next_id`."""
        self._next_id = next_id
        self._insert(ids, means, normals, flatness, viewpoints, hosts)

    def _insert(
        self, ids: NDArray, means: NDArray, normals: NDArray, flatness: NDArray,
        viewpoints: NDArray, hosts: NDArray | int,
    ) -> None:  # fmt: skip
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
        self._hosts[slots] = hosts
        self.index.insert(self._means, slots)

    def remove(self, ids: NDArray[np.int64]) -> None:
        """Take Gaussians out; unknown ids and those gone already are passed over."""
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
        """Take over what the mapper made of Sigma_r; ids that are not alive are passed over.

        A normal goes half the way to it: Sigma_r's axes wander while it is optimised, and taken as
        they are they cost the tracker 5 %. Of an axis either direction is as good.
        """
        alive = self.alive(ids)
        slots, normals = self._slot_of_id[ids[alive]], normals[alive]
        before = self._normals[slots]
        facing = np.einsum('ij,ij->i', normals, before)
        between = before + np.where(facing[:, None] < 0, -normals, normals)
        self._normals[slots] = between / np.linalg.norm(between, axis=1, keepdims=True)
        self._flatness[slots] = flatness[alive]

    def alive(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Tell which ids are of Gaussians in the map."""
        known = (ids >= 0) & (ids < self._next_id)
        known[known] = self._slot_of_id[ids[known]] >= 0
        return known

    def of(self, ids: NDArray[np.int64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return means (N, 3) and normals (N, 3) of those alive."""
        slots = self._slots(ids)
        return self._means[slots], self._normals[slots]

    def _slots(self, ids: NDArray[np.int64]) -> NDArray[np.int32]:
        return np.asarray(self._slot_of_id[ids[self.alive(ids)]])

    def _claim(self, n: int) -> NDArray[np.int32]:
        """Slots for n Gaussians: free ones first, then new ones."""
        reused = [self._free.pop() for _ in range(min(n, len(self._free)))]
        fresh = range(self._used, self._used + n - len(reused))
        self._used = fresh.stop
        for name in ('_means', '_normals', '_viewpoints', '_flatness', '_ids', '_hosts'):
            setattr(self, name, _grown(getattr(self, name), self._used))
        return np.array([*reused, *fresh], dtype=np.int32)

    def tracking_covariances(
        self, slots: NDArray[np.int32], sensor: SensorNoise, anchor_px: float, focal_px: float
    ) -> NDArray[np.float64]:
        """Sigma_t,j = S(u_j, z_j; p) from the last viewpoint, (N, 3, 3) square metres, world."""
        rays = (self._means[slots] - self._viewpoints[slots]).astype(np.float64)
        ranges = np.linalg.norm(rays, axis=1)
        return sensor.covariance(rays / ranges[:, None], ranges, anchor_px, focal_px)

    def refresh(
        self,
        T_world_cam: NDArray[np.float64],
        depth_m: NDArray[np.float32],
        camera: PinholeCamera,
        sensor: SensorNoise,
    ) -> int:
        """Take T's optical centre as viewpoint of the Gaussians that the depth image sees.

        Sigma_t is then the noise of the most recent observation (paper, tracking covariance).
        Returns how many were seen.
        """
        seen = self._compared(T_world_cam, depth_m, camera, sensor) == _AGREES
        self.viewpoints[seen] = T_world_cam[:3, 3]
        return int(np.count_nonzero(seen))

    def agreement(
        self,
        T_world_cam: NDArray[np.float64],
        depth_m: NDArray[np.float32],
        camera: PinholeCamera,
        sensor: SensorNoise,
    ) -> float:
        """Share of the Gaussians in view that a depth image from T sees, of those it should see.

        It should not see those behind what it measured. One that it looks through tells that the
        camera is not there, however well the frame fits to what else the map holds.
        """
        verdicts = self._compared(T_world_cam, depth_m, camera, sensor)
        seen = int(np.count_nonzero(verdicts == _AGREES))
        looked_through = int(np.count_nonzero(verdicts == _LOOKED_THROUGH))
        return seen / max(seen + looked_through, 1)

    def _compared(
        self, T: NDArray, depth_m: NDArray, camera: PinholeCamera, sensor: SensorNoise
    ) -> NDArray[np.uint8]:
        verdicts = np.zeros(self._used, np.uint8)
        _compare(
            self.means, T, depth_m, camera.parameters, sensor.a_m, sensor.b_per_m, verdicts
        )  # fmt: skip
        return verdicts


def _grown(array: NDArray, needed: int) -> NDArray:
    """Return `array` with room for `needed` rows, at least doubled: appending costs O(1) each."""
    if needed <= len(array):
        return array
    grown = np.empty((max(needed, 2 * len(array), 1 << 14), *array.shape[1:]), array.dtype)
    grown[: len(array)] = array
    return grown


@parallel_kernel
def _compare(means, T, depth, camera, noise_a, noise_b, verdicts):
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
            if abs(x) * fx > 2 * width or abs(y) * fy > 2 * height:  # where the lens model holds
                continue
            radial, shift_x, shift_y = distortion_at(camera, x, y)
            u = math.floor(fx * (x * radial + shift_x) + cx + 0.5)
            v = math.floor(fy * (y * radial + shift_y) + cy + 0.5)
            if u < 0 or v < 0 or u >= width or v >= height:
                continue
            measured = depth[v, u]
            tolerance = _IN_VIEW_SIGMAS * (noise_a + noise_b * z * z) + _IN_VIEW_FLOOR_M
            if abs(measured - z) <= tolerance:
                verdicts[j] = _AGREES
            elif measured > z:
                verdicts[j] = _LOOKED_THROUGH
