# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Settings of the nodes, besides those of the algorithms of tracker and mapper."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Literal

from .navigation import GridConfig, ObstacleConfig
from .presets import RegistrationChoice
from .schema import Stage, described, ranged
from .stages import Config


@dataclass(frozen=True)
class TrackerNodeSettings(Stage):
    """The tracker's node: frames, topics, memory and files."""

    map_frame: str = described(
        'map', 'Frame of the map, in which the base is right, but steps at corrections.'
    )
    odom_frame: str = described(
        'odom',
        'Frame in which the base moves without steps; it drifts. It begins where the map has its '
        'origin.',
    )
    base_frame: str = described(
        'camera_link', 'Frame of the robot, or of the camera itself, whose pose is published.'
    )
    tf: Literal['odom_to_base', 'map_to_odom', 'none'] = described(
        'odom_to_base',
        'Transforms to broadcast: odom_to_base (odom_frame to base_frame, map to odom_frame) if '
        'no other node does; map_to_odom (map to odom_frame only) if another node, such as wheel '
        'odometry, broadcasts odom_frame to base_frame; none.',
    )
    autostart: bool = described(
        True,
        "Configure and activate at the start; else another node does, such as nav2's lifecycle "
        'manager.',
    )
    tf_delay_s: float = ranged(
        0.05,
        0.005,
        10,
        'With tf map_to_odom: interval at which map to odom_frame is broadcast, lost or not, '
        'seconds.',
    )
    tf_tolerance_s: float = ranged(
        0.1,
        0,
        10,
        'With tf map_to_odom: how far into the future that transform is dated, seconds.',
    )
    base_to_camera: str = described(
        'auto',
        "Pose of the camera's optical frame in base_frame as 'x y z qx qy qz qw', metres and a "
        'unit quaternion; auto: from TF or, until it is there, a camera at the origin of '
        'base_frame that looks along its x axis.',
    )
    imu_topic: str = described(
        'camera/camera/imu',
        'Topic of the IMU for priors.gyro and priors.gravity; also listened to are gyro/sample '
        'and accel/sample beside it, as realsense2_camera names them, with parallel axes.',
    )
    camera_to_imu: str = described(
        'auto',
        "Pose of the IMU's frame in the camera's optical frame as 'x y z qx qy qz qw'; auto: from "
        'TF. Until it is known the IMU is not used.',
    )
    odometry_topic: str = described(
        'odom',
        'Topic of the wheel odometry for priors.wheels, of poses of its child frame; empty: TF '
        'from odom_frame to base_frame, of another node.',
    )
    wait_for_transform_s: float = ranged(
        5.0,
        0,
        600,
        'Time to wait at the first image for TF from base_frame to the camera, seconds; images '
        'are dropped meanwhile. Without it tracking begins with the assumption of base_to_camera; '
        'when TF comes later, a new map begins with the camera where it is.',
    )
    reliability: Literal['best_effort', 'reliable'] = described(
        'best_effort',
        'Reliability of the image subscriptions: best_effort for a live camera, reliable for a '
        'replay of which no frame may be lost.',
    )
    color_transport: Literal['raw', 'zstd', 'compressed'] = described(
        'raw',
        'How colour is sent, as image_transport names it: compressed subscribes to '
        'CompressedImage on the topic of the raw image with /compressed after it.',
    )
    depth_transport: Literal['raw', 'compressedDepth', 'zstd', 'compressed'] = described(
        'raw',
        'How depth is sent, likewise: compressedDepth subscribes to the topic of the raw image '
        'with /compressedDepth after it.',
    )
    max_rate_hz: float = ranged(
        0.0,
        0,
        1000,
        'Largest rate at which frames are tracked, hertz; others are left out evenly. Below 5 a '
        'moving camera gets lost; 0: every frame.',
    )
    sync_slop_s: float = ranged(
        0.02, 0, 1, 'Largest difference of the stamps of colour and depth of one frame, seconds.'
    )
    depth_registration: RegistrationChoice = described(  # noqa: RUF009  it does not see that this is a Literal
        'auto',
        'Registration of depth to colour. none: depth is registered already; extrinsics: by TF '
        'between the frames of the images; auto: by their frames, the topic and the intrinsics.',
    )
    depth_per_metre: float | None = ranged(
        None,
        1,
        1e6,
        'Value of a depth pixel at one metre; auto: 1000 of 16 bits, millimetres, and 1 of 32FC1, '
        'metres.',
    )
    path_rate_hz: float = ranged(
        1.0, 0, 30, 'Rate at which the path is published, hertz; 0: never.'
    )
    path_poses: int = ranged(
        1000,
        2,
        100000,
        'Largest number of poses in the path; of a longer one every 2nd, 4th ... is kept.',
    )
    points_rate_hz: float = ranged(
        10.0,
        0,
        60,
        'Largest rate at which the depth of tracked frames is published as points while there are '
        'subscribers, hertz; 0: never.',
    )
    keyframe_memory_mb: float = ranged(
        300.0,
        1,
        1e6,
        'Memory for keyframes that the mapper has not confirmed, megabytes; a mapper that starts '
        'late or again gets them.',
    )
    resume: bool = described(
        True,
        'At the start, continue in the map of a mapper that is running; else begin a new one.',
    )
    resume_wait_s: float = ranged(
        2.0, 0, 60, 'Time to wait at the start for a mapper with a map, seconds.'
    )
    map: str = described(
        '', 'Map file to begin in, and that ~/load_map loads: a map.dcgs; empty: none.'
    )
    mode: Literal['mapping', 'localization'] = described(
        'mapping',
        'mapping: extend the map; localization: track in the map of node.map and leave it as it '
        'is, without a mapper.',
    )
    save_folder: str = described('runs', 'Folder in which each saved map gets its own folder.')
    save_on_exit: str = described(
        '', 'Folder in which the trajectory is saved at the end; empty: not saved.'
    )


@dataclass(frozen=True)
class TrackerSettings(Config):
    """All settings of the node `tracker`."""

    node: TrackerNodeSettings = field(default_factory=TrackerNodeSettings)


@dataclass(frozen=True)
class MapperNodeSettings(Stage):
    """The mapper's node: frames, rates and files."""

    map_frame: str = described('map', "Frame that the map is in until a keyframe's pose tells.")
    map_rate_hz: float = ranged(
        0.1,
        0,
        30,
        'Largest rate at which the whole map is published when it has changed, hertz; 0: only to '
        'new subscribers.',
    )
    update_rate_hz: float = ranged(
        1.0, 0, 30, 'Rate at which changes of the map are published, hertz; 0: never.'
    )
    render_rate_hz: float = ranged(
        1.0,
        0,
        30,
        'Rate at which the map is rendered from the latest pose while there are subscribers, '
        'hertz; 0: never.',
    )
    grid_rate_hz: float = ranged(
        1.0,
        0,
        30,
        'Largest rate at which the grid is published where it has changed, hertz; 0: there '
        'is none.',
    )
    obstacles_rate_hz: float = ranged(
        1.0,
        0,
        30,
        'Rate at which obstacles are published while there are subscribers, hertz; 0: never.',
    )
    base_frame: str = described(
        'camera_link', 'Frame of the robot, for grid.self_box and the range of obstacles.'
    )
    base_to_camera: str = described(
        'auto', 'Pose of the camera in base_frame, as of the tracker; auto: from TF.'
    )
    autostart: bool = described(
        True,
        "Configure and activate at the start; else another node does, such as nav2's lifecycle "
        'manager.',
    )
    nice: int = ranged(
        19, 0, 19, 'Niceness of the mapping thread on Linux; 19 gives way to all others.'
    )
    save_folder: str = described('runs', 'Folder in which each saved map gets its own folder.')
    save_on_exit: bool = described(False, 'Save the map at the end.')
    autosave_s: float = ranged(
        0.0,
        0,
        1e6,
        'Interval at which the map is saved as autosave.dcgs in save_folder, seconds, where it '
        'has changed; 0: never.',
    )
    map: str = described(
        '', 'Map file to begin in, and that ~/load_map loads: a map.dcgs; empty: none.'
    )
    mode: Literal['mapping', 'localization'] = described(
        'mapping',
        'mapping: extend the map; localization: show the map of node.map and leave it as it is.',
    )


@dataclass(frozen=True)
class MapperSettings(Config):
    """All settings of the node `mapper`."""

    node: MapperNodeSettings = field(default_factory=MapperNodeSettings)
    grid: GridConfig = field(default_factory=GridConfig)
    obstacles: ObstacleConfig = field(default_factory=ObstacleConfig)


def core_config(settings: Config) -> Config:
    """Return the settings of tracker and mapper, without the node's: those saved with a map."""
    return Config(**{f.name: getattr(settings, f.name) for f in dataclasses.fields(Config)})


@dataclass(frozen=True)
class ReplaySettings(Stage):
    """All settings of the node `replay`."""

    source: str = described(
        '',
        'Sequence to play, in any format that dcgs run accepts, such as a TUM folder, a rosbag2, '
        'a .sens file, or synthetic:room?frames=300&seed=0&sensor=kinect.',
    )
    camera: str = described(
        'auto',
        'Camera of the sequence: a preset (fr1, d435i, replica ...), or '
        'fx,fy,cx,cy[,k1,k2,p1,p2[,k3]] in pixels; auto: as given by the sequence.',
    )
    rate: float = ranged(1.0, 0, 1000, 'Speed relative to the recording; 0: as fast as possible.')
    loop: bool = described(False, 'Start again after the last frame, until stopped.')
    continuous_stamps: bool = described(
        False, 'With loop, let stamps go on increasing; else they jump back, as with a bag.'
    )
    start_s: float = ranged(0.0, 0, 1e6, 'Time into the recording at which to start, seconds.')
    duration_s: float = ranged(
        0.0, 0, 1e6, 'Duration of the part of the recording to play, seconds; 0: to the end.'
    )
    clock: bool = described(True, 'Publish /clock, for nodes with use_sim_time.')
    reliability: Literal['best_effort', 'reliable'] = described(
        'reliable',
        'Reliability of the image publishers; reliable works with subscribers of both kinds.',
    )
    wait_for_subscribers: int = ranged(
        1, 0, 100, 'Start when each camera topic has this many subscribers; 0: at once.'
    )
    wait_for_node: str = described(
        '',
        'Name of a tracker, such as dcgs_tracker, that must be among the subscribers before the '
        'start, and that no frame is played too soon for; empty: none.',
    )
    color_frame: str = described(
        'camera_color_optical_frame', 'Frame of the images, z forward, x right.'
    )
    base_frame: str = described(
        'camera_link',
        'Frame that the camera is fixed to, x forward, z up; broadcast to TF once, with those of '
        'the sensors beside it, unless a bag tells what is.',
    )
