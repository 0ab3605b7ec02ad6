# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What tracker and mapper hand each other: images with poses and Gaussians, and the answer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .frame import RgbdFrame


@dataclass(frozen=True)
class PosedFrame:
    """A tracked frame for the mapper to look at: a view between keyframes, or a `Keyframe`."""

    frame: RgbdFrame
    T_world_cam: NDArray[np.float64]  # (4, 4) at the colour's instant
    T_cam_cam_at_depth: NDArray[np.float64]  # (4, 4) camera at the depth's instant to colour's


@dataclass(frozen=True)
class Keyframe(PosedFrame):
    """A frame that extended the tracker's map, with the Gaussians it spawned."""

    ids: NDArray[np.int64]  # (N,)
    means: NDArray[np.float32]  # (N, 3) metres, world
    normals: NDArray[np.float32]  # (N, 3) unit, world


@dataclass(frozen=True)
class MapUpdate:
    """The mapper's answer: how the tracker's Gaussians changed, and which were removed."""

    ids: NDArray[np.int64]  # (N,)
    means: NDArray[np.float32]  # (N, 3) metres, world
    normals: NDArray[np.float32]  # (N, 3) unit, world: axis of the smallest scale of Sigma_r
    flatness: NDArray[np.float32]  # (N,) lambda3 / lambda2 of Sigma_r
    removed: NDArray[np.int64]  # (R,)
