# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""ORB features of an image with their depths: by them a place is known again."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera import PinholeCamera
from ..frame import RgbdFrame
from ..self_mask import covered
from ..sensor import SensorNoise
from ..tracking.back_projection import back_projected, depth_at, in_range
from ..tracking.estimator import to_grey

_CANDIDATES = 3000  # corners of an image from which the features are chosen
_FAST = 8  # grey levels: ORB's default of 20 finds nothing in dim light
_CELLS = 8, 6  # of the image, across and down
_A_CELL = 14  # features at most: they are to be everywhere, not only on what has the most texture


@dataclass(frozen=True)
class Features:
    """Corners of an image, what they look like, and where they are."""

    descriptors: NDArray[np.uint8]  # (N, 32) ORB
    rays: NDArray[np.float32]  # (N, 2) undistorted x/z, y/z
    depths_m: NDArray[np.float32]  # (N,) at colour's instant; 0: none

    def __len__(self) -> int:
        """Return the number of features."""
        return len(self.depths_m)

    def __getitem__(self, keep: NDArray[np.int64] | NDArray[np.bool_]) -> Features:
        """Return the features of a mask or of indices."""
        return Features(self.descriptors[keep], self.rays[keep], self.depths_m[keep])

    @property
    def points(self) -> NDArray[np.float64]:
        """(N, 3) metres, camera frame; zero without depth."""
        rays = np.column_stack([self.rays, np.ones(len(self))]).astype(np.float64)
        return np.asarray(rays * self.depths_m[:, None])


def extract(
    frame: RgbdFrame,
    camera: PinholeCamera,
    sensor: SensorNoise,
    T_cam_cam_at_depth: NDArray[np.float64] | None = None,
    self_mask: str = '',
) -> Features:
    """Return the strongest corners of each part of an image.

    `T_cam_cam_at_depth` (4, 4) is the camera at depth's instant to colour's, by default the same.
    `self_mask` is `Config`'s.
    """
    grey = to_grey(frame.color)
    orb = _orb()
    mask = covered(self_mask, *grey.shape[::-1])
    seen = None if mask is None else (~mask).astype(np.uint8)
    corners = _spread(orb.detect(grey, seen), grey.shape)
    corners, descriptors = orb.compute(grey, corners)
    if descriptors is None:
        descriptors = np.empty((0, 32), np.uint8)
    pixels = np.array([corner.pt for corner in corners], np.float32).reshape(-1, 2)
    moved = np.eye(4) if T_cam_cam_at_depth is None else T_cam_cam_at_depth
    guess = depth_at(frame.depth_m, pixels, sensor.a_m, sensor.b_per_m)
    guess = np.where(guess > 0.0, guess, np.float32(1.0))
    still = np.zeros(6)
    z, rays = back_projected(pixels, guess, frame.depth_m, moved, still, camera, sensor)
    z = np.where(in_range(z, sensor), z, np.float32(0.0))
    return Features(descriptors, rays[:, :2].astype(np.float32), z)


@cache
def _orb() -> cv2.ORB:
    return cv2.ORB_create(nfeatures=_CANDIDATES, fastThreshold=_FAST)


def _spread(corners: tuple[cv2.KeyPoint, ...], shape: tuple[int, ...]) -> list[cv2.KeyPoint]:
    """Return the strongest corners of each cell."""
    if not corners:
        return []
    height, width = shape
    at = np.array([corner.pt for corner in corners])
    cell = np.minimum((at / (width, height) * _CELLS).astype(int), np.array(_CELLS) - 1)
    cell_index = cell[:, 1] * _CELLS[0] + cell[:, 0]
    strength = np.array([corner.response for corner in corners])
    order = np.lexsort((np.arange(len(at)), -strength, cell_index))
    first = np.searchsorted(cell_index[order], cell_index[order])
    kept = order[np.arange(len(order)) - first < _A_CELL]
    return [corners[k] for k in kept]
