# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A recording in place of the camera, with tracker, mapper and, on request, RViz."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

_EITHER = ['true', 'false']
_ARGUMENTS = [
    DeclareLaunchArgument(
        'source',
        default_value='synthetic:room',
        description='A sequence in any format: a rosbag2, a dataset, synthetic:room|plane|zigzag.',
    ),
    DeclareLaunchArgument(
        'bag', default_value='', description='Bag to play, instead of `source`.'
    ),
    DeclareLaunchArgument(
        'rate', default_value='1.0', description='Speed at most; 0: as fast as it is tracked.'
    ),
    DeclareLaunchArgument(
        'loop', default_value='false', choices=_EITHER, description='Begin again at the end.'
    ),
    DeclareLaunchArgument(
        'mapper', default_value='true', choices=_EITHER, description='Start the mapper.'
    ),
    DeclareLaunchArgument(
        'rviz', default_value='false', choices=_EITHER, description='Start RViz.'
    ),
    DeclareLaunchArgument(
        'params', default_value='', description='Parameter file of tracker and mapper.'
    ),
    DeclareLaunchArgument(
        'namespace', default_value='', description='Namespace of all nodes, topics and TF.'
    ),
    DeclareLaunchArgument(
        'base_frame', default_value='', description='Frame whose pose the tracker publishes.'
    ),
    DeclareLaunchArgument(
        'imu_topic', default_value='', description='Topic of the IMU, which is used then.'
    ),
    DeclareLaunchArgument(
        'odom_topic', default_value='', description='Topic of wheel odometry, likewise.'
    ),
    DeclareLaunchArgument(
        'tf', default_value='', description='Transform that the tracker broadcasts.'
    ),
    DeclareLaunchArgument(
        'use_sim_time',
        default_value='false',
        choices=_EITHER,
        description="Time of tracker, mapper and RViz is the recording's.",
    ),
]


def generate_launch_description() -> LaunchDescription:
    """Return what `ros2 launch` is to start."""
    slam = Path(get_package_share_directory('dcgs_ros'), 'launch', 'slam.launch.py')
    passed_on = (
        'mapper', 'rviz', 'params', 'namespace', 'imu_topic', 'odom_topic', 'base_frame', 'tf',
        'use_sim_time',
    )  # fmt: skip
    arguments = {name: LaunchConfiguration(name) for name in passed_on}
    arguments |= {'camera': 'none', 'reliability': 'reliable'}
    return LaunchDescription(
        [
            *_ARGUMENTS,
            # First, since it sets the transport up for the replay too.
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(str(slam)), launch_arguments=arguments.items()
            ),
            OpaqueFunction(function=_replay),
        ]
    )


def _replay(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    names = ('source', 'bag', 'rate', 'loop', 'namespace')
    given = {name: LaunchConfiguration(name).perform(context) for name in names}
    parameters = {
        # A string: otherwise a folder named 2026 would be a number.
        'source': ParameterValue(given['bag'] or given['source'], value_type=str),
        'rate': float(given['rate']),
        'loop': given['loop'] == 'true',
        'wait_for_subscribers': 1,
        'wait_for_node': 'dcgs_tracker',  # rviz or a recorder may subscribe sooner
    }
    return [
        Node(
            package='dcgs_ros',
            executable='replay',
            namespace=given['namespace'],
            output='screen',
            parameters=[parameters],
            remappings=[('/tf_static', 'tf_static')] if given['namespace'] else [],
        )
    ]
