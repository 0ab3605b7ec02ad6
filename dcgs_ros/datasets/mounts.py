# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""How a sequence's camera, IMU and base are fixed to each other, as a tree of frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core import se3
from .source import RobotSource, Source

# REP 103: the optical frame has z forward and x right, the link x forward and z up.
LOOKING_FORWARD = se3.from_quaternion(np.array([0.5, -0.5, 0.5, -0.5]), np.zeros(3))

Mount = tuple[str, str, NDArray[np.float64]]  # parent, child, T_parent_child (4, 4)


def mounts_of(source: Source, link: str, optical: str) -> list[Mount]:
    """Return the transforms between the frames of a sequence, each frame the child of one.

    The camera's optical frame is at its `link`, that on the base, and the IMU's beside the camera,
    as far as the sequence tells where they are.
    """
    robot = source if isinstance(source, RobotSource) else None
    T_base_cam = None if robot is None else robot.T_base_cam
    if robot is None or T_base_cam is None:
        mounts = [(link, optical, LOOKING_FORWARD)]
    elif robot.base_frame == link:
        mounts = [(link, optical, T_base_cam)]
    else:
        T_base_link = T_base_cam @ se3.inverse(LOOKING_FORWARD)
        mounts = [(robot.base_frame, link, T_base_link), (link, optical, LOOKING_FORWARD)]
    if robot is not None and robot.T_cam_imu is not None:
        placed = {frame for parent, child, _ in mounts for frame in (parent, child)}
        imus = [frame for frame in robot.imu_frames if frame not in placed]
        mounts += [(optical, frame, robot.T_cam_imu) for frame in imus]
    return mounts
