# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What the launch files start, as a stand-in for launch records it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from launching import ROOT, launcher  # type: ignore[import-not-found]

from dcgs_ros.core.config.nodes import MapperSettings, ReplaySettings, TrackerSettings
from dcgs_ros.core.config.schema import flatten, override

VARIABLE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
D435I = str(ROOT / 'config' / 'd435i.yaml')
TF = [('/tf', 'tf'), ('/tf_static', 'tf_static')]


@pytest.fixture
def launch(monkeypatch: pytest.MonkeyPatch) -> Any:
    return launcher(monkeypatch)


def test_slam_alone_starts_a_d435i_tracker_and_mapper(launch: Any) -> None:
    slam = launch('slam')
    assert set(slam.nodes) == {'tracker', 'mapper'}
    assert all(node.named['package'] == 'dcgs_ros' for node in slam.nodes.values())
    (driver,) = slam.drivers
    assert driver.values[0].values[0] == '/realsense2_camera/launch/rs_launch.py'
    assert dict(driver.named['launch_arguments'])['align_depth.enable'] == 'true'
    assert slam.parameters('tracker') == [{'node.reliability': 'best_effort'}, D435I]
    assert slam.parameters('mapper') == [D435I]


def test_all_processes_get_the_transport_the_driver_too(launch: Any) -> None:
    slam = launch('slam', rviz='true')
    assert set(slam.environments) == {'driver', 'tracker', 'mapper', 'rviz2'}
    profiles = {environment[VARIABLE] for environment in slam.environments.values()}
    assert profiles == {str(ROOT / 'config' / 'fastdds.xml')}
    mine = launch('slam', {VARIABLE: 'mine.xml'})
    assert {environment[VARIABLE] for environment in mine.environments.values()} == {'mine.xml'}
    assert VARIABLE in launch('replay').environments['replay']


@pytest.mark.parametrize(
    ('given', 'nodes', 'drivers'),
    [
        ({'camera': 'none'}, {'tracker', 'mapper'}, 0),
        ({'mapper': 'false'}, {'tracker'}, 1),  # on the robot
        ({'tracker': 'false'}, {'mapper'}, 0),  # on the other machine
        ({'tracker': 'false', 'mapper': 'false', 'rviz': 'true'}, {'rviz2'}, 0),
    ],
)
def test_each_part_starts_on_request(
    launch: Any, given: dict[str, str], nodes: set[str], drivers: int
) -> None:
    slam = launch('slam', **given)
    assert (set(slam.nodes), len(slam.drivers)) == (nodes, drivers)


def test_a_file_of_parameters_has_the_last_word_after_the_cameras(launch: Any) -> None:
    slam = launch('slam', params='mine.yaml')
    assert slam.parameters('tracker')[-1] == 'mine.yaml'
    assert slam.parameters('mapper') == [D435I, 'mine.yaml']
    assert launch('slam', camera='none', params='mine.yaml').parameters('mapper') == ['mine.yaml']
    assert launch('slam', camera='none').parameters('mapper') == []


@pytest.mark.parametrize('name', ['source', 'bag'])
def test_replay_plays_to_a_tracker_that_loses_nothing(launch: Any, name: str) -> None:
    replay = launch('replay', **{name: '/bags/2026'}, rate='0.5', loop='true')
    assert set(replay.nodes) == {'replay', 'tracker', 'mapper'}
    assert not replay.drivers
    assert replay.parameters('tracker') == [{'node.reliability': 'reliable'}]
    (parameters,) = replay.parameters('replay')
    assert (parameters['source'], parameters['rate']) == ('/bags/2026', 0.5)
    assert parameters['loop'] is True
    assert parameters['wait_for_subscribers'] == 1


def test_replay_passes_on_what_is_for_the_others(launch: Any) -> None:
    replay = launch('replay', mapper='false', rviz='true', params='mine.yaml')
    assert set(replay.nodes) == {'replay', 'tracker', 'rviz2'}
    assert replay.parameters('tracker')[-1] == 'mine.yaml'


def test_what_is_set_is_a_setting(launch: Any) -> None:
    (played,) = launch('replay').parameters('replay')
    assert played.keys() <= flatten(ReplaySettings()).keys()
    assert launch('slam').parameters('tracker')[0].keys() <= flatten(TrackerSettings()).keys()


def test_rviz_shows_map_way_pose_and_rendering(launch: Any) -> None:
    arguments = launch('slam', rviz='true').nodes['rviz2'].named['arguments']
    shown = yaml.safe_load(Path(arguments[1]).read_text())['Visualization Manager']
    topics = {d['Topic']['Value'] for d in shown['Displays'] if 'Topic' in d}
    assert topics >= {
        '/gaussian_map',
        '/render/color',
        '/dcgs_tracker/odometry',
        '/dcgs_tracker/path',
    }
    assert shown['Global Options']['Fixed Frame'] == 'map'


def test_a_namespace_holds_all_nodes_topics_and_tf(launch: Any) -> None:
    slam = launch('slam', namespace='robot1', rviz='true')
    replay = launch('replay', namespace='robot1')
    for node in [*slam.nodes.values(), *replay.nodes.values()]:
        assert node.named['namespace'] == 'robot1'
    for node in (slam.nodes['tracker'], slam.nodes['mapper'], slam.nodes['rviz2']):
        assert set(TF) <= set(node.named['remappings'])
    assert replay.nodes['replay'].named['remappings'] == TF[1:]
    (driver,) = slam.drivers
    assert dict(driver.named['launch_arguments'])['camera_namespace'] == 'robot1/camera'
    assert slam.remapped == TF


def test_rviz_follows_topics_into_a_namespace_and_to_another_name(launch: Any) -> None:
    arguments = launch('slam', rviz='true').nodes['rviz2'].named['arguments']
    text = Path(arguments[1]).read_text()
    moved = launch('slam', rviz='true', namespace='a', color_topic='/front/rgb').nodes['rviz2']
    remapped = dict(moved.named['remappings'])
    shown = yaml.safe_load(text)['Visualization Manager']['Displays']
    topics = {display['Topic']['Value'] for display in shown if 'Topic' in display}
    assert topics <= remapped.keys()
    assert remapped['/camera/camera/color/image_raw'] == '/front/rgb'
    assert remapped['/gaussian_map'] == 'gaussian_map'


def test_without_a_namespace_nothing_is_remapped(launch: Any) -> None:
    slam = launch('slam')
    assert not slam.remapped and 'camera_namespace' not in dict(
        slam.drivers[0].named['launch_arguments']
    )
    for node in slam.nodes.values():
        assert node.named['namespace'] == '' and node.named['remappings'] == []


def test_topics_frame_tf_and_time_are_arguments_with_the_last_word(launch: Any) -> None:
    slam = launch(
        'slam', camera='none', params='mine.yaml', color_topic='/front/rgb', depth_topic='depth',
        camera_info_topic='/front/info', base_frame='base_link', tf='none', use_sim_time='true',
    )  # fmt: skip
    assert slam.nodes['tracker'].named['remappings'] == [
        ('camera/camera/color/image_raw', '/front/rgb'),
        ('camera/camera/aligned_depth_to_color/image_raw', 'depth'),
        ('camera/camera/color/camera_info', '/front/info'),
    ]
    after = slam.parameters('tracker')[slam.parameters('tracker').index('mine.yaml') + 1 :]
    assert {key: value for given in after for key, value in given.items()} == {
        'node.base_frame': 'base_link', 'node.tf': 'none', 'use_sim_time': True,
    }  # fmt: skip
    of_mapper = [{'node.base_frame': 'base_link'}, {'use_sim_time': True}]
    assert slam.parameters('mapper') == ['mine.yaml', *of_mapper]
    replay = launch('replay', base_frame='base_link', tf='none', use_sim_time='true')
    assert {'node.base_frame': 'base_link'} in replay.parameters('tracker')
    assert {'use_sim_time': True} in replay.parameters('mapper')
    assert 'use_sim_time' not in replay.parameters('replay')[0]  # it makes the time


def test_a_replay_waits_for_the_tracker_itself(launch: Any) -> None:
    """RViz or a recorder may subscribe to the camera's topics sooner."""
    assert launch('replay').parameters('replay')[0]['wait_for_node'] == 'dcgs_tracker'


def test_topics_of_other_sensors_turn_their_priors_on(launch: Any) -> None:
    given = {'imu_topic': 'camera/camera/imu', 'odom_topic': '/wheels'}
    expected = {
        'node.imu_topic': 'camera/camera/imu', 'priors.gyro': True,
        'node.odometry_topic': '/wheels', 'priors.wheels': True,
    }  # fmt: skip
    for name in ('slam', 'replay'):
        last: dict[str, object] = {}
        for parameters in launch(name, **given).parameters('tracker')[-2:]:
            last |= parameters
        assert last == expected
    assert expected.keys() <= flatten(TrackerSettings()).keys()
    (driver,) = launch('slam', **given).drivers
    assert dict(driver.named['launch_arguments'])['enable_gyro'] == 'true'
    (driver,) = launch('slam', odom_topic='/wheels').drivers
    assert 'enable_gyro' not in dict(driver.named['launch_arguments'])


def test_a_robot_has_its_sensors_its_filter_and_a_grid_for_nav2(launch: Any) -> None:
    robot = launch('robot')
    assert set(robot.nodes) == {'tracker', 'mapper', 'ekf_node'}
    assert ('grid', 'map') in robot.nodes['mapper'].named['remappings']
    assert D435I in robot.parameters('tracker')
    assert {'node.imu_topic': 'camera/camera/imu', 'priors.gyro': True} in (
        robot.parameters('tracker')
    )
    (driver,) = robot.drivers
    assert dict(driver.named['launch_arguments'])['enable_gyro'] == 'true'
    file, clock = robot.parameters('ekf_node')
    assert clock == {'use_sim_time': False}
    (ekf,) = yaml.safe_load(Path(file).read_text()).values()
    assert ekf['ros__parameters']['publish_tf'] is True
    for name in ('odom0_config', 'imu0_config'):
        assert len(ekf['ros__parameters'][name]) == 15


def test_a_robot_may_have_its_own_filter_and_start_nav2(launch: Any) -> None:
    robot = launch('robot', ekf='false', nav2_params='nav2.yaml', use_sim_time='true')
    assert set(robot.nodes) == {'tracker', 'mapper'}
    _, nav2 = robot.drivers
    assert nav2.values[0].values[0] == '/nav2_bringup/launch/navigation_launch.py'
    assert dict(nav2.named['launch_arguments']) == {
        'params_file': 'nav2.yaml', 'use_sim_time': 'true',
    }  # fmt: skip
    assert {'use_sim_time': True} in robot.parameters('mapper')


def test_the_robots_parameters_are_settings_of_the_nodes() -> None:
    (file,) = yaml.safe_load((ROOT / 'config' / 'robot' / 'dcgs.yaml').read_text()).values()
    given = {
        f'{stage}.{name}': value
        for stage, values in file['ros__parameters'].items()
        for name, value in values.items()
    }
    tracker, mapper = flatten(TrackerSettings()), flatten(MapperSettings())
    assert given.keys() <= tracker.keys() | mapper.keys()
    for settings, known in ((TrackerSettings(), tracker), (MapperSettings(), mapper)):
        override(settings, {key: str(value) for key, value in given.items() if key in known})
