# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Cameras known by name: intrinsics, depth noise and depth unit."""

from __future__ import annotations

from dataclasses import dataclass

from ..core.camera import PinholeCamera
from ..core.sensor import SensorNoise


@dataclass(frozen=True)
class CameraPreset:
    """Intrinsics, depth noise and depth unit of a camera."""

    camera: PinholeCamera
    sensor: SensorNoise
    depth_per_metre: float  # value of a 16-bit depth pixel at one metre


TUM_DEPTH_PER_METRE = 5000.0

_FR1_DISTORTION = (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
_FR2_DISTORTION = (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)

PRESETS: dict[str, CameraPreset] = {
    'fr1': CameraPreset(
        PinholeCamera(640, 480, 517.3, 516.5, 318.6, 255.3, _FR1_DISTORTION),
        SensorNoise.kinect(),
        TUM_DEPTH_PER_METRE,
    ),
    'fr2': CameraPreset(
        PinholeCamera(640, 480, 520.9, 521.0, 325.1, 249.7, _FR2_DISTORTION),
        SensorNoise.kinect(),
        TUM_DEPTH_PER_METRE,
    ),
    # TUM published fr3 already undistorted.
    'fr3': CameraPreset(
        PinholeCamera(640, 480, 535.4, 539.2, 320.1, 247.6),
        SensorNoise.kinect(),
        TUM_DEPTH_PER_METRE,
    ),
    # Bonn's dynamic sequences: an Asus Xtion, in TUM's layout and depth unit.
    'bonn': CameraPreset(
        PinholeCamera(
            640,
            480,
            542.822841,
            542.576870,
            315.593520,
            237.756098,
            (0.039903, -0.099343, -0.000730, -0.000144, 0.0),
        ),
        SensorNoise.kinect(),
        TUM_DEPTH_PER_METRE,
    ),
    # Nominal: each D435i has its own calibration, in its camera_info, within a few pixels of this.
    # SensorNoise.realsense takes the focal length of the depth imager in that mode.
    'd435i': CameraPreset(
        PinholeCamera(640, 480, 615.0, 615.0, 319.5, 239.5),
        SensorNoise.realsense(385.0),
        1000.0,
    ),
    'd435i_848': CameraPreset(
        PinholeCamera(848, 480, 615.0, 615.0, 423.5, 239.5),
        SensorNoise.realsense(424.0),
        1000.0,
    ),
    'd435i_1280': CameraPreset(
        PinholeCamera(1280, 720, 922.5, 922.5, 639.5, 359.5),
        SensorNoise.realsense(640.0),
        1000.0,
    ),
    # Structure sensor, nominal: a scene's own files have its calibration. It is the depth camera.
    'scannet': CameraPreset(
        PinholeCamera(640, 480, 577.6, 578.7, 318.9, 242.7),
        SensorNoise.kinect(),
        1000.0,
    ),
    # As rendered by NICE-SLAM: without noise, depth rounded to 16 bits.
    'replica': CameraPreset(
        PinholeCamera(1200, 680, 600.0, 600.0, 599.5, 339.5), SensorNoise.floor(), 6553.5
    ),
    # Nominal colour camera of a Kinect: 7-Scenes was published without a calibration.
    '7scenes': CameraPreset(
        PinholeCamera(640, 480, 525.0, 525.0, 319.5, 239.5),
        SensorNoise.kinect(),
        1000.0,
    ),
    # Rendered without noise. The dataset itself has fy = -480: its y axis points up and its frames
    # are left-handed.
    'icl_nuim': CameraPreset(
        PinholeCamera(640, 480, 481.2, 480.0, 319.5, 239.5),
        SensorNoise.floor(),
        TUM_DEPTH_PER_METRE,
    ),
}
