# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Grids as files of nav2's map_server, read as it reads them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from dcgs_ros.core.navigation.occupancy import OccupancyMap
from dcgs_ros.core.navigation.voxels import FREE, OCCUPIED, UNKNOWN
from dcgs_ros.io.map_server import write_map_server
from dcgs_ros.io.yaml_text import load_yaml


def test_map_server_reads_back_the_cells_where_they_are(tmp_path: Path) -> None:
    """Its thresholds tell the three values apart, and its first row is the farthest along y."""
    cells = np.array([[FREE, OCCUPIED, UNKNOWN], [UNKNOWN, FREE, FREE]], np.int8)
    path = tmp_path / 'hall.yaml'
    image = write_map_server(path, OccupancyMap(cells, (-1.5, 2.25), 0.05))
    assert image == tmp_path / 'hall.pgm'
    said = load_yaml(path.read_text())
    assert said['origin'] == [-1.5, 2.25, 0]
    assert (said['resolution'], said['negate'], said['mode']) == (0.05, 0, 'trinary')
    shades = cv2.imread(str(tmp_path / said['image']), cv2.IMREAD_UNCHANGED)
    share = (255 - shades.astype(float)) / 255
    found = np.where(share > said['occupied_thresh'], OCCUPIED, UNKNOWN)
    found[share < said['free_thresh']] = FREE
    np.testing.assert_array_equal(found[::-1], cells)
