# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Folders of images that nothing describes: the user tells the rest, or a dcgs.yaml proposed."""

from __future__ import annotations

import dataclasses
import re
from fractions import Fraction
from pathlib import Path

import numpy as np

from ...core.sensor import SensorNoise
from ...io.images.decoding import read_depth_file
from ..camera_presets import PRESETS, TUM_DEPTH_PER_METRE
from ..images.association import StampedPath, StampPair
from ..images.file_patterns import find_images, pair_by_name, pair_by_order
from ..images.pairing import PairedImages
from ..images.sequence import ImageSequence, color_size
from ..options import AS_STORED, SourceOptions
from ..parsing.intrinsics import choose_camera
from ..source import SourceError, sequence_name
from ..tum.source import camera_in_name, read_truth
from .layout import ImageFolders, find_image_folders

LAYOUT = 'images of colour and depth in subfolders, described by --camera, --depth-per-metre, ...'

_TUM = ImageFolders('rgb/*.png', 'depth/*.png', (0, 0), True)
_SAMPLES = 5  # depth images read for the proposed unit
_GUESSED_FOCAL = 525 / 640  # of the width


class UndescribedError(SourceError):
    """A folder of images that more must be told of; `proposal` is a dcgs.yaml to begin with."""

    def __init__(self, message: str, proposal: str) -> None:
        """Keep both texts."""
        super().__init__(message)
        self.proposal = proposal


def is_undescribed(path: Path) -> bool:
    """Return whether the path is a folder with images of colour and of depth."""
    return path.is_dir() and find_image_folders(path) is not None


def open_undescribed(
    path: Path | str,
    camera: str | None = None,
    groundtruth: Path | str | None = None,
    options: SourceOptions = AS_STORED,
) -> ImageSequence:
    """Open a folder whose images are called by stamps or numbers.

    Names that are stamps pair images, as in TUM's layout, of which only the index files are
    missing; else `options.rate_hz` pairs them in order. The unit of depth is TUM's in `rgb/` and
    `depth/` with stamps, else `options.depth_per_metre`. `camera` and `groundtruth` are as in
    TUM's layout. Raises `UndescribedError` naming what is missing, or `SourceError`.
    """
    folder = Path(path)
    found = find_image_folders(folder)
    if found is None:
        raise SourceError(f'{path}: holds no images of colour and depth')
    camera = camera or camera_in_name(sequence_name(folder))
    is_tum = dataclasses.replace(found, counts=(0, 0)) == _TUM
    unit = options.depth_per_metre or (TUM_DEPTH_PER_METRE if is_tum else None)
    if camera is None or unit is None or not (found.stamped or options.rate_hz):
        raise _undescribed(folder, found, camera, unit, options)
    pairs, notes = _pairs(folder, found, options)
    preset = choose_camera(camera, PRESETS['fr3'], folder, pairs, unit)
    left_out = [*notes]
    truth = read_truth(folder, groundtruth, left_out)
    return ImageSequence.from_preset(folder, pairs, preset, truth, notes=left_out)


def _undescribed(
    folder: Path,
    found: ImageFolders,
    camera: str | None,
    unit: float | None,
    options: SourceOptions,
) -> UndescribedError:
    known = {
        '--camera': camera,
        '--depth-per-metre': unit,
        '--rate-hz': found.stamped or options.rate_hz,
    }
    return UndescribedError(
        f'{folder}: {found.counts[0]} colour images {found.color} and {found.counts[1]} depth '
        f'images {found.depth}, but nothing describes them: give '
        f'{", ".join(flag for flag, value in known.items() if not value)}, or write a '
        f'dcgs.yaml: dcgs info {folder} proposes one',
        propose(folder, found),
    )


def _pairs(folder: Path, found: ImageFolders, options: SourceOptions) -> PairedImages:
    if options.rate_hz is not None:
        return pair_by_order(folder, found.color, found.depth, Fraction(options.rate_hz))
    return pair_by_name(folder, found.color, found.depth, options)


def propose(folder: Path, found: ImageFolders) -> str:
    """Return a dcgs.yaml that would read the images, with what is guessed marked as such."""
    colors = find_images(folder, found.color)
    width, height = color_size(folder, [StampPair(StampedPath(0, colors[0]), StampedPath(0, ''))])
    focal, (cx, cy) = _GUESSED_FOCAL * width, ((width - 1) / 2, (height - 1) / 2)
    unit, share = _likely_unit(folder, find_images(folder, found.depth))
    stamps = 'stamps: names' if found.stamped else 'rate_hz: 30  # CHECK: the rate of the camera'
    return (
        f'camera: {{width: {width}, height: {height}, fx: {focal:g}, fy: {focal:g}, '
        f'cx: {cx:g}, cy: {cy:g}}}  # CHECK: guessed from the size of the images\n'
        f'color: {_quoted(found.color)}\n'
        f'depth: {_quoted(found.depth)}  # CHECK: registered to colour?\n'
        f'{stamps}\n'
        f'depth_per_metre: {unit:g}  # CHECK: {share:.0%} of the depth is then within 0.3 to 5 m\n'
    )


def _quoted(pattern: str) -> str:
    """Return a pattern as YAML, in which a star at the beginning is an alias."""
    return pattern if re.match('[a-zA-Z]', pattern) else f"'{pattern}'"


def _likely_unit(folder: Path, depths: list[str]) -> tuple[float, float]:
    """Return the unit that puts more depth into a usual range, and the share of it."""
    sensor, step = SensorNoise.structured_light(), max(1, len(depths) // _SAMPLES)
    raw = np.concatenate([read_depth_file(folder, path).ravel() for path in depths[::step]])
    raw = raw[raw > 0]
    shares = {}
    for unit in (1000.0, TUM_DEPTH_PER_METRE):
        within = (raw / unit >= sensor.depth_min_m) & (raw / unit <= sensor.depth_max_m)
        shares[unit] = float(within.mean()) if len(raw) else 0.0
    best = max(shares, key=lambda unit: shares[unit])
    return best, shares[best]
