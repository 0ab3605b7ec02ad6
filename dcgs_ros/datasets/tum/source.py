# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Sequences in the folder layout of TUM's RGB-D benchmark, which Bonn's dynamic one shares."""

from __future__ import annotations

import re
from pathlib import Path

from ...io.trajectory import read_tum
from ..camera_presets import PRESETS
from ..images.sequence import ImageSequence
from ..options import AS_STORED, SourceOptions
from ..parsing.intrinsics import choose_camera
from ..source import SourceError, sequence_name
from .index import ASSOCIATIONS, read_pairs

LAYOUT = 'rgb.txt and depth.txt, or associations.txt, and the images they name (TUM, Bonn)'


def is_tum(path: Path) -> bool:
    """Return whether the path is such a folder, complete or not."""
    return any((path / name).is_file() for name in ('rgb.txt', 'depth.txt', *ASSOCIATIONS))


def open_tum(
    path: Path | str,
    camera: str | None = None,
    groundtruth: Path | str | None = None,
    options: SourceOptions = AS_STORED,
) -> ImageSequence:
    """Open a folder with `rgb.txt` and `depth.txt`, or `associations.txt`.

    `camera` is a preset or `fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]` in pixels (with structured-light
    noise); None infers a preset from the folder's name. Depth is TUM's 5000 per metre, unless the
    options say otherwise. `groundtruth` is the folder's `groundtruth.txt` (or `.csv`) by default,
    if there is one; poses in it that cannot be used are left out.

    Everything except the images is read and checked here. Raises `SourceError` (or
    `TrajectoryFileError` for the ground truth) naming the file and the line.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise SourceError(f'{path}: no such folder')
    pairs, notes = read_pairs(folder, options)
    text = camera or _infer_camera(sequence_name(folder))
    preset = choose_camera(text, PRESETS['fr3'], folder, pairs, options.depth_per_metre)
    if groundtruth is None:
        defaults = (folder / f'groundtruth.{suffix}' for suffix in ('txt', 'csv'))
        groundtruth = next((path for path in defaults if path.exists()), None)
    left_out = [*notes]
    truth = None if groundtruth is None else read_tum(groundtruth, left_out)
    return ImageSequence.from_preset(folder, pairs, preset, truth, notes=left_out)


def _infer_camera(name: str) -> str:
    if 'bonn' in name.lower():
        return 'bonn'
    match = re.search(r'(?:freiburg|fr)([123])(?!\d)', name.lower())
    if match is None:
        raise SourceError(
            f'{name}: the name does not tell the camera (fr1, fr2, fr3 or bonn); '
            f'give --camera {"|".join(PRESETS)} or --camera fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]'
        )
    return f'fr{match[1]}'
