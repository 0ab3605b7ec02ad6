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
    IncludeLaunchDescription,
    OpaqueFunction,
    SetEnvironmentVariable,
)
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import EnvironmentVariable, LaunchConfiguration
from launch_ros.actions import Node

_CONFIG = Path(get_package_share_directory('dcgs_ros'), 'config')
_PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'
_EITHER = ['true', 'false']
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
        description="Parameter file of tracker and mapper; by default the camera's.",
    ),
    DeclareLaunchArgument(
        'reliability',
        default_value='best_effort',
        choices=['best_effort', 'reliable'],
        description='How the tracker subscribes to images, where `params` does not say.',
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
    names = ('camera', 'tracker', 'mapper', 'rviz', 'params', 'reliability')
    given = {name: LaunchConfiguration(name).perform(context) for name in names}
    files = [given['params']] if given['params'] else []
    if not files and given['camera'] != 'none':
        files = [str(_CONFIG / f'{given["camera"]}.yaml')]
    started: list[LaunchDescriptionEntity] = []
    if given['tracker'] == 'true':
        if given['camera'] == 'd435i':
            started.append(_realsense())
        started.append(_node('tracker', [{'node.reliability': given['reliability']}, *files]))
    if given['mapper'] == 'true':
        started.append(_node('mapper', files))
    if given['rviz'] == 'true':
        shown = ['-d', str(_CONFIG / 'dcgs.rviz')]
        started.append(Node(package='rviz2', executable='rviz2', arguments=shown))
    return started


def _realsense() -> IncludeLaunchDescription:
    share = Path(get_package_share_directory('realsense2_camera'))
    source = PythonLaunchDescriptionSource(str(share / 'launch' / 'rs_launch.py'))
    return IncludeLaunchDescription(source, launch_arguments=_D435I.items())


def _node(executable: str, parameters: list[Any]) -> Node:
    return Node(
        package='dcgs_ros',
        executable=executable,
        output='screen',
        parameters=parameters,
        sigterm_timeout=_SIGTERM_S,
    )
