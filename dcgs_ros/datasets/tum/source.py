# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Sequences in the folder layout of TUM's RGB-D benchmark, which Bonn's dynamic one shares."""

from __future__ import annotations

import re
from pathlib import Path

from ...core.trajectory import Trajectory
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
    left_out = [*notes]
    truth = read_truth(folder, groundtruth, left_out)
    return ImageSequence.from_preset(folder, pairs, preset, truth, notes=left_out)


def read_truth(folder: Path, given: Path | str | None, left_out: list[str]) -> Trajectory | None:
    """Read the file `given`, else the folder's `groundtruth.txt` or `.csv`, if there is one.

    What cannot be used of it is appended to `left_out`. Raises `TrajectoryFileError`.
    """
    defaults = (folder / f'groundtruth.{suffix}' for suffix in ('txt', 'csv'))
    path = given or next((path for path in defaults if path.exists()), None)
    return None if path is None else read_tum(path, left_out)


def camera_in_name(name: str) -> str | None:
    """Return the camera that the name of a sequence tells, None if it tells none."""
    if 'bonn' in name.lower():
        return 'bonn'
    match = re.search(r'(?:freiburg|fr)([123])(?!\d)', name.lower())
    return None if match is None else f'fr{match[1]}'


def _infer_camera(name: str) -> str:
    camera = camera_in_name(name)
    if camera is None:
        raise SourceError(
            f'{name}: the name does not tell the camera (fr1, fr2, fr3 or bonn); '
            f'give --camera {"|".join(PRESETS)} or --camera fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]'
        )
    return camera
