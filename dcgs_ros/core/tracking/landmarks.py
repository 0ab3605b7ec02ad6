# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""KLT corners anchored on the tangent planes of Gaussians (paper, image residual)."""

from __future__ import annotations

import math
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
from .back_projection import NEAREST_M, back_projected, depth_at, in_range
from .corners import corners
from .factors import PointFactors, Targets, observed_from
from .gaussian_map import GaussianMap
from .patches import Patches, cut

_SPARE = 3  # corners searched for each one wanted: many have no depth
_CONTRADICTS = 4.0  # standard deviations between a measured and an expected depth ...
_ROUGH_M = 0.01  # ... plus this, metres
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
        ahead = (before[:, 2] > NEAREST_M) & (after[:, 2] > NEAREST_M)
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
        expected = np.maximum(self.seen_from(T_world_cam)[:, 2], NEAREST_M).astype(np.float32)
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
        expected = np.maximum(self.seen_from(T_world_predicted)[:, 2], NEAREST_M)
        measured, rays = back_projected(
            self.pixels, expected, depth_m, T_cam_cam_at_depth, twist, camera, sensor
        )
        points = np.empty((len(self), 3), np.float32)
        covariances = np.empty((len(self), 6), np.float32)
        limits = sensor.depth_min_m, sensor.depth_max_m
        _measure(
            rays, measured, expected, limits, sensor.a_m, sensor.b_per_m,
            config.sigma_px / camera.focal, points, covariances,
        )  # fmt: skip
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


@kernel
def _measure(rays, measured, expected, limits, noise_a, noise_b, angle, points, covariances):
    """Write the `points` (L, 3) and `covariances` (L, 6) of corners: xx xy xz yy yz zz.

    `rays` (L, 3) with z = 1, `measured` and `expected` depths (L,) and the sensor's `limits` (2,)
    in metres, `noise_a` in metres, `noise_b` in 1/metre, `angle` a corner's sigma in radians.
    """
    for i in range(rays.shape[0]):
        z, there = measured[i], expected[i]
        rough = _CONTRADICTS * math.sqrt(2.0) * (noise_a + noise_b * there * there) + _ROUGH_M
        bearing = not (limits[0] < z < limits[1] and abs(z - there) <= rough)
        depth = there if bearing else z
        x, y, z = rays[i, 0] * depth, rays[i, 1] * depth, rays[i, 2] * depth
        range2 = x * x + y * y + z * z
        perp = angle * angle * range2
        along = 1.0 if bearing else (noise_a + noise_b * range2) ** 2
        k = (along - perp) / range2
        points[i, 0], points[i, 1], points[i, 2] = x, y, z
        covariances[i, 0], covariances[i, 1], covariances[i, 2] = (
            perp + k * x * x,
            k * x * y,
            k * x * z,
        )
        covariances[i, 3], covariances[i, 4] = perp + k * y * y, k * y * z
        covariances[i, 5] = perp + k * z * z
