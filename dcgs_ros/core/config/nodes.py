# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Settings of the nodes, beside those of tracker and mapper themselves."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Literal

from .schema import Stage, described, ranged
from .stages import Config


@dataclass(frozen=True)
class TrackerNodeSettings(Stage):
    """The tracker among other nodes."""

    odom_frame: str = described('odom', 'Frame that the poses are in; it stays where it began.')
    base_frame: str = described(
        'camera_link', 'Frame of the robot, or of the camera itself, whose pose is published.'
    )
    tf: Literal['odom_to_base', 'map_to_odom', 'none'] = described(
        'odom_to_base',
        'Transform to broadcast: odom_to_base (odom_frame to base_frame), where nothing else says '
        'where the base is; map_to_odom (map to odom_frame), where wheel odometry or the like '
        'broadcasts odom_frame to base_frame; none.',
    )
    base_to_camera: str = described(
        'auto',
        "Pose of the camera's optical frame in base_frame as 'x y z qx qy qz qw', metres and a "
        'unit quaternion; auto: from TF, and where it has none a camera that looks along x of '
        'base_frame, from its origin.',
    )
    reliability: Literal['best_effort', 'reliable'] = described(
        'best_effort',
        'How images are subscribed to: best_effort for a live camera, reliable for a replay that '
        'is to lose none.',
    )
    sync_slop_s: float = ranged(
        0.02, 0, 1, 'Largest distance in time of the colour and depth of one frame, seconds.'
    )
    path_rate_hz: float = ranged(
        1.0, 0, 30, 'Rate at which the path is published, hertz; 0: never.'
    )
    path_poses: int = ranged(
        1000, 2, 100000, 'Poses in the path, at most; of a longer one every 2nd, 4th ... is kept.'
    )
    keyframe_memory_mb: float = ranged(
        300.0,
        1,
        1e6,
        'Memory for keyframes that the mapper has not confirmed, megabytes: what one that starts '
        'late or again can be given.',
    )
    resume: bool = described(
        True, 'Go on in the map of a mapper that is there at the start; else begin a new one.'
    )
    resume_wait_s: float = ranged(
        2.0, 0, 60, 'Time to wait at the start for a mapper with a map, seconds.'
    )
    save_on_exit: str = described(
        '', 'Folder to write the trajectory to at the end; empty: it is not written.'
    )


@dataclass(frozen=True)
class TrackerSettings(Config):
    """All settings of the node `tracker`."""

    node: TrackerNodeSettings = field(default_factory=TrackerNodeSettings)


@dataclass(frozen=True)
class MapperNodeSettings(Stage):
    """The mapper among other nodes."""

    odom_frame: str = described('odom', 'Frame that the map is in: the odom_frame of the tracker.')
    map_rate_hz: float = ranged(
        0.1,
        0,
        30,
        'Rate at which the whole map is published, hertz, where it changed; 0: only for those who '
        'come late.',
    )
    update_rate_hz: float = ranged(
        1.0, 0, 30, 'Rate at which changes of the map are published, hertz; 0: never.'
    )
    render_rate_hz: float = ranged(
        1.0,
        0,
        30,
        'Rate at which the map is rendered from the latest pose, hertz, where somebody looks; 0: '
        'never.',
    )
    save_folder: str = described(
        'runs', 'Folder in which each map that is saved gets a folder of its own.'
    )
    save_on_exit: bool = described(False, 'Save the map at the end too.')


@dataclass(frozen=True)
class MapperSettings(Config):
    """All settings of the node `mapper`."""

    node: MapperNodeSettings = field(default_factory=MapperNodeSettings)


def core_config(settings: Config) -> Config:
    """Take out what tracker and mapper need, and what belongs into a map's file."""
    return Config(**{f.name: getattr(settings, f.name) for f in dataclasses.fields(Config)})


@dataclass(frozen=True)
class ReplaySettings(Stage):
    """All settings of the node `replay`."""

    source: str = described(
        '',
        'What to play: a sequence in any format that dcgs run takes, such as a TUM folder, a '
        'rosbag2, a .sens, or synthetic:room?frames=300&seed=0&sensor=kinect.',
    )
    camera: str = described(
        'auto',
        'Camera of the sequence: a preset (fr1, d435i, replica ...), or '
        'fx,fy,cx,cy[,k1,k2,p1,p2[,k3]] in pixels; auto: what the sequence says.',
    )
    rate: float = ranged(
        1.0, 0, 1000, 'Speed against that of the recording; 0: as fast as possible.'
    )
    loop: bool = described(False, 'Begin again after the last frame, until stopped.')
    continuous_stamps: bool = described(
        False, 'Where it begins again stamps go on; else they jump back, as those of a bag do.'
    )
    start_s: float = ranged(0.0, 0, 1e6, 'Time into the recording to start at, seconds.')
    duration_s: float = ranged(
        0.0, 0, 1e6, 'Time of the recording to play, seconds; 0: to the end.'
    )
    clock: bool = described(True, 'Publish /clock, for nodes with use_sim_time.')
    reliability: Literal['best_effort', 'reliable'] = described(
        'reliable', 'How images are published; reliable serves subscribers of either kind.'
    )
    wait_for_subscribers: int = ranged(
        0, 0, 100, 'Start when each camera topic has as many subscribers.'
    )
    color_frame: str = described(
        'camera_color_optical_frame', 'Frame of the images, z forward, x right.'
    )
    base_frame: str = described(
        'camera_link', 'Frame that the camera is fixed in, x forward, z up; broadcast to TF once.'
    )
