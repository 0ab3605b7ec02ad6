# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""KLT corners anchored on the tangent planes of Gaussians (paper, image residual)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..camera import PinholeCamera
from ..config.stages import LandmarkConfig
from ..kernels.jit import kernel
from ..keyframe import Sightings
from ..sensor import SensorNoise
from .corners import corners
from .factors import PointFactors, Targets, covariances_along_rays, observed_from
from .gaussian_map import GaussianMap
from .patches import Patches, cut

_FLAT_SLOPE = 0.03  # largest depth range of 3x3 pixels on one surface, share of depth ...
_FLAT_NOISE = 8.0  # ... plus this many sigma_z
_SPARE = 3  # corners searched for each one wanted: many have no depth
_NEAREST_M = 0.05  # nearer landmarks have no meaningful projection
_CONTRADICTS = 4.0  # standard deviations between a measured and an expected depth ...
_ROUGH_M = 0.01  # ... plus this, metres
_MIN_NEIGHBOURS = 6  # with depth, of the 3x3 pixels
_KLT_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 12, 0.03)


@dataclass(frozen=True)
class Landmarks:
    """Tracked corners: their positions in the last image and in the world."""

    pixels: NDArray[np.float32]  # (L, 2) distorted, in the last image
    targets: Targets  # l and the anchor's Sigma_t
    patches: Patches  # of the images in which they were detected
    ids: NDArray[np.int64]  # (L,) which never change; -1: not given yet

    @classmethod
    def none(cls) -> Landmarks:
        """Return an empty set."""
        empty = np.empty((0, 3), np.float32)
        targets = Targets(empty, empty, empty[:, 0], empty[:, 0], np.empty(0, np.int32))
        return cls(empty[:, :2], targets, Patches.none(), np.empty(0, np.int64))

    def __len__(self) -> int:
        """Return the number of landmarks."""
        return len(self.pixels)

    def __getitem__(self, keep: NDArray[np.bool_] | NDArray[np.int64]) -> Landmarks:
        """Return the landmarks of a mask or of indices."""
        return Landmarks(self.pixels[keep], self.targets[keep], self.patches[keep], self.ids[keep])

    def joined(self, other: Landmarks) -> Landmarks:
        """Return both sets together."""
        return Landmarks(
            np.concatenate([self.pixels, other.pixels]),
            self.targets.joined(other.targets),
            self.patches.joined(other.patches),
            np.concatenate([self.ids, other.ids]),
        )

    def moved(self, motions: NDArray[np.float64], T_camera: NDArray[np.float64]) -> Landmarks:
        """Return the landmarks moved with their hosts by `motions` (K, 4, 4).

        Those that were measured between keyframes go with the camera, by `T_camera` (4, 4).
        """
        t = self.targets
        T = np.concatenate([motions, T_camera[None]])[t.hosts]  # of host -1 it is the last
        points = np.einsum('nij,nj->ni', T[:, :3, :3], t.points) + T[:, :3, 3]
        targets = replace(
            t, points=points.astype(np.float32),
            axes=np.einsum('nij,nj->ni', T[:, :3, :3], t.axes).astype(np.float32),
        )  # fmt: skip
        steps = np.einsum('nij,nkj->nki', T[:, :3, :3], self.patches.steps).astype(np.float32)
        return replace(self, targets=targets, patches=replace(self.patches, steps=steps))

    def seen_from(self, T_world_cam: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the landmarks (L, 3) in the frame of a camera, metres."""
        return (self.targets.points - T_world_cam[:3, 3]) @ T_world_cam[:3, :3]

    def followed(
        self,
        previous: NDArray[np.uint8],  # (H, W)
        grey: NDArray[np.uint8],  # (H, W)
        T_world_previous: NDArray[np.float64],  # (4, 4)
        T_world_predicted: NDArray[np.float64],  # (4, 4)
        camera: PinholeCamera,
        config: LandmarkConfig,
    ) -> Landmarks:
        """Return the corners tracked into the next image.

        KLT starts from the flow of the predicted motion, a difference of two projections, so that
        a landmark's own error does not enter. Each corner is then aligned with the patch it was
        detected in. One that moves by that, or does not look like it, has slid along an edge or on
        to another surface, and is left out: in fast turns those did more harm than landmarks do
        good.
        """
        if not len(self):
            return self
        before, after = self.seen_from(T_world_previous), self.seen_from(T_world_predicted)
        ahead = (before[:, 2] > _NEAREST_M) & (after[:, 2] > _NEAREST_M)
        alive, after = self[ahead], after[ahead]
        if not len(alive):
            return alive
        flow = camera.project(after) - camera.project(before[ahead])
        pixels, found = _klt(previous, grey, alive.pixels, alive.pixels + flow, config)
        aligned, correlation = alive.patches.aligned(
            grey, pixels, after, T_world_predicted, camera, config.slip_px
        )
        found &= np.abs(aligned - pixels).max(axis=1) < config.slip_px
        found &= correlation > config.min_correlation
        return replace(alive, pixels=aligned)[found]

    def sighted(
        self,
        depth_m: NDArray[np.float32],  # (H, W)
        T_world_cam: NDArray[np.float64],  # (4, 4)
        T_cam_cam_at_depth: NDArray[np.float64],  # (4, 4)
        twist: NDArray[np.float64],  # (6,) per second, of the camera, in its frame
        camera: PinholeCamera,
        sensor: SensorNoise,
    ) -> Sightings:
        """Return where a keyframe sees the corners, at colour's instant."""
        expected = np.maximum(self.seen_from(T_world_cam)[:, 2], _NEAREST_M).astype(np.float32)
        z, rays = back_projected(
            self.pixels, expected, depth_m, T_cam_cam_at_depth, twist, camera, sensor
        )
        z = np.where(in_range(z, sensor), z, np.float32(0.0))
        return Sightings(self.ids, rays[:, :2].astype(np.float32), z)

    def measured(
        self,
        depth_m: NDArray[np.float32],  # (H, W)
        T_world_predicted: NDArray[np.float64],  # (4, 4)
        T_cam_cam_at_depth: NDArray[np.float64],  # (4, 4)
        twist: NDArray[np.float64],  # (6,) per second, of the camera, in its frame
        camera: PinholeCamera,
        sensor: SensorNoise,
        config: LandmarkConfig,
        weight: float,
    ) -> PointFactors:
        """Return the factors of the corners: back-projected, with S_l = S(v_l, z_l; sigma_m).

        A corner without depth, or with one that contradicts what is expected, counts across its
        ray only; it stands at the expected depth, with a variance of 1 m^2 along the ray.
        """
        expected = np.maximum(self.seen_from(T_world_predicted)[:, 2], _NEAREST_M)
        measured, rays = back_projected(
            self.pixels, expected.astype(np.float32), depth_m, T_cam_cam_at_depth, twist, camera,
            sensor,
        )  # fmt: skip
        off = np.abs(measured - expected)
        bearing = off > _CONTRADICTS * np.sqrt(2.0) * sensor.sigma(expected) + _ROUGH_M
        bearing |= ~in_range(measured, sensor)
        points = (rays * np.where(bearing, expected, measured)[:, None]).astype(np.float32)
        ranges = np.linalg.norm(points, axis=1)
        along = np.where(bearing, 1.0, np.square(sensor.sigma(ranges)))
        covariances = covariances_along_rays(
            points, np.square(config.sigma_px / camera.focal * ranges), along
        )
        return PointFactors(points, covariances, self.targets, huber=config.huber, weight=weight)


def detect(
    grey: NDArray[np.uint8],  # (H, W)
    depth_m: NDArray[np.float32],  # (H, W)
    alive: Landmarks,
    T_world_cam: NDArray[np.float64],  # (4, 4)
    T_cam_cam_at_depth: NDArray[np.float64],  # (4, 4)
    twist: NDArray[np.float64],  # (6,) per second, of the camera, in its frame
    gaussians: GaussianMap,
    camera: PinholeCamera,
    sensor: SensorNoise,
    config: LandmarkConfig,
    anchor_px: float,
    host: int,
) -> Landmarks:
    """Return new corners, placed on the tangent planes of their nearest Gaussians.

    l = x + n_j n_j^T (mu_j - x), with the anchor's covariance Sigma_t,j. A corner without a
    Gaussian near it is placed at its measured point x, with Sigma_t of this view, which is of
    keyframe `host`, or -1. A smooth bias of depth adds to the variance along the ray: the bearing
    counts then, and the depth hardly. There are at most `config.corners` together with those
    `alive`, which they keep their distance from.
    """
    wanted = config.corners - len(alive)
    pixels = corners(grey, alive.pixels, _SPARE * wanted, config)
    guess = depth_at(depth_m, pixels, sensor.a_m, sensor.b_per_m)
    z, rays = back_projected(pixels, guess, depth_m, T_cam_cam_at_depth, twist, camera, sensor)
    best = np.flatnonzero(in_range(z, sensor))[: max(wanted, 0)]  # the strongest are first
    pixels, points = pixels[best], rays[best] * z[best, None]
    R, t = T_world_cam[:3, :3], T_world_cam[:3, 3]
    world = se3.transform(T_world_cam, points).astype(np.float32)
    slots = gaussians.index.nearest(gaussians.means, world, config.anchor_radius_m)
    on_map = slots >= 0
    near = slots[on_map]
    seen_at, seen_from, normals = world.copy(), np.tile(t, (len(world), 1)), world - t
    hosts = np.full(len(world), host, np.int32)
    seen_at[on_map] = gaussians.means[near]
    seen_from[on_map] = gaussians.viewpoints[near]
    normals[on_map] = gaussians.normals[near]
    hosts[on_map] = gaussians.hosts[near]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    height = np.sum((seen_at - world) * normals, axis=1, keepdims=True)
    anchors = observed_from(seen_at, seen_from, sensor, anchor_px / camera.focal, hosts)
    bias_m = sensor.depth_bias * np.linalg.norm(seen_at - seen_from, axis=1)
    targets = replace(
        anchors,
        points=(world + normals * height).astype(np.float32),
        along=(anchors.along + np.square(bias_m)).astype(np.float32),
    )
    patches = cut(grey, pixels, z[best], normals @ R, T_world_cam, camera)
    return Landmarks(pixels, targets, patches, np.full(len(pixels), -1))


def _klt(
    previous: NDArray[np.uint8],
    grey: NDArray[np.uint8],
    pixels: NDArray[np.float32],  # (L, 2)
    guess: NDArray[np.float32],  # (L, 2)
    config: LandmarkConfig,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    found_at, status, _ = cv2.calcOpticalFlowPyrLK(
        previous,
        grey,
        np.ascontiguousarray(pixels, np.float32).reshape(-1, 1, 2),
        np.array(guess, np.float32).reshape(-1, 1, 2),  # a copy: OpenCV writes into it
        winSize=(config.window_px, config.window_px),
        maxLevel=config.levels,
        criteria=_KLT_STOP,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return found_at.reshape(-1, 2), status.ravel() > 0


def back_projected(
    pixels: NDArray[np.float32],  # (L, 2)
    expected_m: NDArray[np.float32],  # (L,) expected depth
    depth_m: NDArray[np.float32],  # (H, W)
    T_cam_cam_at_depth: NDArray[np.float64],  # (4, 4)
    twist: NDArray[np.float64],  # (6,) per second
    camera: PinholeCamera,
    sensor: SensorNoise,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return depths (L,) and rays (L, 3), z = 1, of corners at colour's instant; 0: no depth.

    Colour's instant is that of its middle row. With a rolling shutter, a row that is exposed dt
    later sees a point from exp(dt twist), which moves its ray.

    The depth image was taken at another instant: a corner's depth is looked up where the camera's
    motion puts its point at that instant, and the motion along the axis is added.
    """
    rays = np.column_stack([camera.undistort(pixels), np.ones(len(pixels), np.float32)])
    if sensor.color_readout_ms > 0.0:
        late = (pixels[:, 1:] + 0.5) / camera.height - 0.5
        seen = rays * np.maximum(expected_m, _NEAREST_M)[:, None]
        velocities = seen @ se3.hat(twist[3:]).T + twist[:3]
        moved = seen + 1e-3 * sensor.color_readout_ms * late * velocities
        rays = (moved / moved[:, 2:]).astype(np.float32)
    there = rays * expected_m[:, None]
    T_cam_at_depth_cam = se3.inverse(T_cam_cam_at_depth)
    then = se3.transform(T_cam_at_depth_cam, there)
    visible = then[:, 2] > 0.05
    looked_up = np.zeros(len(pixels), np.float32)
    looked_up[visible] = depth_at(
        depth_m, camera.project(then[visible]), sensor.a_m, sensor.b_per_m
    )
    depth = np.where(looked_up > 0, looked_up + there[:, 2] - then[:, 2], 0.0)
    return depth.astype(np.float32), rays


def in_range(z: NDArray[np.float32], sensor: SensorNoise) -> NDArray[np.bool_]:
    """Return which depths (L,), metres, are where the sensor measures."""
    return (z > sensor.depth_min_m) & (z < sensor.depth_max_m)


@kernel
def depth_at(depth, pixels, noise_a, noise_b):
    """Return (L,) float32, metres: the mean of the valid 3x3 depths at each pixel; 0 at an edge.

    `depth` (H, W) metres, `pixels` (L, 2) as x, y; `noise_a` in metres, `noise_b` in 1/metre.
    """
    height, width = depth.shape
    out = np.zeros(pixels.shape[0], np.float32)
    for i in range(pixels.shape[0]):
        u, v = pixels[i, 0], pixels[i, 1]
        if not (u >= 1.0 and v >= 1.0 and u < width - 2.0 and v < height - 2.0):
            continue
        x, y = int(u + 0.5), int(v + 0.5)
        nearest, farthest, total, n = np.inf, 0.0, 0.0, 0
        for dy in range(-1, 2):
            for dx in range(-1, 2):
                z = depth[y + dy, x + dx]
                if 0.0 < z < np.inf:
                    total += z
                    n += 1
                    nearest, farthest = min(nearest, z), max(farthest, z)
        if n < _MIN_NEIGHBOURS:
            continue
        z = total / n
        if farthest - nearest <= _FLAT_SLOPE * z + _FLAT_NOISE * (noise_a + noise_b * z * z):
            out[i] = z
    return out
