# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""`dcgs grid MAP DEST`: the occupancy grid of a map file, for nav2's map_server."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core import se3
from ..core.config.navigation import GridConfig
from ..core.config.schema import override
from ..core.mapping.rectification import DEPTH_UNIT_M
from ..core.navigation.occupancy import OccupancyMap, OccupancyMapper
from ..core.navigation.voxels import FREE, OCCUPIED
from ..datasets.mounts import LOOKING_FORWARD
from ..io.map_archive import SavedMap, read_map
from ..io.map_server import write_map_server
from .arguments import GridArguments, UsageError
from .folders import FolderError
from .tables import table


def execute(arguments: GridArguments) -> int:
    """Write the grid and return the exit status."""
    dest = arguments.dest
    if dest.suffix.lower() not in ('.yaml', '.yml'):
        raise UsageError(f'{dest}: the grid is a .yaml file, with a .pgm beside it')
    for path in (dest, dest.with_suffix('.pgm')):
        if path.exists():
            raise FolderError(f'{path} exists: no file is overwritten')
    config = override(GridConfig(), arguments.overrides)
    saved = read_map(arguments.map)
    grid = grid_of(saved, config, _T_floor_world(arguments))
    if not (grid.cells == OCCUPIED).any() and not (grid.cells == FREE).any():
        raise UsageError(
            f'{arguments.map}: nothing between {config.min_height_m:g} and '
            f'{config.max_height_m:g} m was seen; of a map of `dcgs run` --camera-height is needed'
        )
    image = write_map_server(dest, grid)
    height_m, width_m = (side * grid.resolution_m for side in grid.cells.shape)
    rows = [
        ('size', f'{width_m:.1f} x {height_m:.1f} m'),
        ('free', f'{(grid.cells == FREE).sum() * grid.resolution_m**2:.1f} m^2'),
        ('occupied', f'{(grid.cells == OCCUPIED).sum()} cells of {grid.resolution_m:g} m'),
        ('written to', f'{dest}, {image}'),
    ]
    print(table(f'grid of {arguments.map.name}', rows), flush=True)
    return 0


def grid_of(
    saved: SavedMap, config: GridConfig, T_floor_world: NDArray[np.float64]
) -> OccupancyMap:
    """Return the grid of a saved map's views, in the frame that `T_floor_world` (4, 4) maps to."""
    grid = OccupancyMapper(saved.camera, saved.config.sensor, config)
    for view in saved.keyframes:
        data = np.frombuffer(view.depth_png, np.uint8)
        depth = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
        if depth is not None:
            depth_m = depth * np.float32(DEPTH_UNIT_M)
            grid.insert(depth_m, T_floor_world @ view.T_tracked)
    return grid.map


def _T_floor_world(arguments: GridArguments) -> NDArray[np.float64]:
    """Return the pose (4, 4) of the map's world over the floor."""
    T = np.eye(4)
    if arguments.camera_height is not None:
        pitch = np.radians(arguments.camera_pitch)
        T = LOOKING_FORWARD @ se3.exp(np.array([0.0, 0.0, 0.0, pitch, 0.0, 0.0]))
        T[2, 3] = arguments.camera_height
    return T
