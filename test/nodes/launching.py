# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What the launch files start. The wheels have no `launch`: a stand-in with its interface is used.

It executes what a description holds in order, as launch does, and records what would be started.
"""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from subprocess import Popen
from types import ModuleType
from typing import Any

import pytest

from dcgs_ros.nodes.harness.processes import Processes

ROOT = Path(__file__).resolve().parents[2]


class Recorded:
    """Anything of launch: what it was made with."""

    def __init__(self, *values: Any, **named: Any) -> None:
        self.values, self.named = values, named


class Argument(Recorded):
    """DeclareLaunchArgument."""

    @property
    def name(self) -> str:
        return str(self.values[0])


class Group(Recorded):
    """GroupAction."""


class Remap(Recorded):
    """SetRemap: of the nodes that follow in its group."""


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
        'GroupAction': Group,
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
    'launch_ros.actions': {'Node': Node, 'SetRemap': Remap},
    'launch_ros.parameter_descriptions': {'ParameterValue': lambda value, value_type: value},
}


class Launched:
    """What a launch file started."""

    def __init__(self, name: str, given: dict[str, str], environment: dict[str, str]) -> None:
        self.given, self.environment = dict(given), environment
        self.nodes: dict[str, Node] = {}
        self.drivers: list[Include] = []
        self.remapped: list[tuple[str, str]] = []  # for the drivers
        self.environments: dict[str, dict[str, str]] = {}
        self._file(ROOT / 'launch' / f'{name}.launch.py')

    def parameters(self, node: str) -> list[Any]:
        return self.nodes[node].named['parameters']

    def start(self, processes: Processes) -> dict[str, Popen[bytes]]:
        """Start the nodes of this package as processes; parameters in launch's order."""
        started = {}
        for name, node in self.nodes.items():
            files = [Path(given) for given in self.parameters(name) if isinstance(given, str)]
            given = [given for given in self.parameters(name) if isinstance(given, dict)]
            parameters = {key: value for values in given for key, value in values.items()}
            remappings = tuple(node.named.get('remappings', ()))
            if node.named.get('namespace'):
                remappings += (('__ns', f'/{node.named["namespace"]}'),)
            file = files[0] if files else None
            started[name] = processes.start(name, parameters, file, (), remappings)
        return started

    def _file(self, path: Path) -> None:
        for entity in runpy.run_path(str(path))['generate_launch_description']():
            self._execute(entity)

    def _execute(self, entity: Any) -> None:
        if isinstance(entity, Argument):
            assert entity.named['description']
            value = self.given.setdefault(entity.name, entity.named['default_value'])
            assert value in entity.named.get('choices', [value])
        elif isinstance(entity, Set):
            self.environment[entity.values[0]] = entity.values[1].perform(self)
        elif isinstance(entity, Call):
            for started in entity.named['function'](self):
                self._execute(started)
        elif isinstance(entity, Group):
            for started in entity.values[0]:
                self._execute(started)
        elif isinstance(entity, Remap):
            self.remapped.append(entity.values)
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


def launcher(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Launched]:
    """Return what launches a file with arguments, in an empty environment or another."""
    for name, content in MODULES.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)

    def launched(name: str, environment: dict[str, str] | None = None, **given: str) -> Launched:
        return Launched(name, given, dict(environment or {}))

    return launched
