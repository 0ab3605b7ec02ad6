# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The camera as CameraInfo; the way back is `io.ros_images`."""

from __future__ import annotations

import array

import numpy as np
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header

from ...core.camera import PinholeCamera


def write_camera(camera: PinholeCamera, header: Header) -> CameraInfo:
    """Intrinsics and distortion; the projection is the camera's own, without rectification.

    ROS's plumb_bob has five numbers: fewer are filled up with zeros.
    """
    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    info = CameraInfo(header=header, width=camera.width, height=camera.height)
    rational = len(camera.distortion) > 5
    info.distortion_model = 'rational_polynomial' if rational else 'plumb_bob'
    info.d = array.array('d', camera.parameters[4:] if rational else camera.parameters[4:9])
    info.k = K.ravel()
    info.r = np.eye(3).ravel()
    info.p = np.hstack([K, np.zeros((3, 1))]).ravel()
    return info
