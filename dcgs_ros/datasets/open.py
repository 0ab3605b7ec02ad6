# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""From what a user names to the source that reads it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from . import described, icl_nuim, replica, seven_scenes
from .bag import source as bag
from .bag.messages import is_bag
from .bag.topics import split_topics
from .scannet import source as scannet
from .source import Source, SourceError
from .tum import source as tum


class Format(NamedTuple):
    """A kind of recording."""

    layout: str  # what it consists of, for who named something else
    recognises: Callable[[Path], bool]  # by names alone: no file's content is read
    open: Callable[[Path, str | None, Path | str | None], Source]  # camera, ground truth


# The first that recognises a path opens it, so the narrower ones come first; recordings, of which
# topics can be named, come behind all of them.
FORMATS = (
    Format(described.LAYOUT, described.is_described, described.open_described),
    Format(scannet.LAYOUT, scannet.is_scannet, scannet.open_scannet),
    Format(replica.LAYOUT, replica.is_replica, replica.open_replica),
    Format(seven_scenes.LAYOUT, seven_scenes.is_seven_scenes, seven_scenes.open_seven_scenes),
    Format(icl_nuim.LAYOUT, icl_nuim.is_icl_nuim, icl_nuim.open_icl_nuim),
    Format(tum.LAYOUT, tum.is_tum, tum.open_tum),
)


def open_source(
    address: str, camera: str | None = None, groundtruth: Path | str | None = None
) -> Source:
    """Open `synthetic:NAME[?key=value&...]`, or a sequence in one of the formats.

    A recording's topics may be named behind its path: `?color=TOPIC&depth=TOPIC`.
    `camera` is a preset's name or intrinsics as `parse_intrinsics` takes them; `groundtruth` a
    trajectory file used instead of the dataset's own. Raises a `DcgsError` that says what was
    looked for.
    """
    if address.startswith('synthetic:'):
        if camera is not None or groundtruth is not None:
            raise SourceError(f'{address} brings its own camera and ground truth: give neither')
        from .synthetic.source import SyntheticSource  # a ray caster that a dataset has no use for

        return SyntheticSource.from_address(address)
    path, color, depth = split_topics(address)
    if color is None and depth is None:
        for format_ in FORMATS:
            if format_.recognises(path):
                return format_.open(path, camera, groundtruth)
    if is_bag(path):
        return bag.BagSource(path, camera, groundtruth, color, depth)
    if not path.exists():
        raise SourceError(
            f'{address}: no such folder or file, and no address that begins with synthetic:'
        )
    layouts = '; or '.join([*(format_.layout for format_ in FORMATS), bag.LAYOUT])
    what = 'folder' if path.is_dir() else 'file'
    raise SourceError(f'{address} is a {what} of no known format. There are: {layouts}')
