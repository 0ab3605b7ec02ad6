# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""An occupancy grid as the image and YAML file of nav2's map_server."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..core.navigation.occupancy import OccupancyMap
from ..core.navigation.voxels import FREE, OCCUPIED
from .whole_files import replacing

# As map_saver draws them. Read with free_thresh 0.196, a grey of 205 is unknown; with the 0.25
# that nav2 writes it would be free.
_WHITE, _GREY, _BLACK = 254, 205, 0
_YAML = """\
image: {image}
mode: trinary
resolution: {resolution:g}
origin: [{x:g}, {y:g}, 0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""


def write_map_server(path: Path, grid: OccupancyMap) -> Path:
    """Write `path`, a YAML file, and the image beside it, whose name is returned.

    The image's first row is the one of the greatest y. Raises `OSError` where they cannot be
    written.
    """
    image = path.with_suffix('.pgm')
    shades = np.where(grid.cells == FREE, _WHITE, _GREY).astype(np.uint8)
    shades[grid.cells == OCCUPIED] = _BLACK
    height, width = grid.cells.shape
    x, y = grid.origin_m
    with replacing(image) as temporary:
        temporary.write_bytes(b'P5\n%d %d\n255\n' % (width, height) + shades[::-1].tobytes())
    with replacing(path) as temporary:
        temporary.write_text(
            _YAML.format(image=image.name, resolution=grid.resolution_m, x=x, y=y)
        )
    return image
