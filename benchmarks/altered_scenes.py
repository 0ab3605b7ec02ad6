# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Synthetic scenes seen from beside the path, and other places that look like them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.datasets.synthetic.motion.path import Path
from dcgs_ros.datasets.synthetic.options import parse_address
from dcgs_ros.datasets.synthetic.raycast import Scene
from dcgs_ros.datasets.synthetic.source import SyntheticSource

_ASIDE_M, _ASIDE_RAD = 0.2, 0.25  # standard deviation beside the path, of all three axes together
_SHAKE = 1000  # added to the seed, so that the hand shakes differently
_LARGE_M = 2.0  # half extent: walls and floor, not furniture
_MOVED_M, _TURNED_RAD = 0.5, 0.5  # by which furniture is rearranged, standard deviations


@dataclass
class Beside:
    """A `Path` beside another one."""

    path: Path
    T_path_cam: NDArray[np.float64]  # (4, 4)
    T_base_cam: NDArray[np.float64] | None = None

    def poses(self, times_s: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return T_world_cam (N, 4, 4) at times (N,)."""
        return self.path.poses(times_s) @ self.T_path_cam

    def ground(self, times_s: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return what carries the camera (N, 3), which is where it was."""
        return self.path.ground(times_s)


class Altered(SyntheticSource):
    """A synthetic sequence from beside its path, in a scene that may be changed."""

    def __init__(
        self,
        address: str,
        rng: np.random.Generator,
        change: Callable[[Scene, np.random.Generator], Scene] | None = None,
    ) -> None:
        """Draw the way aside, and change the scene."""
        scene, options = parse_address(address)
        super().__init__(scene, options, address)
        path = self._scenario.motion.path(options.seed + _SHAKE, options.speed)
        scales = np.repeat([_ASIDE_M, _ASIDE_RAD], 3) / np.sqrt(3)
        self._path = Beside(path, se3.exp(rng.normal(0.0, scales)))
        if change is not None:
            changed = change(self._scenario.scene, rng)
            self._scenario = replace(self._scenario, scene=changed)


def redecorated(scene: Scene, rng: np.random.Generator) -> Scene:
    """Return another room of the same shape: all else than its geometry differs."""
    textured = np.flatnonzero(scene.textures >= 0)
    textures, mappings = scene.textures.copy(), scene.mappings.copy()
    textures[textured] = rng.permutation(textures[textured])
    mappings[:, 1:] = rng.uniform(0.0, 1.0, mappings[:, 1:].shape)
    tints = scene.tints * rng.uniform(0.6, 1.0, scene.tints.shape).astype(np.float32)
    return replace(scene, textures=textures, mappings=mappings, tints=tints)


def rearranged(scene: Scene, rng: np.random.Generator) -> Scene:
    """Return another room with the same furniture, elsewhere, and walls of the same pattern."""
    large = scene.halves.max(axis=1) > _LARGE_M
    centres, R, mappings = scene.centres.copy(), scene.R_world_local.copy(), scene.mappings.copy()
    mappings[large, 1:] = rng.uniform(0.0, 1.0, (np.count_nonzero(large), 2))
    for k in np.flatnonzero(~large):
        centres[k, :2] += rng.normal(0.0, _MOVED_M, 2)
        R[k] = se3.exp(np.array([0, 0, 0, 0, 0, rng.normal(0.0, _TURNED_RAD)]))[:3, :3] @ R[k]
    return replace(scene, centres=centres, R_world_local=R, mappings=mappings)
