# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Settings as ROS parameters, on real nodes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

pytest.importorskip('rclpy')

import rclpy
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import DescribeParameters, SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from dcgs_ros.core.config.nodes import MapperSettings, ReplaySettings, TrackerSettings
from dcgs_ros.core.config.schema import ConfigError, flatten, override, settings
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.errors import DcgsError
from dcgs_ros.io.config_file import apply_file
from dcgs_ros.nodes.parameters import Parameters

ROOT = Path(__file__).resolve().parents[2]
TYPES = {
    int: ParameterType.PARAMETER_INTEGER,
    float: ParameterType.PARAMETER_DOUBLE,
    bool: ParameterType.PARAMETER_BOOL,
    str: ParameterType.PARAMETER_STRING,
}
ANSWER_S = 120.0

Declare = Callable[..., tuple[Node, Parameters[Any], list[Any]]]


@pytest.fixture
def declare(ros: None) -> Iterator[Declare]:
    """Return a maker of nodes with parameters, and of the list of their changes."""
    nodes: list[Node] = []

    def make(
        defaults: Any, *arguments: str, fixed: str = 'sensor'
    ) -> tuple[Node, Parameters[Any], list[Any]]:
        command = ['--ros-args', *arguments]
        nodes.append(rclpy.create_node(f'n{len(nodes)}', cli_args=command))
        changes: list[Any] = []
        live = lambda key: not key.startswith(fixed)  # noqa: E731
        return nodes[-1], Parameters(nodes[-1], defaults, live, changes.append), changes

    yield make
    for node in nodes:
        node.destroy_node()


def attempt(node: Node, **values: Any) -> list[str]:
    """Set parameters, with `__` for a dot, all or none; return the reasons against it."""
    parameters = [Parameter(key.replace('__', '.'), value=value) for key, value in values.items()]
    result = node.set_parameters_atomically(parameters)
    return [] if result.successful else [result.reason]


def read(node: Node, key: str) -> Any:
    return node.get_parameter(key).value


@pytest.mark.parametrize(
    'defaults', [TrackerSettings(), MapperSettings(), ReplaySettings()], ids=lambda d: type(d)
)
def test_every_setting_is_a_parameter_that_describes_itself(
    declare: Declare, defaults: Any
) -> None:
    node, parameters, _ = declare(defaults)
    assert parameters.settings == defaults
    for setting in settings(defaults):
        described = node.describe_parameter(setting.key)
        assert described.description == setting.doc
        assert described.read_only == setting.key.startswith('sensor')
        shown = 'auto' if setting.value is None else setting.value
        assert read(node, setting.key) == shown
        if not setting.optional:
            assert described.type == TYPES[setting.kind]
        assert all(choice in described.additional_constraints for choice in setting.choices)
        ranges = [*described.integer_range, *described.floating_point_range]
        bounds = [(r.from_value, r.to_value) for r in ranges]
        assert bounds == ([setting.range] if setting.range is not None else [])


@pytest.mark.parametrize('path', sorted((ROOT / 'config').glob('*.yaml')), ids=lambda p: p.stem)
def test_files_of_parameters_load_as_they_are(declare: Declare, path: Path) -> None:
    _, parameters, _ = declare(TrackerSettings(), '--params-file', str(path))
    assert parameters.settings == apply_file(TrackerSettings(), path)
    assert parameters.settings.sensor == apply_file(Config(), path).sensor


def test_each_node_takes_its_own_of_a_robots_file(declare: Declare) -> None:
    """Priors are the tracker's, the grid is the mapper's; neither minds the other's."""
    words = ('--params-file', str(ROOT / 'config' / 'robot' / 'dcgs.yaml'))
    _, tracker, _ = declare(TrackerSettings(), *words)
    assert tracker.settings.node.tf == 'map_to_odom'
    assert tracker.settings.priors.wheels
    _, mapper, _ = declare(MapperSettings(), *words)
    assert mapper.settings.grid.max_height_m == 0.8
    assert mapper.settings.node.base_frame == 'base_link'


def test_a_value_may_come_as_integer_as_auto_and_from_the_command_line(declare: Declare) -> None:
    node, parameters, _ = declare(
        TrackerSettings(),
        *('-p', 'keyframes.translation_m:=2', '-p', 'threads:=3'),
        *('-p', 'timing.colour_depth_offset_ms:=auto', '-p', 'node.base_frame:=base_link'),
    )
    assert parameters.settings == override(
        TrackerSettings(),
        {'keyframes.translation_m': 2, 'threads': 3, 'node.base_frame': 'base_link'},
    )
    assert read(node, 'keyframes.translation_m') == 2.0
    assert read(node, 'threads') == 3


def test_what_is_given_for_no_setting_of_a_stage_is_refused(declare: Declare) -> None:
    with pytest.raises(ConfigError, match=r'keyframes\.translation\b') as refused:
        declare(TrackerSettings(), '-p', 'keyframes.translation:=0.1', '-p', 'nodes.x:=1')
    assert 'keyframes.translation_m' in str(refused.value)
    assert 'nodes.x' not in str(refused.value)  # who knows whose that is


@pytest.mark.parametrize(
    'given', ['keyframes.overlap:=7.0', 'threads:=many', 'ablation:=best', 'sensor.a_m:=-1.0']
)
def test_a_bad_value_at_the_start_is_refused_by_name(declare: Declare, given: str) -> None:
    with pytest.raises(DcgsError, match=given.split(':')[0].split('.')[-1]):
        declare(TrackerSettings(), '-p', given)


def test_a_change_reaches_the_settings_and_is_told_once(declare: Declare) -> None:
    node, parameters, changes = declare(TrackerSettings())
    assert not attempt(node, keyframes__translation_m=1, keyframes__overlap=0.5, threads=2)
    expected = override(
        TrackerSettings(),
        {'keyframes.translation_m': 1.0, 'keyframes.overlap': 0.5, 'threads': 2},
    )
    assert changes == [expected]
    assert parameters.settings == expected
    assert read(node, 'keyframes.translation_m') == 1.0
    assert not attempt(node, threads='auto')
    assert parameters.settings.threads is None
    assert not attempt(node, threads='auto')
    assert len(changes) == 2  # nothing changed the second time


@pytest.mark.parametrize(
    ('values', 'reason'),
    [
        ({'keyframes__overlap': 7.0}, 'overlap'),
        ({'keyframes__overlap': 'x'}, 'type'),
        ({'threads': 'many'}, "threads is 'many'"),
        ({'threads': 0}, 'threads'),
        ({'threads': 1.5}, 'threads is 1.5'),
        ({'timing__colour_depth_offset_ms': 1000}, 'colour_depth_offset_ms'),
        ({'ablation': 'best'}, 'shared_klt'),
        ({'node__resume': 'true'}, 'type'),
        ({'sensor__depth_max_m': 9.0}, 'read-only'),
    ],
)
def test_a_bad_change_is_refused_with_its_reason_and_nothing_changes(
    declare: Declare, values: dict[str, Any], reason: str
) -> None:
    node, parameters, changes = declare(TrackerSettings())
    before = {key: read(node, key) for key in flatten(TrackerSettings())}
    assert reason in attempt(node, keyframes__translation_m=1.0, **values)[0]
    assert {key: read(node, key) for key in before} == before
    assert (parameters.settings, changes) == (TrackerSettings(), [])


def test_what_only_fits_other_settings_is_checked_against_them(declare: Declare) -> None:
    node, parameters, _ = declare(TrackerSettings(), fixed='nothing')
    assert 'depth_min_m' in attempt(node, sensor__depth_max_m=0.1)[0]
    assert not attempt(node, sensor__depth_max_m=0.1, sensor__depth_min_m=0.05)
    assert parameters.settings.sensor.depth_max_m == 0.1


def test_a_setting_cannot_be_deleted(declare: Declare) -> None:
    node, _, _ = declare(TrackerSettings())
    deleted = node.set_parameters([Parameter('threads', Parameter.Type.NOT_SET)])
    assert not deleted[0].successful
    assert read(node, 'threads') == 'auto'


def test_other_parameters_of_the_node_stay_its_own(declare: Declare) -> None:
    node, _, changes = declare(TrackerSettings(), '-p', 'use_sim_time:=true')
    assert read(node, 'use_sim_time') is True
    assert not attempt(node, use_sim_time=False)
    assert changes == []


def test_others_can_ask_and_set_over_the_services(declare: Declare) -> None:
    """What `ros2 param` does."""
    node, parameters, _ = declare(MapperSettings())
    asking = rclpy.create_node('asking')
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    executor.add_node(asking)

    def call(kind: Any, name: str, request: Any) -> Any:
        client = asking.create_client(kind, f'/{node.get_name()}/{name}')
        end = time.monotonic() + ANSWER_S
        while not client.service_is_ready() and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.05)
        answer = client.call_async(request)
        executor.spin_until_future_complete(answer, timeout_sec=ANSWER_S)
        return answer.result()

    names = ['rates.mean_m', 'mapping.max_gaussians']
    described = call(
        DescribeParameters, 'describe_parameters', DescribeParameters.Request(names=names)
    )
    assert all(d.description for d in described.descriptors)
    wanted = Parameter('mapping.max_gaussians', value=5000).to_parameter_msg()
    request = SetParametersAtomically.Request(parameters=[wanted])
    assert call(SetParametersAtomically, 'set_parameters_atomically', request).result.successful
    assert parameters.settings.mapping.max_gaussians == 5000
    asking.destroy_node()


@pytest.mark.parametrize(
    ('defaults', 'given', 'meant'),
    [
        (ReplaySettings(), 'sorce:=synthetic:plane', 'source'),
        (TrackerSettings(), 'base_frame:=base_link', 'node.base_frame'),
        (TrackerSettings(), 'node.base_fram:=base_link', 'node.base_frame'),
        (MapperSettings(), 'node.base_fram:=base_link', 'node.base_frame'),
        (MapperSettings(), 'sensr.a_m:=0.1', 'sensor.a_m'),
        (MapperSettings(), 'max_gaussians:=5', 'mapping.max_gaussians'),
        (TrackerSettings(), 'thread:=2', 'threads'),
    ],
)
def test_a_name_that_is_nearly_right_is_refused_with_the_right_one(
    declare: Declare, defaults: Any, given: str, meant: str
) -> None:
    with pytest.raises(ConfigError) as refused:
        declare(defaults, '-p', given)
    assert f'{given.split(":")[0]} (meant is {meant}' in str(refused.value)


def test_what_resembles_no_setting_is_ignored_and_told(
    declare: Declare, capfd: pytest.CaptureFixture[str]
) -> None:
    """A file may be for the nodes of other packages too."""
    _, parameters, _ = declare(
        TrackerSettings(),
        *('-p', 'robot_description:=x', '-p', 'use_sim_time:=true', '-p', 'amcl.alpha1:=0.2'),
    )
    assert parameters.settings == TrackerSettings()
    told = capfd.readouterr().err
    assert 'unknown parameters are ignored: amcl.alpha1, robot_description' in told
    assert 'use_sim_time' not in told


@pytest.mark.parametrize(
    'defaults', [TrackerSettings(), MapperSettings(), ReplaySettings()], ids=lambda d: type(d)
)
def test_one_file_is_for_all_nodes(
    declare: Declare, defaults: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """What two nodes have under one name, but of two types, is for the one whose type it has."""
    path = tmp_path / 'all.yaml'
    values = {'node.save_on_exit': True, 'node.odom_frame': 'map', 'node.base_frame': 'base_link',
              'node.save_folder': 'maps', 'source': 'synthetic:plane', 'rate': 2.0,
              'sensor.a_m': 0.002}  # fmt: skip
    path.write_text(yaml.safe_dump({'/**': {'ros__parameters': values}}))
    _, parameters, _ = declare(defaults, '--params-file', str(path))
    own = {key: value for key, value in values.items() if key in flatten(defaults)}
    if isinstance(defaults, TrackerSettings):
        del own['node.save_on_exit']  # a folder there
    assert own and parameters.settings == override(defaults, own)
    assert not capfd.readouterr().err
    with pytest.raises(ConfigError, match='save_on_exit'):
        declare(MapperSettings(), '-p', 'node.save_on_exit:=2')
