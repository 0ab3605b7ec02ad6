# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""7-Scenes: seven rooms seen by a Kinect, published uncalibrated and unregistered."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core import se3
from ..core.camera import PinholeCamera
from ..core.trajectory import Trajectory
from ..io.trajectory import read_tum
from .camera_files import chosen_camera
from .cameras import PRESETS
from .images.association import StampPair
from .images.depth_registration import register_depth
from .images.indexed_frames import numbered_pairs, numbered_poses
from .images.sequence import Images, ImageSequence
from .poses import read_pose

LAYOUT = 'frame-000000.color.png, .depth.png and .pose.txt ... (7-Scenes)'

# What its authors say: the depth camera is nominal too.
DEPTH_CAMERA = PinholeCamera(640, 480, 585.0, 585.0, 320.0, 240.0)
# A Kinect's colour camera stands 25 mm to the right of its depth camera, as these look out.
T_COLOR_DEPTH = np.eye(4)
T_COLOR_DEPTH[0, 3] = -0.025

_NO_DEPTH_M = np.float32(65535) / np.float32(PRESETS['7scenes'].depth_per_metre)


def is_seven_scenes(path: Path) -> bool:
    """Tell whether the path is a sequence's folder."""
    return any(True for _ in path.glob('frame-[0-9][0-9][0-9][0-9][0-9][0-9].color.png'))


def open_seven_scenes(
    path: Path | str, camera: str | None = None, groundtruth: Path | str | None = None
) -> ImageSequence:
    """Open a sequence's folder; frame i is at i / 30 s.

    Depth is registered to the colour camera, nominal unless `camera` names a preset or gives
    intrinsics. `groundtruth` is a TUM trajectory of the colour camera used instead of the pose
    files, which are of the depth camera and left out where they are missing or hold no pose.

    Raises `SourceError` (or `TrajectoryFileError`) naming the file.
    """
    folder = Path(path)
    pairs = numbered_pairs(
        folder, r'frame-([0-9]{6})\.color\.png', r'frame-([0-9]{6})\.depth\.png'
    )
    chosen = chosen_camera(camera, PRESETS['7scenes'], folder, pairs)
    truth = _read_truth(folder, pairs) if groundtruth is None else read_tum(groundtruth)
    return ImageSequence.of(folder, pairs, chosen, truth, partial(_register, chosen.camera))


def _register(
    camera: PinholeCamera, color: NDArray[np.uint8], depth_m: NDArray[np.float32]
) -> Images:
    depth_m = np.where(depth_m < _NO_DEPTH_M, depth_m, np.float32(0))
    return color, register_depth(depth_m, DEPTH_CAMERA, T_COLOR_DEPTH, camera)


def _read_truth(folder: Path, pairs: list[StampPair]) -> Trajectory | None:
    """Poses of the colour camera; None where there is no file of them."""
    poses = {}
    for pair in pairs:
        path = folder / pair.color.path.replace('color.png', 'pose.txt')
        if path.exists():
            poses[int(path.name[len('frame-') : len('frame-000000')])] = read_pose(path)
    if not poses:
        return None
    depth = numbered_poses(folder, poses)
    return Trajectory(depth.stamps_ns, depth.T_world_cam @ se3.inverse(T_COLOR_DEPTH))
