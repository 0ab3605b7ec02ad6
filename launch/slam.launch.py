# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Camera, tracker, mapper and RViz, each on request.

With the mapper on another machine: `mapper:=false` here, `tracker:=false` there.
"""

from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import (
    DeclareLaunchArgument,
    GroupAction,
    IncludeLaunchDescription,
    OpaqueFunction,
    SetEnvironmentVariable,
)
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import EnvironmentVariable, LaunchConfiguration
from launch_ros.actions import Node, SetRemap

_CONFIG = Path(get_package_share_directory('dcgs_ros'), 'config')
_PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'
_EITHER = ['true', 'false']
_DEFAULT = "empty: as in `params`, else the tracker's default"
_TOPICS = {
    'camera/camera/color/image_raw': 'color_topic',
    'camera/camera/aligned_depth_to_color/image_raw': 'depth_topic',
    'camera/camera/color/camera_info': 'camera_info_topic',
    'grid': 'grid_topic',
}
_SENSORS = {  # the tracker's parameters, and the priors that they are for
    'imu_topic': ('node.imu_topic', 'priors.gyro'),
    'odom_topic': ('node.odometry_topic', 'priors.wheels'),
}
_SHOWN = ('gaussian_map', 'render/color', 'dcgs_tracker/odometry', 'dcgs_tracker/path')
_OWN_TF = [('/tf', 'tf'), ('/tf_static', 'tf_static')]  # within a namespace, as nav2 has it
_ARGUMENTS = [
    DeclareLaunchArgument(
        'camera',
        default_value='d435i',
        choices=['d435i', 'none'],
        description='Camera whose driver is started; none: images come from elsewhere.',
    ),
    DeclareLaunchArgument(
        'tracker',
        default_value='true',
        choices=_EITHER,
        description='Start the camera and the tracker.',
    ),
    DeclareLaunchArgument(
        'mapper', default_value='true', choices=_EITHER, description='Start the mapper.'
    ),
    DeclareLaunchArgument(
        'rviz', default_value='false', choices=_EITHER, description='Start RViz.'
    ),
    DeclareLaunchArgument(
        'params',
        default_value='',
        description='Parameter file of tracker and mapper, which has the last word after the '
        "camera's.",
    ),
    DeclareLaunchArgument(
        'reliability',
        default_value='best_effort',
        choices=['best_effort', 'reliable'],
        description='How the tracker subscribes to images, where `params` does not say.',
    ),
    DeclareLaunchArgument(
        'namespace',
        default_value='',
        description='Namespace of all nodes and topics, TF included: one for each robot.',
    ),
    *(
        DeclareLaunchArgument(
            f'{name}_topic', default_value='', description=f'Topic of {what}; {_DEFAULT}.'
        )
        for name, what in (
            ('color', 'colour images'),
            ('depth', 'depth images registered to colour'),
            ('camera_info', 'the CameraInfo of colour'),
        )
    ),
    *(
        DeclareLaunchArgument(
            name, default_value='', description=f'Topic of {what}, which is used then; {_DEFAULT}.'
        )
        for name, what in (('imu_topic', 'the IMU'), ('odom_topic', 'wheel odometry'))
    ),
    DeclareLaunchArgument(
        'base_frame',
        default_value='',
        description=f'Frame whose pose is published, such as base_link; {_DEFAULT}.',
    ),
    DeclareLaunchArgument(
        'grid_topic',
        default_value='',
        description='Topic of the occupancy grid, such as map for nav2; empty: grid.',
    ),
    DeclareLaunchArgument(
        'tf',
        default_value='',
        choices=['', 'odom_to_base', 'map_to_odom', 'none'],
        description=f'Transform to broadcast; {_DEFAULT}.',
    ),
    DeclareLaunchArgument(
        'use_sim_time', default_value='false', choices=_EITHER, description='Time from /clock.'
    ),
]
# config/d435i.yaml is for 640x480. Depth has to be registered to colour.
_D435I = {
    'rgb_camera.color_profile': '640x480x30',
    'depth_module.depth_profile': '640x480x30',
    'align_depth.enable': 'true',
    'enable_sync': 'true',
    'enable_infra1': 'false',
    'enable_infra2': 'false',
}
# Both quantities on one topic, rates interpolated to the accelerations' stamps.
_IMU = {'enable_gyro': 'true', 'enable_accel': 'true', 'unite_imu_method': '2'}
_SIGTERM_S = '60'  # until SIGTERM: time to save a map at the end


def generate_launch_description() -> LaunchDescription:
    """Return what `ros2 launch` is to start."""
    # For the camera's driver too.
    profiles = EnvironmentVariable(_PROFILES, default_value=str(_CONFIG / 'fastdds.xml'))
    return LaunchDescription(
        [
            *_ARGUMENTS,
            SetEnvironmentVariable(_PROFILES, profiles),
            OpaqueFunction(function=_start),
        ]
    )


def _start(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    names = (argument.name for argument in _ARGUMENTS)
    given = {name: LaunchConfiguration(name).perform(context) for name in names}
    known = given['camera'] != 'none'
    files = [str(_CONFIG / f'{given["camera"]}.yaml')] if known else []
    files += [given['params']] if given['params'] else []
    simulated = [{'use_sim_time': True}] if given['use_sim_time'] == 'true' else []
    started: list[LaunchDescriptionEntity] = []
    if given['tracker'] == 'true':
        if given['camera'] == 'd435i':
            started.append(_realsense(given['namespace'], bool(given['imu_topic'])))
        said: list[dict[str, Any]] = [
            {f'node.{name}': given[name]} for name in ('base_frame', 'tf') if given[name]
        ]
        for name, (topic, prior) in _SENSORS.items():
            said += [{topic: given[name], prior: True}] if given[name] else []
        reliability = {'node.reliability': given['reliability']}
        started.append(_node('tracker', given, [reliability, *files, *said, *simulated]))
    if given['mapper'] == 'true':
        base = [{'node.base_frame': given['base_frame']}] if given['base_frame'] else []
        started.append(_node('mapper', given, [*files, *base, *simulated]))
    if given['rviz'] == 'true':
        shown = ['-d', str(_CONFIG / 'dcgs.rviz')]
        started.append(
            Node(
                package='rviz2', executable='rviz2', arguments=shown, parameters=simulated,
                namespace=given['namespace'], remappings=_shown(given),
            )
        )  # fmt: skip
    return started


def _remappings(given: dict[str, str]) -> list[tuple[str, str]]:
    """Return those of topics, and in a namespace those of TF."""
    topics = [(usual, given[name]) for usual, name in _TOPICS.items() if given[name]]
    return topics + (_OWN_TF if given['namespace'] else [])


def _shown(given: dict[str, str]) -> list[tuple[str, str]]:
    """Return the remappings of RViz, whose configuration has absolute topics."""
    if not given['namespace'] and not given['color_topic']:
        return []
    color = 'camera/camera/color/image_raw'
    topics = [(f'/{topic}', topic) for topic in _SHOWN]
    own_tf = _OWN_TF if given['namespace'] else []
    return [*topics, (f'/{color}', given['color_topic'] or color), *own_tf]


def _realsense(namespace: str, with_imu: bool) -> LaunchDescriptionEntity:
    share = Path(get_package_share_directory('realsense2_camera'))
    source = PythonLaunchDescriptionSource(str(share / 'launch' / 'rs_launch.py'))
    arguments = _D435I | (_IMU if with_imu else {})
    if not namespace:
        return IncludeLaunchDescription(source, launch_arguments=arguments.items())
    arguments |= {'camera_namespace': f'{namespace}/camera'}
    include = IncludeLaunchDescription(source, launch_arguments=arguments.items())
    return GroupAction([*(SetRemap(*pair) for pair in _OWN_TF), include])


def _node(executable: str, given: dict[str, str], parameters: list[Any]) -> Node:
    return Node(
        package='dcgs_ros',
        executable=executable,
        namespace=given['namespace'],
        output='screen',
        parameters=parameters,
        remappings=_remappings(given),
        sigterm_timeout=_SIGTERM_S,
    )
