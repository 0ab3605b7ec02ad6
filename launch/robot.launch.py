# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A robot on wheels with a D435i: the SLAM nodes, robot_localization and nav2 (docs/robots.md)."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

_SHARE = Path(get_package_share_directory('dcgs_ros'))
_EITHER = ['true', 'false']
_ARGUMENTS = [
    DeclareLaunchArgument(
        'params',
        default_value=str(_SHARE / 'config' / 'robot' / 'dcgs.yaml'),
        description='Parameter file of tracker and mapper.',
    ),
    DeclareLaunchArgument(
        'ekf',
        default_value='true',
        choices=_EITHER,
        description="Start robot_localization's filter, which broadcasts odom -> base_link; "
        'false: the drive does.',
    ),
    DeclareLaunchArgument(
        'ekf_params',
        default_value=str(_SHARE / 'config' / 'robot' / 'ekf.yaml'),
        description='Parameter file of the filter.',
    ),
    DeclareLaunchArgument(
        'nav2_params',
        default_value='',
        description="Parameter file of nav2's navigation; empty: it is not started.",
    ),
    DeclareLaunchArgument(
        'rviz', default_value='false', choices=_EITHER, description='Start RViz.'
    ),
    DeclareLaunchArgument(
        'use_sim_time', default_value='false', choices=_EITHER, description='Time from /clock.'
    ),
]


def generate_launch_description() -> LaunchDescription:
    """Return what `ros2 launch` is to start."""
    return LaunchDescription([*_ARGUMENTS, OpaqueFunction(function=_start)])


def _start(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    names = (argument.name for argument in _ARGUMENTS)
    given = {name: LaunchConfiguration(name).perform(context) for name in names}
    simulated = {'use_sim_time': given['use_sim_time'] == 'true'}
    # The topic of the IMU has the driver turn it on; nav2 expects the grid on /map.
    slam = {
        'params': given['params'], 'imu_topic': 'camera/camera/imu', 'grid_topic': 'map',
        'rviz': given['rviz'], 'use_sim_time': given['use_sim_time'],
    }  # fmt: skip
    started = [_included(_SHARE, 'slam.launch.py', slam)]
    if given['ekf'] == 'true':
        started.append(
            Node(
                package='robot_localization', executable='ekf_node', name='ekf_filter_node',
                output='screen', parameters=[given['ekf_params'], simulated],
            )
        )  # fmt: skip
    if given['nav2_params']:
        nav2 = {'params_file': given['nav2_params'], 'use_sim_time': given['use_sim_time']}
        share = Path(get_package_share_directory('nav2_bringup'))
        started.append(_included(share, 'navigation_launch.py', nav2))
    return started


def _included(share: Path, name: str, arguments: dict[str, str]) -> LaunchDescriptionEntity:
    source = PythonLaunchDescriptionSource(str(share / 'launch' / name))
    return IncludeLaunchDescription(source, launch_arguments=arguments.items())
