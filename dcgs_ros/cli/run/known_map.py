# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The map that a run begins in."""

from __future__ import annotations

import sys

from ...core.camera import PinholeCamera
from ...io.map_archive import SavedMap, read_map
from ...io.snapshot import check_camera
from ..arguments import RunArguments


def read_known(arguments: RunArguments, camera: PinholeCamera) -> SavedMap | None:
    """Read the map of --map, and say what it is; None without one.

    Raises `MapFileError` for a file that is no map, or one that this camera cannot extend.
    """
    if arguments.map is None:
        return None
    known = read_map(arguments.map)
    if arguments.mapping and not arguments.localize:
        check_camera(known, camera)
    elif known.camera != camera:
        print(
            f'dcgs: the map was made with another camera, {known.camera.width}x'
            f'{known.camera.height}, fx {known.camera.fx:g}; the tracker does not mind',
            file=sys.stderr,
        )
    tracker, purpose = known.tracker, 'localising in' if arguments.localize else 'going on in'
    print(
        f'dcgs: {purpose} {arguments.map}: {len(tracker.ids)} Gaussians of '
        f'{len(tracker.poses)} keyframes, {len(known.sessions)} sessions',
        file=sys.stderr,
    )
    return known
