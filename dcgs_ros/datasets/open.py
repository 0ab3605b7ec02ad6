# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Opening a sequence by its address: the format follows from the files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from . import custom, icl_nuim, replica, seven_scenes, stray_scanner
from .bag import source as bag
from .bag.storage.files import is_bag
from .bag.topics import split_topics
from .options import AS_STORED, SourceOptions, split_options
from .scannet import source as scannet
from .source import Source, SourceError
from .tum import source as tum
from .undescribed import source as undescribed
from .undescribed.layout import why_unreadable


class Format(NamedTuple):
    """A format of folders or files."""

    layout: str  # the files it consists of, for the message about an unknown format
    recognises: Callable[[Path], bool]  # by file names alone, without reading any content
    # Takes camera, ground truth and what the user says besides.
    open: Callable[[Path, str | None, Path | str | None, SourceOptions], Source]


# The first format that recognises a path opens it, so specific ones come before general ones.
# Recordings, whose topics can be given in the address, are tried after all of these.
FORMATS = (
    Format(custom.LAYOUT, custom.is_custom, custom.open_custom),
    Format(scannet.LAYOUT, scannet.is_scannet, scannet.open_scannet),
    Format(replica.LAYOUT, replica.is_replica, replica.open_replica),
    Format(replica.LAYOUT_NERF, replica.is_semantic_nerf, replica.open_semantic_nerf),
    Format(stray_scanner.LAYOUT, stray_scanner.is_stray_scanner, stray_scanner.open_stray_scanner),
    Format(seven_scenes.LAYOUT, seven_scenes.is_seven_scenes, seven_scenes.open_seven_scenes),
    Format(icl_nuim.LAYOUT, icl_nuim.is_icl_nuim, icl_nuim.open_icl_nuim),
    Format(tum.LAYOUT, tum.is_tum, tum.open_tum),
    Format(undescribed.LAYOUT, undescribed.is_undescribed, undescribed.open_undescribed),
)


def open_source(
    address: str,
    camera: str | None = None,
    groundtruth: Path | str | None = None,
    options: SourceOptions = AS_STORED,
) -> Source:
    """Open `synthetic:NAME[?key=value&...]`, or a sequence in one of the formats.

    A recording's path may be followed by its topics: `?color=TOPIC&depth=TOPIC`, any path by
    options: `?depth_per_metre=1000`. `camera` is the name of a preset, or intrinsics as
    `parse_intrinsics` takes them; `groundtruth` is a trajectory file that replaces the dataset's
    own; `options` go before those in the address. Raises a `DcgsError` that says what was
    expected.
    """
    if address.startswith('synthetic:'):
        if camera is not None or groundtruth is not None or options != AS_STORED:
            raise SourceError(
                f'{address} brings its own camera, depth, stamps and ground truth: give none'
            )
        from .synthetic.source import SyntheticSource  # the ray caster, which no dataset needs

        return SyntheticSource.from_address(address)
    address, options = split_options(address, options)
    path, color, depth = split_topics(address)
    if color is None and depth is None:
        for format_ in FORMATS:
            if format_.recognises(path):
                return format_.open(path, camera, groundtruth, options)
    if is_bag(path):
        return bag.BagSource(path, camera, groundtruth, color, depth, options)
    if not path.exists():
        raise SourceError(
            f'{address}: no such folder or file, and no address that begins with synthetic:'
        )
    if (reason := why_unreadable(path)) is not None:
        raise SourceError(reason)
    layouts = '; or '.join([*(format_.layout for format_ in FORMATS), bag.LAYOUT])
    what = 'folder' if path.is_dir() else 'file'
    raise SourceError(f'{address} is a {what} of unknown format. Known formats: {layouts}')
