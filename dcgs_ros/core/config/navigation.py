# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Settings of what a planner gets: the occupancy grid and the obstacle cloud."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .schema import ConfigError, Stage, described, ranged


@dataclass(frozen=True)
class GridConfig(Stage):
    """Occupancy grid and obstacles; heights are in the map, whose z axis points up."""

    resolution_m: float = ranged(0.05, 0.01, 1, 'Side of the cells, metres.')
    min_height_m: float = ranged(
        0.1,
        -100,
        100,
        'Height above the origin of the map, where the base was first, from which on surfaces are '
        'obstacles, metres; lower ones are floor.',
    )
    max_height_m: float = ranged(
        1.5, -100, 100, 'Height up to which surfaces are obstacles, metres.'
    )
    range_m: float | None = ranged(
        None,
        0.1,
        30,
        'Largest distance from the camera at which depth is used, metres; auto: as far as its '
        'standard deviation is below half a cell.',
    )
    extent_m: float = ranged(
        100.0, 1, 1000, 'Largest side of the grid, about the origin of the map, metres.'
    )
    memory_mb: float = ranged(
        50.0,
        1,
        1e5,
        'Memory for what each view told, megabytes, from which the grid is built again after a '
        'correction; beyond it only the newest view of each place is kept.',
    )
    self_box: str = described(
        '',
        "The robot's own box in the base frame as 'x y z x y z', least and greatest corner, "
        'metres: depth within it is not used; empty: none.',
    )

    def __post_init__(self) -> None:
        """Check the heights against each other, and the box."""
        super().__post_init__()
        if self.max_height_m <= self.min_height_m:
            raise ConfigError(
                f'max_height_m is {self.max_height_m:g}, not above min_height_m, '
                f'{self.min_height_m:g}'
            )
        _ = self.box

    @property
    def box(self) -> NDArray[np.float64] | None:
        """(2, 3) least and greatest corner of `self_box`, metres; None: none."""
        if not self.self_box.strip():
            return None
        try:
            numbers = np.array([float(word) for word in self.self_box.replace(',', ' ').split()])
        except ValueError:
            numbers = np.empty(0)
        if len(numbers) != 6 or not (numbers[:3] < numbers[3:]).all():
            raise ConfigError(
                f'self_box is {self.self_box!r}, not six numbers: the least x y z, then the '
                'greatest'
            )
        return numbers.reshape(2, 3)


@dataclass(frozen=True)
class ObstacleConfig(Stage):
    """Obstacles as points: opaque Gaussians in the grid's height band."""

    opacity: float = ranged(0.5, 0.01, 0.99, 'Least opacity of a Gaussian that is an obstacle.')
    range_m: float = ranged(5.0, 0.1, 1000, 'Largest distance from the base, metres.')
    voxel_m: float = ranged(
        0.05, 0.005, 1, 'Side of the voxels of which each gives one point, metres.'
    )
