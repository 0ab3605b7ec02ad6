# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""From what a user names to the source that reads it."""

from __future__ import annotations

from pathlib import Path

from .bag import BagSource
from .bag_messages import is_bag
from .source import Source, SourceError
from .tum import TumSource


def open_source(
    address: str, camera: str | None = None, groundtruth: Path | str | None = None
) -> Source:
    """Open `synthetic:NAME[?key=value&...]`, a rosbag2 or a folder in TUM layout.

    `camera` is a preset's name or intrinsics as `TumSource` takes them; `groundtruth` a trajectory
    file used instead of the dataset's own. Raises a `DcgsError` that says what was looked for.
    """
    if address.startswith('synthetic:'):
        if camera is not None or groundtruth is not None:
            raise SourceError(f'{address} brings its own camera and ground truth: give neither')
        from .synthetic import SyntheticSource  # a ray caster that a dataset has no use for

        return SyntheticSource.from_address(address)
    path = Path(address)
    if is_bag(path):
        return BagSource(path, camera, groundtruth)
    if path.is_dir():
        return TumSource(path, camera, groundtruth)
    if path.exists():
        raise SourceError(
            f'{address} is a file; a dataset is a folder in TUM layout, or a rosbag2: a folder, '
            'an .mcap or a .db3'
        )
    raise SourceError(
        f'{address}: no such folder or file, and no address that begins with synthetic:'
    )
