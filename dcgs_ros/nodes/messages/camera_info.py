# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The camera as CameraInfo; the way back is `io.ros_images`."""

from __future__ import annotations

import array

from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header

from ...core.camera import PinholeCamera
from ...io.ros_images import camera_fields


def write_camera(camera: PinholeCamera, header: Header) -> CameraInfo:
    """Intrinsics and distortion; the projection is the camera's own, without rectification."""
    info = CameraInfo(header=header, width=camera.width, height=camera.height)
    info.distortion_model, D, info.k, info.r, info.p = camera_fields(camera)
    info.d = array.array('d', D)
    return info
