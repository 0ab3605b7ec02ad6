# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Replica as NICE-SLAM rendered it: rooms without noise, and exact poses."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from ..core.trajectory import Trajectory
from ..io.trajectory import read_tum
from .camera_files import camera_of, chosen_camera, depth_unit_of
from .cameras import PRESETS, CameraPreset
from .images.indexed_frames import numbered_pairs, numbered_poses
from .images.sequence import ImageSequence
from .poses import parse_matrix, read_text
from .source import SourceError

LAYOUT = "results/ with frame000000.jpg, depth000000.png ..., and traj.txt (NICE-SLAM's Replica)"

_CAMERA_FILE = 'cam_params.json'
_CAMERA_KEYS = ('w', 'h', 'fx', 'fy', 'cx', 'cy')
_MAX_CAMERA_BYTES = 2**16
_MAX_TRAJECTORY_BYTES = 2**28


def is_replica(path: Path) -> bool:
    """Tell whether the path is a scene's folder."""
    return any(True for _ in path.glob('results/frame[0-9][0-9][0-9][0-9][0-9][0-9].jpg'))


def open_replica(
    path: Path | str, camera: str | None = None, groundtruth: Path | str | None = None
) -> ImageSequence:
    """Open a scene's folder; frame i is at i / 30 s.

    The camera is that of `cam_params.json` in the folder or beside it, else the preset; `camera`
    replaces it by a preset's or by intrinsics. `groundtruth` is a TUM trajectory used instead of
    `traj.txt`, whose row i is the pose of frame i and is left out where it is none.

    Raises `SourceError` (or `TrajectoryFileError`) naming the file and the line or key.
    """
    folder = Path(path)
    pairs = numbered_pairs(
        folder, r'results/frame([0-9]{6})\.jpg', r'results/depth([0-9]{6})\.png'
    )
    chosen = chosen_camera(camera, _own_camera(folder), folder, pairs)
    truth = _read_truth(folder / 'traj.txt') if groundtruth is None else read_tum(groundtruth)
    return ImageSequence.of(folder, pairs, chosen, truth)


def _own_camera(folder: Path) -> CameraPreset:
    preset = PRESETS['replica']
    for place in (folder, Path(os.path.abspath(folder)).parent):
        path = place / _CAMERA_FILE
        if path.exists():
            try:
                values = _camera_values(read_text(path, _MAX_CAMERA_BYTES))
                camera = camera_of(values, _CAMERA_KEYS)
                return CameraPreset(camera, preset.sensor, depth_unit_of(values, 'scale'))
            except ValueError as error:
                raise SourceError(f'{path}: {error}') from None
    return preset


def _camera_values(text: str) -> dict[str, Any]:
    """Read {"camera": {...}}; raises `ValueError`."""
    try:
        tree = json.loads(text)
    except RecursionError:
        raise ValueError('is nested too deeply') from None
    values = tree.get('camera') if isinstance(tree, dict) else None
    if not isinstance(values, dict):
        raise ValueError('holds no {"camera": {"w": ..., "h": ..., "fx": ...}}')
    return values


def _read_truth(path: Path) -> Trajectory | None:
    """Poses of the file, where there is one."""
    if not path.exists():
        return None
    poses = {}
    text = read_text(path, _MAX_TRAJECTORY_BYTES).rstrip()
    for number, line in enumerate(text.split('\n')):
        try:
            poses[number] = parse_matrix(line)
        except ValueError as error:
            raise SourceError(f'{path}:{number + 1}: {error}') from None
    return numbered_poses(path, poses)
