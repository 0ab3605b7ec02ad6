# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""7-Scenes: seven rooms seen by a Kinect, published without calibration or registration."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core import se3
from ..core.camera import PinholeCamera
from ..core.trajectory import Trajectory
from ..io.trajectory import read_tum
from .camera_presets import PRESETS
from .images.association import StampPair
from .images.depth_registration import register_depth
from .images.indexed_frames import indexed_trajectory, pair_by_index
from .images.sequence import ColorDepth, ImageSequence
from .options import AS_STORED, SourceOptions
from .parsing.intrinsics import choose_camera
from .parsing.pose_matrices import read_pose

LAYOUT = 'frame-000000.color.png (or .jpg), .depth.png and .pose.txt ... (7-Scenes)'

_FRAME = 'frame-([0-9]{6})'

# The nominal intrinsics that the dataset's authors give.
DEPTH_CAMERA = PinholeCamera(640, 480, 585.0, 585.0, 320.0, 240.0)
# A Kinect's colour camera is 25 mm to the right of its depth camera, seen from behind them.
T_COLORCAM_DEPTHCAM = np.eye(4)
T_COLORCAM_DEPTHCAM[0, 3] = -0.025

_NO_DEPTH = np.float32(65535)


def is_seven_scenes(path: Path) -> bool:
    """Return whether the path is a sequence's folder."""
    return any(True for _ in path.glob('frame-[0-9][0-9][0-9][0-9][0-9][0-9].color.[jp][pn]g'))


def open_seven_scenes(
    path: Path | str,
    camera: str | None = None,
    groundtruth: Path | str | None = None,
    options: SourceOptions = AS_STORED,
) -> ImageSequence:
    """Open a sequence's folder; frame i is at i / 30 s.

    Depth is registered to the colour camera: a nominal Kinect's, or `camera`, a preset or
    intrinsics. `groundtruth` is a TUM trajectory of the colour camera instead of the pose files,
    which are of the depth camera; frames whose file is missing or not rigid have no pose.

    Raises `SourceError` (or `TrajectoryFileError`) naming the file.
    """
    folder = Path(path)
    pairs = pair_by_index(
        folder, rf'{_FRAME}\.color\.(?:png|jpg)', rf'{_FRAME}\.depth\.png', options.rate_hz
    )
    unit, rate_hz = options.depth_per_metre, options.rate_hz
    chosen = choose_camera(camera, PRESETS['7scenes'], folder, pairs, unit)
    notes: list[str] = []
    if groundtruth is None:
        truth = _read_truth(folder, pairs, rate_hz)
    else:
        truth = read_tum(groundtruth, notes)
    register = partial(_register, chosen.camera, _NO_DEPTH / np.float32(chosen.depth_per_metre))
    return ImageSequence.from_preset(folder, pairs, chosen, truth, register, notes)


def _register(
    camera: PinholeCamera,
    none_m: np.float32,
    color: NDArray[np.uint8],
    depth_m: NDArray[np.float32],
) -> ColorDepth:
    depth_m = np.where(depth_m < none_m, depth_m, np.float32(0))
    return color, register_depth(depth_m, DEPTH_CAMERA, T_COLORCAM_DEPTHCAM, camera)


def _read_truth(folder: Path, pairs: list[StampPair], rate_hz: float | None) -> Trajectory | None:
    """Return the poses of the colour camera; None if there are no pose files."""
    poses = {}
    for pair in pairs:
        path = folder / f'{pair.color.path[: len("frame-000000")]}.pose.txt'
        if path.exists():
            poses[int(path.name[len('frame-') : len('frame-000000')])] = read_pose(path)
    if not poses:
        return None
    depth = indexed_trajectory(folder, poses, rate_hz)
    return Trajectory(depth.stamps_ns, depth.T_world_cam @ se3.inverse(T_COLORCAM_DEPTHCAM))
