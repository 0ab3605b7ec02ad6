# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What colcon, pip and the layering rely on."""

from __future__ import annotations

import ast
import importlib
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path

import pytest

import dcgs_ros

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ElementTree.parse(ROOT / 'package.xml').getroot()
SETUP = (ROOT / 'setup.py').read_text()
FOLDERS = ('dcgs_ros', 'test', 'benchmarks', 'launch')
ROS = {
    'ament_index_python',
    'builtin_interfaces',
    'diagnostic_msgs',
    'geometry_msgs',
    'launch',
    'launch_ros',
    'nav_msgs',
    'rcl_interfaces',
    'rclpy',
    'rosgraph_msgs',
    'sensor_msgs',
    'std_msgs',
    'std_srvs',
    'tf2_ros',
    'visualization_msgs',
}
APT = {'PyYAML': 'yaml', 'opencv-python-headless': 'opencv'}  # names that differ from PyPI's
SOURCES = [ROOT / 'setup.py', *(p for name in FOLDERS for p in (ROOT / name).rglob('*.py'))]

LoadedAfter = Callable[[str], set[str]]

IMPORT_ALL = """
import importlib, pkgutil
package = importlib.import_module({package!r})
for module in pkgutil.walk_packages(package.__path__, package.__name__ + '.'):
    importlib.import_module(module.name)
"""


def imported_by(path: Path) -> set[str]:
    """Return the top-level modules that a file imports anywhere."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add(node.module or '')
    return {name.split('.')[0] for name in names}


def test_versions_agree() -> None:
    in_setup = re.search(r"version='([^']+)'", SETUP)
    assert in_setup is not None
    assert in_setup[1] == PACKAGE.findtext('version') == dcgs_ros.__version__


def test_colcon_takes_it_for_an_ament_python_package() -> None:
    assert PACKAGE.get('format') == '3'
    assert PACKAGE.findtext('name') == 'dcgs_ros'
    assert PACKAGE.findtext('export/build_type') == 'ament_python'
    # With a maintainer address it does not like, colcon silently builds something else.
    maintainer = PACKAGE.find('maintainer')
    assert maintainer is not None
    assert re.fullmatch(r'[-\w.+]+@[-\w]+(\.[-\w]+)+', maintainer.get('email', ''))
    assert (ROOT / 'resource' / 'dcgs_ros').is_file()


def test_entry_points_lead_to_functions() -> None:
    entries = re.findall(r"'(\w+) = ([\w.]+):(\w+)'", SETUP)
    assert {name for name, _, _ in entries} == {'dcgs', 'mapper', 'replay', 'tracker'}
    for _, module, function in entries:
        if '.nodes.' in module:
            pytest.importorskip('rclpy')
        assert callable(getattr(importlib.import_module(module), function))


def test_what_nodes_and_launch_files_read_is_installed() -> None:
    patterns = re.findall(r"glob\('([^']+)'\)", SETUP)
    installed = {path for pattern in patterns for path in ROOT.glob(pattern)}
    assert installed >= {ROOT / 'config' / name for name in ('fastdds.xml', 'dcgs.rviz')}
    assert installed >= {ROOT / 'launch' / f'{name}.launch.py' for name in ('slam', 'replay')}
    assert installed >= set((ROOT / 'config').glob('*.yaml'))
    assert all(path.is_file() for path in installed)


def test_rosdep_installs_what_is_imported() -> None:
    named = {element.text for element in PACKAGE.findall('exec_depend')}
    imported = set.union(*(imported_by(path) for path in SOURCES if 'test' not in path.parts))
    wanted = {'tf2_ros_py' if name == 'tf2_ros' else name for name in imported & ROS}
    assert 'rclpy' in wanted
    assert wanted <= named
    required = re.search(r'install_requires=\[(.*?)\]', SETUP, re.DOTALL)
    assert required is not None
    for name in re.findall(r"'([\w-]+)", required[1]):
        if name not in ('numba', 'tyro'):  # only pip has them, in the versions we need
            assert f'python3-{APT.get(name, name)}' in named


def test_the_wheels_of_ros_are_pinned_as_they_are_asked_for() -> None:
    pins = (ROOT / 'constraints.txt').read_text().splitlines()
    wheels = re.findall(r"'(ros-jazzy-[\w-]+)(?:\[\w+\])?(==[\d.]+)'", SETUP)
    assert len(wheels) == 2
    assert all(name + version in pins for name, version in wheels)


@pytest.mark.parametrize('ring', ['core', 'datasets', 'io', 'evaluation', 'cli'])
def test_only_nodes_import_ros(ring: str) -> None:
    for path in (ROOT / 'dcgs_ros' / ring).rglob('*.py'):
        assert not imported_by(path) & ROS, path


def test_core_needs_no_ros_no_torch_and_none_of_the_outer_rings(loaded_after: LoadedAfter) -> None:
    loaded = loaded_after(IMPORT_ALL.format(package='dcgs_ros.core'))
    assert 'dcgs_ros.core.camera' in loaded
    assert not loaded & {'rclpy', 'torch', 'matplotlib', 'tqdm', 'tyro'}
    outer = {'datasets', 'io', 'evaluation', 'nodes', 'cli'}
    assert not {name for name in loaded if name.split('.')[:1] == ['dcgs_ros']} & {
        f'dcgs_ros.{ring}' for ring in outer
    }


@pytest.mark.parametrize('module', ['dcgs_ros.core.tracking.tracker', 'dcgs_ros.nodes.tracker'])
def test_tracking_loads_neither_mapper_nor_renderer(
    module: str, loaded_after: LoadedAfter
) -> None:
    if '.nodes.' in module:
        pytest.importorskip('rclpy')
    loaded = loaded_after(f'import {module}')
    assert module in loaded
    others = ('dcgs_ros.core.mapping', 'dcgs_ros.core.render', 'dcgs_ros.core.slam')
    assert not [name for name in loaded if name.startswith(others)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ('ring', 'outside'),
    [('io', {'datasets', 'evaluation'}), ('datasets', {'evaluation'}), ('evaluation', set())],
)
def test_the_middle_ring_needs_no_ros_and_nothing_outside_it(
    ring: str, outside: set[str], loaded_after: LoadedAfter
) -> None:
    loaded = loaded_after(IMPORT_ALL.format(package=f'dcgs_ros.{ring}'))
    assert not loaded & {'rclpy', 'torch', 'tyro', 'matplotlib.pyplot', 'evo'}
    assert not loaded & {f'dcgs_ros.{name}' for name in outside | {'nodes', 'cli'}}


@pytest.mark.parametrize('path', SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_file_names_its_licence(path: Path) -> None:
    lines = path.read_text().splitlines()
    lines = lines[1:] if lines and lines[0].startswith('#!') else lines
    assert lines[:2] == [
        '# SPDX-FileCopyrightText: 2026 The dcgs_ros authors',
        '# SPDX-License-Identifier: BSD-3-Clause',
    ]
