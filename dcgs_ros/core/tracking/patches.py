# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What a landmark looked like when it was detected, and its alignment with a later image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..camera import PinholeCamera
from ..kernels.jit import kernel

SIDE = 11  # pixels of a patch
_MIN_COSINE = 0.3  # more grazing surfaces are taken as facing the camera
_STEPS = 8  # of Gauss-Newton, at most
_SETTLED_PX = 0.02
_FLATTEST = 4.0  # gradient energy of a patch that can be aligned, square grey levels


@dataclass(frozen=True)
class Patches:
    """Patches of the images in which landmarks were detected, each on its surface."""

    grey: NDArray[np.float32]  # (L, SIDE, SIDE)
    steps: NDArray[np.float32]  # (L, 2, 3) metres, world: a pixel right and down on the surface

    @classmethod
    def none(cls) -> Patches:
        """Return an empty set."""
        return cls(np.empty((0, SIDE, SIDE), np.float32), np.empty((0, 2, 3), np.float32))

    def __getitem__(self, keep: NDArray[np.bool_] | NDArray[np.int64]) -> Patches:
        """Return the patches of a mask or of indices."""
        return Patches(self.grey[keep], self.steps[keep])

    def joined(self, other: Patches) -> Patches:
        """Return both sets together."""
        return Patches(
            np.concatenate([self.grey, other.grey]), np.concatenate([self.steps, other.steps])
        )

    def aligned(
        self,
        image: NDArray[np.uint8],  # (H, W)
        pixels: NDArray[np.float32],  # (L, 2) where they are thought to be
        points: NDArray[np.floating],  # (L, 3) of the landmarks, metres, camera frame
        T_world_cam: NDArray[np.float64],  # (4, 4)
        camera: PinholeCamera,
        reach_px: float = math.inf,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return where in the image they are (L, 2), and their correlation there (L,) in [-1, 1].

        A search ends where it is more than `reach_px` in x or y from where it began.

        The patch is warped as the pose says that its surface is seen now (Baker and Matthews 2004,
        inverse compositional, without the mean and scaled to the image's contrast). The
        correlation is -1 where the patch reaches out of the image or has no texture.
        """
        seen = camera.project(points)
        tangents = self.steps.astype(np.float64) @ T_world_cam[:3, :3]
        warps = np.stack(
            [camera.project(points + tangents[:, k]) - seen for k in (0, 1)], axis=2
        )  # (L, 2, 2): columns are the images of the two steps
        found = np.array(pixels, np.float32)
        correlation = np.empty(len(found), np.float32)
        _align(image, self.grey, np.ascontiguousarray(warps), reach_px, found, correlation)
        return found, correlation


def cut(
    image: NDArray[np.uint8],  # (H, W)
    pixels: NDArray[np.float32],  # (L, 2)
    z: NDArray[np.floating],  # (L,) metres
    normals: NDArray[np.floating],  # (L, 3) unit, camera frame
    T_world_cam: NDArray[np.float64],  # (4, 4)
    camera: PinholeCamera,
) -> Patches:
    """Return the patches around pixels, at depths z, of surfaces with these normals.

    A patch is exposed at once, whatever the shutter does.
    """
    rays = np.column_stack([camera.undistort(pixels), np.ones(len(pixels))])
    facing = np.abs(np.sum(normals * rays, axis=1)) / np.linalg.norm(rays, axis=1)
    flat = np.where((facing < _MIN_COSINE)[:, None], rays, normals)
    steps = np.empty((len(pixels), 2, 3), np.float32)
    for k, step in enumerate(np.eye(2, dtype=np.float32)):
        beside = np.column_stack([camera.undistort(pixels + step), np.ones(len(pixels))])
        ratio = np.sum(flat * rays, axis=1) / np.sum(flat * beside, axis=1)
        steps[:, k] = (beside * ratio[:, None] - rays) * z[:, None] @ T_world_cam[:3, :3].T
    grey = np.empty((len(pixels), SIDE, SIDE), np.float32)
    _cut(image, pixels, grey)
    return Patches(grey, steps)


@kernel
def _cut(image, pixels, patches):
    """Write the `patches` (L, SIDE, SIDE) of `image` (H, W) around `pixels` (L, 2), bilinearly."""
    height, width = image.shape
    half = SIDE // 2
    for i in range(pixels.shape[0]):
        for r in range(SIDE):
            for c in range(SIDE):
                x = min(max(pixels[i, 0] + c - half, 0.0), width - 1.001)
                y = min(max(pixels[i, 1] + r - half, 0.0), height - 1.001)
                patches[i, r, c] = _sampled(image, x, y)


@kernel
def _sampled(image, x, y):
    """Return `image` (H, W) at a point inside it, bilinearly."""
    u, v = int(x), int(y)
    fx, fy = x - u, y - v
    top = (1.0 - fx) * image[v, u] + fx * image[v, u + 1]
    low = (1.0 - fx) * image[v + 1, u] + fx * image[v + 1, u + 1]
    return (1.0 - fy) * top + fy * low


@kernel
def _align(image, patches, warps, reach, pixels, correlation):
    """Move `pixels` (L, 2) to where `patches` (L, SIDE, SIDE) fit `image` (H, W) best.

    `warps` (L, 2, 2) map steps in the patch to steps in the image; a search ends more than `reach`
    pixels from its start. Writes `correlation` (L,).
    """
    height, width = image.shape
    half = SIDE // 2
    n = (SIDE - 2) * (SIDE - 2)  # the rim only serves for gradients
    here, slope_x, slope_y, there = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for i in range(pixels.shape[0]):
        correlation[i] = -1.0
        patch = patches[i]
        mean = xx = xy = yy = energy = 0.0
        k = 0
        for r in range(1, SIDE - 1):
            for c in range(1, SIDE - 1):
                here[k] = patch[r, c]
                slope_x[k] = 0.5 * (patch[r, c + 1] - patch[r, c - 1])
                slope_y[k] = 0.5 * (patch[r + 1, c] - patch[r - 1, c])
                mean += here[k]
                k += 1
        mean /= n
        for k in range(n):
            here[k] -= mean
            xx += slope_x[k] * slope_x[k]
            xy += slope_x[k] * slope_y[k]
            yy += slope_y[k] * slope_y[k]
            energy += here[k] * here[k]
        determinant = xx * yy - xy * xy
        if not (determinant > 1e-6 * (xx + yy) ** 2 and energy > _FLATTEST):
            continue
        a, b = warps[i, 0, 0], warps[i, 0, 1]
        d, e = warps[i, 1, 0], warps[i, 1, 1]
        reach_x = (half - 1) * (abs(a) + abs(b))
        reach_y = (half - 1) * (abs(d) + abs(e))
        x, y = pixels[i, 0], pixels[i, 1]
        for step in range(_STEPS + 1):
            if not (
                x >= reach_x
                and y >= reach_y
                and x < width - 1.0 - reach_x
                and y < height - 1.0 - reach_y
            ):
                correlation[i] = -1.0
                break
            average = 0.0
            k = 0
            for r in range(1 - half, half):
                for c in range(1 - half, half):
                    there[k] = _sampled(image, x + a * c + b * r, y + d * c + e * r)
                    average += there[k]
                    k += 1
            average /= n
            both = variance = 0.0
            for k in range(n):
                there[k] -= average
                both += there[k] * here[k]
                variance += there[k] * there[k]
            correlation[i] = both / math.sqrt(max(variance, 1e-6) * energy)
            if step == _STEPS or not both > 0.0:
                break
            gain = energy / both  # the image's contrast, brought to the patch's
            gx_sum = gy_sum = 0.0
            for k in range(n):
                error = gain * there[k] - here[k]
                gx_sum += slope_x[k] * error
                gy_sum += slope_y[k] * error
            u = (yy * gx_sum - xy * gy_sum) / determinant
            v = (xx * gy_sum - xy * gx_sum) / determinant
            x -= a * u + b * v
            y -= d * u + e * v
            far = abs(x - pixels[i, 0]) > reach or abs(y - pixels[i, 1]) > reach
            if far or u * u + v * v < _SETTLED_PX * _SETTLED_PX:
                break
        pixels[i, 0], pixels[i, 1] = x, y
