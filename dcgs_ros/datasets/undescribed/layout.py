# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Colour and depth in a folder without any description: told from each other by their names."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from ...io.trajectory import parse_stamp_ns

_IMAGE = re.compile(r'\.(?:png|jpe?g)$', re.IGNORECASE)
_NUMBER = re.compile(r'[0-9]+(?:\.[0-9]+)?')
_COLOR = re.compile(r'rgb|colou?r|image|img|left|cam')
_OTHER = re.compile(r'mask|semantic|label|instance|normal|conf|seg|right|infra')
_SINCE_2001_NS = 10**18  # whole numbers are stamps from here on, or with so many digits:
_STAMP_DIGITS = 11


@dataclass(frozen=True)
class ImageFolders:
    """Patterns of the files of colour and depth, as in a dcgs.yaml, and how many there are."""

    color: str
    depth: str
    counts: tuple[int, int]  # of colour, of depth
    stamped: bool  # the names are times, not numbers


def find_image_folders(folder: Path) -> ImageFolders | None:
    """Find colour and depth in a folder or its subfolders; None unless there is one of each."""
    groups = _groups(folder)
    depths = {pattern for pattern in groups if 'depth' in pattern.lower()}
    depths = {pattern for pattern in depths if not _OTHER.search(pattern.lower())}
    colors = {pattern for pattern in groups.keys() - depths if 'depth' not in pattern.lower()}
    colors = {pattern for pattern in colors if not _OTHER.search(pattern.lower())}
    named = {pattern for pattern in colors if _COLOR.search(pattern.lower())}
    color, depth = (_largest(found, groups) for found in (named or colors, depths))
    if color is None or depth is None:
        return None
    stamped = all(_are_stamps(groups[pattern]) for pattern in (color, depth))
    return ImageFolders(color, depth, (len(groups[color]), len(groups[depth])), stamped)


def why_unreadable(path: Path) -> str | None:
    """Return what is known of a recording that cannot be read, and the remedy; else None."""
    is_record3d = path.suffix == '.r3d'
    if is_record3d or (path.is_dir() and any(path.glob('*/*.exr'))):
        kind = 'LZFSE' if is_record3d else 'OpenEXR'
        return (
            f'{path} holds depth as {kind} (Record3D), which is not read: convert it to 16-bit '
            'PNGs beside the colour images, and describe them in a dcgs.yaml (docs/datasets.md)'
        )
    return None


def _groups(folder: Path) -> dict[str, list[str]]:
    """Return the names of images by their pattern, in which each number is a star."""
    groups: dict[str, list[str]] = {}
    for within in ('', *sorted(entry.name for entry in folder.iterdir() if entry.is_dir())):
        for name in os.listdir(folder / within):
            if _IMAGE.search(name):
                stem, suffix = os.path.splitext(name)
                pattern = os.path.join(within, _NUMBER.sub('*', stem) + suffix)
                groups.setdefault(pattern, []).append(name)
    return {pattern: names for pattern, names in groups.items() if '*' in pattern}


def _largest(patterns: set[str], groups: dict[str, list[str]]) -> str | None:
    return max(sorted(patterns), key=lambda pattern: len(groups[pattern]), default=None)


def _are_stamps(names: list[str]) -> bool:
    try:
        return all(_is_stamp(PurePosixPath(name).stem) for name in names)
    except ValueError:
        return False


def _is_stamp(stem: str) -> bool:
    stamp_ns = parse_stamp_ns(stem)
    is_long = len(stem.lstrip('0')) >= _STAMP_DIGITS
    return '.' in stem or is_long or stamp_ns >= _SINCE_2001_NS
