# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Replica as rendered by NICE-SLAM or Semantic-NeRF: rooms without noise, with exact poses."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from ..core.camera import PinholeCamera
from ..core.trajectory import Trajectory
from ..io.trajectory import read_tum
from .camera_presets import PRESETS, CameraPreset
from .images.indexed_frames import indexed_trajectory, pair_by_index
from .images.sequence import ImageSequence, color_size
from .options import AS_STORED, SourceOptions
from .parsing.intrinsics import camera_from_fields, choose_camera
from .parsing.pose_matrices import parse_matrix
from .parsing.text_files import depth_unit_at, read_text
from .source import SourceError

LAYOUT = (
    'results/ with frame000000.jpg (or .png), depth000000.png ..., and traj.txt '
    "(NICE-SLAM's Replica)"
)

LAYOUT_NERF = 'rgb/rgb_0.png, depth/depth_0.png ..., and traj_w_c.txt (Semantic-NeRF, vMAP)'

_NERF_DEPTH_PER_METRE = 1000.0
_NERF_TRAJECTORY = 'traj_w_c.txt'
_CAMERA_FILE = 'cam_params.json'
_CAMERA_KEYS = ('w', 'h', 'fx', 'fy', 'cx', 'cy')
_MAX_CAMERA_BYTES = 2**16
_MAX_TRAJECTORY_BYTES = 2**28


def is_replica(path: Path) -> bool:
    """Return whether the path is a scene's folder."""
    return any(True for _ in path.glob('results/frame[0-9][0-9][0-9][0-9][0-9][0-9].[jp][pn]g'))


def open_replica(
    path: Path | str,
    camera: str | None = None,
    groundtruth: Path | str | None = None,
    options: SourceOptions = AS_STORED,
) -> ImageSequence:
    """Open a scene's folder; frame i is at i / 30 s.

    The camera is that of `cam_params.json` in the folder or beside it, else the preset 'replica';
    `camera` is a preset or intrinsics instead. `groundtruth` is a TUM trajectory instead of
    `traj.txt`, whose row i is the pose of frame i; rows that are not rigid are left out.

    Raises `SourceError` (or `TrajectoryFileError`) naming the file and the line or key.
    """
    folder = Path(path)
    color, depth = r'results/frame([0-9]{6})\.(?:jpg|png)', r'results/depth([0-9]{6})\.png'
    pairs = pair_by_index(folder, color, depth, options.rate_hz)
    unit = options.depth_per_metre
    chosen = choose_camera(camera, _own_camera(folder), folder, pairs, unit)
    notes: list[str] = []
    if groundtruth is None:
        truth = _read_truth(folder / 'traj.txt', options.rate_hz)
    else:
        truth = read_tum(groundtruth, notes)
    return ImageSequence.from_preset(folder, pairs, chosen, truth, notes=notes)


def is_semantic_nerf(path: Path) -> bool:
    """Return whether the path is a sequence's folder in the layout of Semantic-NeRF."""
    return all((path / name).is_dir() for name in ('rgb', 'depth')) and (
        (path / _NERF_TRAJECTORY).is_file() or (path / 'rgb/rgb_0.png').is_file()
    )


def open_semantic_nerf(
    path: Path | str,
    camera: str | None = None,
    groundtruth: Path | str | None = None,
    options: SourceOptions = AS_STORED,
) -> ImageSequence:
    """Open a sequence's folder; frame i is at i / 30 s.

    The camera sees 90 degrees across, depth is in millimetres; `camera` and `groundtruth` replace
    these and `traj_w_c.txt`. Raises `SourceError` (or `TrajectoryFileError`).
    """
    folder = Path(path)
    color, depth = r'rgb/rgb_([0-9]{1,9})\.(?:png|jpg)', r'depth/depth_([0-9]{1,9})\.png'
    pairs = pair_by_index(folder, color, depth, options.rate_hz)
    width, height = color_size(folder, pairs)
    center = ((width - 1) / 2, (height - 1) / 2)
    own = CameraPreset(
        PinholeCamera(width, height, width / 2, width / 2, *center),
        PRESETS['replica'].sensor,
        _NERF_DEPTH_PER_METRE,
    )
    chosen = choose_camera(camera, own, folder, pairs, options.depth_per_metre)
    notes: list[str] = []
    if groundtruth is None:
        truth = _read_truth(folder / _NERF_TRAJECTORY, options.rate_hz)
    else:
        truth = read_tum(groundtruth, notes)
    return ImageSequence.from_preset(folder, pairs, chosen, truth, notes=notes)


def _own_camera(folder: Path) -> CameraPreset:
    preset = PRESETS['replica']
    for place in (folder, Path(os.path.abspath(folder)).parent):
        path = place / _CAMERA_FILE
        if path.exists():
            try:
                values = _camera_values(read_text(path, _MAX_CAMERA_BYTES))
                camera = camera_from_fields(values, _CAMERA_KEYS)
                return CameraPreset(camera, preset.sensor, depth_unit_at(values, 'scale'))
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


def _read_truth(path: Path, rate_hz: float | None) -> Trajectory | None:
    """Read the poses; None if there is no such file."""
    if not path.exists():
        return None
    poses = {}
    text = read_text(path, _MAX_TRAJECTORY_BYTES).rstrip()
    for number, line in enumerate(text.split('\n')):
        try:
            poses[number] = parse_matrix(line)
        except ValueError as error:
            raise SourceError(f'{path}:{number + 1}: {error}') from None
    return indexed_trajectory(path, poses, rate_hz)
