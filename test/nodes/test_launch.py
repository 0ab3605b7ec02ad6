# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What the launch files start. The wheels have no `launch`: a stand-in with its interface is used.

It executes what a description holds in order, as launch does, and records what would be started.
"""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

from dcgs_ros.core.config.nodes import ReplaySettings, TrackerSettings
from dcgs_ros.core.config.schema import flatten

ROOT = Path(__file__).resolve().parents[2]
VARIABLE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
D435I = str(ROOT / 'config' / 'd435i.yaml')


class Recorded:
    """Anything of launch: what it was made with."""

    def __init__(self, *values: Any, **named: Any) -> None:
        self.values, self.named = values, named


class Argument(Recorded):
    """DeclareLaunchArgument."""


class Include(Recorded):
    """IncludeLaunchDescription."""


class Call(Recorded):
    """OpaqueFunction."""


class Set(Recorded):
    """SetEnvironmentVariable."""


class Node(Recorded):
    """launch_ros's Node."""


class Configuration(Recorded):
    """LaunchConfiguration."""

    def perform(self, context: Launched) -> str:
        return context.given[self.values[0]]


class Variable(Recorded):
    """EnvironmentVariable."""

    def perform(self, context: Launched) -> str:
        return context.environment.get(self.values[0], self.named['default_value'])


class Source(Recorded):
    """PythonLaunchDescriptionSource."""


MODULES: dict[str, dict[str, Any]] = {
    'ament_index_python': {},
    'ament_index_python.packages': {
        'get_package_share_directory': lambda name: str(ROOT if name == 'dcgs_ros' else f'/{name}')
    },
    'launch': {
        'LaunchContext': object,
        'LaunchDescription': list,
        'LaunchDescriptionEntity': object,
    },
    'launch.actions': {
        'DeclareLaunchArgument': Argument,
        'IncludeLaunchDescription': Include,
        'OpaqueFunction': Call,
        'SetEnvironmentVariable': Set,
    },
    'launch.launch_description_sources': {'PythonLaunchDescriptionSource': Source},
    'launch.substitutions': {
        'EnvironmentVariable': Variable,
        'LaunchConfiguration': Configuration,
    },
    'launch_ros': {},
    'launch_ros.actions': {'Node': Node},
    'launch_ros.parameter_descriptions': {'ParameterValue': lambda value, value_type: value},
}


class Launched:
    """What a launch file started."""

    def __init__(self, name: str, given: dict[str, str], environment: dict[str, str]) -> None:
        self.given, self.environment = dict(given), environment
        self.nodes: dict[str, Node] = {}
        self.drivers: list[Include] = []
        self.environments: dict[str, dict[str, str]] = {}
        self._file(ROOT / 'launch' / f'{name}.launch.py')

    def parameters(self, node: str) -> list[Any]:
        return self.nodes[node].named['parameters']

    def _file(self, path: Path) -> None:
        for entity in runpy.run_path(str(path))['generate_launch_description']():
            self._execute(entity)

    def _execute(self, entity: Any) -> None:
        if isinstance(entity, Argument):
            assert entity.named['description']
            value = self.given.setdefault(entity.values[0], entity.named['default_value'])
            assert value in entity.named.get('choices', [value])
        elif isinstance(entity, Set):
            self.environment[entity.values[0]] = entity.values[1].perform(self)
        elif isinstance(entity, Call):
            for started in entity.named['function'](self):
                self._execute(started)
        elif isinstance(entity, Node):
            name = entity.named['executable']
            self.nodes[name] = entity
            self.environments[name] = dict(self.environment)
        else:
            self._include(entity)

    def _include(self, entity: Include) -> None:
        path = Path(entity.values[0].values[0])
        if ROOT not in path.parents:
            self.drivers.append(entity)
            self.environments['driver'] = dict(self.environment)
            return
        for name, value in entity.named['launch_arguments']:
            self.given[name] = value if isinstance(value, str) else value.perform(self)
        self._file(path)


@pytest.fixture
def launch(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return what launches a file with arguments, in an empty environment or another."""
    for name, content in MODULES.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)

    def launched(name: str, environment: dict[str, str] | None = None, **given: str) -> Launched:
        return Launched(name, given, dict(environment or {}))

    return launched


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


def test_a_file_of_parameters_replaces_the_cameras_and_has_the_last_word(launch: Any) -> None:
    slam = launch('slam', params='mine.yaml')
    assert slam.parameters('tracker')[-1] == 'mine.yaml'
    assert slam.parameters('mapper') == ['mine.yaml']
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
    assert shown['Global Options']['Fixed Frame'] == TrackerSettings().node.odom_frame
