# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The occupancy grid as nav_msgs/OccupancyGrid."""

from __future__ import annotations

import array

from geometry_msgs.msg import Point, Pose
from nav_msgs.msg import MapMetaData, OccupancyGrid
from std_msgs.msg import Header

from ...core.navigation.occupancy import OccupancyMap


def write_grid(grid: OccupancyMap, header: Header) -> OccupancyGrid:
    """Return the grid, in the header's frame."""
    height, width = grid.cells.shape
    x, y = grid.origin_m
    info = MapMetaData(
        map_load_time=header.stamp, resolution=grid.resolution_m, width=width, height=height,
        origin=Pose(position=Point(x=x, y=y)),
    )  # fmt: skip
    message = OccupancyGrid(header=header, info=info)
    cells = array.array('b')
    cells.frombytes(grid.cells.tobytes())
    message.data = cells
    return message
