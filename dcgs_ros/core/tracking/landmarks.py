# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""KLT corners anchored on the tangent planes of Gaussians (paper, image residual)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..camera import PinholeCamera
from ..config.stages import LandmarkConfig
from ..kernels.jit import kernel
from ..sensor import SensorNoise
from .cloud import measurement_covariances
from .factors import PointFactors, Targets, observed_from
from .gaussian_map import GaussianMap

_FLAT_SLOPE = 0.03  # largest depth range of 3x3 pixels on one surface, share of depth ...
_FLAT_NOISE = 8.0  # ... plus this many sigma_z
_SPARE = 3  # corners searched for each one wanted: many have no depth
_MIN_NEIGHBOURS = 6  # with depth, of the 3x3 pixels
# OpenCV's minimal eigenvalue of a 3x3 block where the weakest gradient is 1 grey level per pixel:
# its Sobel operator has gain 8 and is divided by 4 * 3 * 255.
_EIGENVALUE = 9.0 * (8.0 / 3060.0) ** 2
_KLT_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 12, 0.03)


@dataclass
class Landmarks:
    """Tracked corners: their positions in the last image and in the world."""

    pixels: NDArray[np.float32]  # (L, 2) distorted, in the last image
    targets: Targets  # l and the anchor's Sigma_t

    @classmethod
    def none(cls) -> Landmarks:
        """Return an empty set."""
        empty = np.empty((0, 3), np.float32)
        return cls(empty[:, :2], Targets(empty, empty, empty[:, 0], empty[:, 0]))

    def __len__(self) -> int:
        """Return the number of landmarks."""
        return len(self.pixels)

    def __getitem__(self, keep: NDArray[np.bool_]) -> Landmarks:
        """Return the landmarks of a mask."""
        return Landmarks(self.pixels[keep], self.targets[keep])

    def joined(self, other: Landmarks) -> Landmarks:
        """Return both sets together."""
        a, b = self.targets, other.targets
        joined = Targets(
            np.concatenate([a.points, b.points]),
            np.concatenate([a.axes, b.axes]),
            np.concatenate([a.perp, b.perp]),
            np.concatenate([a.along, b.along]),
        )
        return Landmarks(np.concatenate([self.pixels, other.pixels]), joined)

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
        """Return the corners tracked into the next image by KLT.

        It starts from the flow of the predicted motion, a difference of two projections, so that a
        landmark's own error does not enter. Corners that are not tracked back to where they were
        are left out.
        """
        if not len(self):
            return self
        before, after = self.seen_from(T_world_previous), self.seen_from(T_world_predicted)
        ahead = (before[:, 2] > 0.05) & (after[:, 2] > 0.05)
        alive = self[ahead]
        if not len(alive):
            return alive
        guess = alive.pixels + camera.project(after[ahead]) - camera.project(before[ahead])
        pixels, found = _klt(previous, grey, alive.pixels, guess, config.levels, config)
        back, returned = _klt(grey, previous, pixels, alive.pixels, min(1, config.levels), config)
        found &= returned & (np.abs(back - alive.pixels).max(axis=1) < config.back_check_px)
        return Landmarks(pixels[found], alive.targets[found])

    def measured(
        self,
        depth_m: NDArray[np.float32],  # (H, W)
        T_world_predicted: NDArray[np.float64],  # (4, 4)
        T_cam_cam_at_depth: NDArray[np.float64],  # (4, 4)
        camera: PinholeCamera,
        sensor: SensorNoise,
        config: LandmarkConfig,
        weight: float,
    ) -> tuple[Landmarks, PointFactors]:
        """Back-project the corners at the measured depth: a_l with S_l = S(v_l, z_l; sigma_m).

        Return the landmarks that have depth, and their factors.
        """
        expected = self.seen_from(T_world_predicted)[:, 2]
        points = _back_projected(
            self.pixels, expected.astype(np.float32), depth_m, T_cam_cam_at_depth, camera, sensor
        )
        keep = (points[:, 2] > sensor.depth_min_m) & (points[:, 2] < sensor.depth_max_m)
        alive, points = self[keep], points[keep]
        covariances = measurement_covariances(
            points, np.zeros_like(points), sensor, config.sigma_px / camera.focal, 0.0
        )
        return alive, PointFactors(
            points, covariances, alive.targets, huber=config.huber, weight=weight
        )


def detect(
    grey: NDArray[np.uint8],  # (H, W)
    depth_m: NDArray[np.float32],  # (H, W)
    alive: Landmarks,
    T_world_cam: NDArray[np.float64],  # (4, 4)
    T_cam_cam_at_depth: NDArray[np.float64],  # (4, 4)
    gaussians: GaussianMap,
    camera: PinholeCamera,
    sensor: SensorNoise,
    config: LandmarkConfig,
    anchor_px: float,
) -> Landmarks:
    """Return new corners, placed on the tangent planes of their nearest Gaussians.

    l = x + n_j n_j^T (mu_j - x), with the anchor's covariance Sigma_t,j. There are at most
    `config.corners` together with those `alive`, which they keep their distance from.
    """
    wanted = config.corners - len(alive)
    pixels = _corners(grey, alive.pixels, _SPARE * wanted, config)
    guess = _depth_at(depth_m, pixels, sensor.a_m, sensor.b_per_m)
    points = _back_projected(pixels, guess, depth_m, T_cam_cam_at_depth, camera, sensor)
    keep = (points[:, 2] > sensor.depth_min_m) & (points[:, 2] < sensor.depth_max_m)
    pixels, points = pixels[keep], points[keep]
    world = se3.transform(T_world_cam, points).astype(np.float32)
    slots = gaussians.index.nearest(gaussians.means, world, config.anchor_radius_m)
    best = np.flatnonzero(slots >= 0)[: max(wanted, 0)]  # the strongest are first
    pixels, world, slots = pixels[best], world[best], slots[best]
    normals = gaussians.normals[slots]
    height = np.sum((gaussians.means[slots] - world) * normals, axis=1, keepdims=True)
    anchored = observed_from(
        gaussians.means[slots], gaussians.viewpoints[slots], sensor, anchor_px / camera.focal
    )
    targets = Targets(world + normals * height, anchored.axes, anchored.perp, anchored.along)
    return Landmarks(pixels, targets)


def _klt(
    previous: NDArray[np.uint8],
    grey: NDArray[np.uint8],
    pixels: NDArray[np.float32],  # (L, 2)
    guess: NDArray[np.float32],  # (L, 2)
    levels: int,
    config: LandmarkConfig,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    found_at, status, _ = cv2.calcOpticalFlowPyrLK(
        previous,
        grey,
        np.ascontiguousarray(pixels, np.float32).reshape(-1, 1, 2),
        np.array(guess, np.float32).reshape(-1, 1, 2),  # a copy: OpenCV writes into it
        winSize=(config.window_px, config.window_px),
        maxLevel=levels,
        criteria=_KLT_STOP,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return found_at.reshape(-1, 2), status.ravel() > 0


def _corners(
    grey: NDArray[np.uint8], taken: NDArray[np.float32], wanted: int, config: LandmarkConfig
) -> NDArray[np.float32]:
    """Return Shi-Tomasi corners (N, 2) away from those `taken`, found at half resolution."""
    if wanted <= 0:
        return np.empty((0, 2), np.float32)
    half = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    strongest = float(cv2.cornerMinEigenVal(half, 3).max())
    if strongest <= 0.0:
        return np.empty((0, 2), np.float32)
    quality = max(config.quality, config.min_gradient**2 * _EIGENVALUE / strongest)
    if quality >= 1.0:
        return np.empty((0, 2), np.float32)
    mask = np.full(half.shape, 255, np.uint8)
    reach = config.min_distance_px / 2.0
    for x, y in np.round(taken / 2.0).astype(int):
        cv2.circle(mask, (int(x), int(y)), round(reach), 0, -1)
    found = cv2.goodFeaturesToTrack(half, wanted, quality, reach, mask=mask, blockSize=3)
    if found is None:
        return np.empty((0, 2), np.float32)
    return found.reshape(-1, 2).astype(np.float32) * 2.0 + 0.5


def _back_projected(
    pixels: NDArray[np.float32],  # (L, 2)
    expected_m: NDArray[np.float32],  # (L,) expected depth
    depth_m: NDArray[np.float32],  # (H, W)
    T_cam_cam_at_depth: NDArray[np.float64],  # (4, 4)
    camera: PinholeCamera,
    sensor: SensorNoise,
) -> NDArray[np.float32]:
    """Return points (L, 3) of corners, at the instant of the colour image; z = 0 without depth.

    The depth image was taken at another instant: a corner's depth is looked up where the camera's
    motion puts its point at that instant, and the motion along the axis is added.
    """
    rays = np.column_stack([camera.undistort(pixels), np.ones(len(pixels), np.float32)])
    there = rays * expected_m[:, None]
    T_cam_at_depth_cam = se3.inverse(T_cam_cam_at_depth)
    then = se3.transform(T_cam_at_depth_cam, there)
    visible = then[:, 2] > 0.05
    looked_up = np.zeros(len(pixels), np.float32)
    looked_up[visible] = _depth_at(
        depth_m, camera.project(then[visible]), sensor.a_m, sensor.b_per_m
    )
    depth = np.where(looked_up > 0, looked_up + there[:, 2] - then[:, 2], 0.0)
    return (rays * depth[:, None]).astype(np.float32)


@kernel
def _depth_at(depth, pixels, noise_a, noise_b):
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
                if z > 0.0:
                    total += z
                    n += 1
                    nearest, farthest = min(nearest, z), max(farthest, z)
        if n < _MIN_NEIGHBOURS:
            continue
        z = total / n
        if farthest - nearest <= _FLAT_SLOPE * z + _FLAT_NOISE * (noise_a + noise_b * z * z):
            out[i] = z
    return out
