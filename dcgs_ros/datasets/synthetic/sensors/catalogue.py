# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The synthetic sensors: a depth camera, and what the colour camera beside it does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ....core.camera import PinholeCamera
from ...camera_presets import PRESETS
from .active_stereo import ActiveStereo
from .correlated_stereo import CorrelatedStereo
from .depth_camera import DepthCamera, IdealDepth
from .structured_light import StructuredLight
from .uncalibrated_light import UncalibratedLight

_KINECT = PinholeCamera(640, 480, 525.0, 525.0, 319.5, 239.5)


@dataclass(frozen=True)
class SensorKind:
    """One kind of RGB-D camera."""

    depth: Callable[[int], DepthCamera]  # of a seed
    camera: PinholeCamera = _KINECT
    ideal: bool = False  # colour without lens, blur, noise and gain
    metered: bool = False  # exposure time follows the light; else it is 10 ms
    readout_s: float = 0.0  # from the first row of colour to the last; depth has one instant
    repeated_color: float = 0.0  # share of the images that are the last one again
    repeated_depth: float = 0.0


SENSORS: dict[str, SensorKind] = {
    'kinect': SensorKind(lambda seed: StructuredLight()),
    'd435i': SensorKind(lambda seed: ActiveStereo()),
    'ideal': SensorKind(lambda seed: IdealDepth(), ideal=True),
    # Readout: the skew of these colour cameras grows with the frame's period (librealsense issues
    # 2724 and 3554), so rows are spread over nearly all of 1/30 s. Repeats: counted in a recording
    # of 2480 frames, 79 of colour.
    'd435i_measured': SensorKind(
        lambda seed: CorrelatedStereo(),
        PRESETS['d435i'].camera,
        metered=True,
        readout_s=0.030,
        repeated_color=0.03,
        repeated_depth=0.02,
    ),
    # Readout: Ringaby and Forssen, Scan rectification for structured light range sensors with
    # rolling shutters, ICCV 2011.
    'kinect_measured': SensorKind(
        UncalibratedLight,
        metered=True,
        readout_s=0.026,
        repeated_color=0.03,
        repeated_depth=0.02,
    ),
}
