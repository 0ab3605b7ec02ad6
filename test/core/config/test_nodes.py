# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Settings of the nodes, and the files they are set by."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import pytest

from dcgs_ros.core.config.nodes import MapperSettings, ReplaySettings, TrackerSettings
from dcgs_ros.core.config.schema import ConfigError, flatten, override, settings
from dcgs_ros.core.config.stages import Config
from dcgs_ros.datasets.camera_presets import PRESETS
from dcgs_ros.io.config_file import apply_file, write_config

ROOT = Path(__file__).resolve().parents[3]
# Others are of a robot, and of several nodes.
CAMERA_FILES = [
    path for path in sorted((ROOT / 'config').glob('*.yaml')) if not path.stem.startswith('robot')
]
ALL = [TrackerSettings(), MapperSettings(), ReplaySettings()]
UNITS = {
    '_m': 'metre',
    '_per_m': '1/metre',
    '_rad': 'radian',
    '_rad_s': 'radians per second',
    '_px': 'pixel',
    '_s': 'second',
    '_ms': 'millisecond',
    '_hz': 'hertz',
    '_mb': 'megabyte',
}


@pytest.mark.parametrize('of_node', ALL, ids=lambda node: type(node).__name__)
def test_every_setting_says_what_it_is_and_its_unit(of_node: Any) -> None:
    for setting in settings(of_node):
        name = setting.key.split('.')[-1]
        assert setting.doc == setting.doc.strip() and setting.doc.endswith('.'), setting.key
        suffixes = [suffix for suffix in UNITS if name.endswith(suffix)]
        if suffixes:
            assert UNITS[max(suffixes, key=len)] in setting.doc, setting.key
        if setting.range is not None and setting.value is not None:
            assert setting.range[0] <= setting.value <= setting.range[1]


def test_there_is_no_setting_that_nothing_reads() -> None:
    read = {
        node.attr
        for path in (ROOT / 'dcgs_ros').rglob('*.py')
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Attribute)
    }
    for of_node in ALL:
        assert {key.split('.')[-1] for key in flatten(of_node)} <= read


@pytest.mark.parametrize('of_node', ALL, ids=lambda node: type(node).__name__)
def test_every_setting_survives_being_text(of_node: Any) -> None:
    for key, value in flatten(of_node).items():
        assert override(of_node, {key: str(value)}) == of_node, key


@pytest.mark.parametrize('of_node', [TrackerSettings(), MapperSettings()])
def test_tracker_and_mapper_have_all_settings_of_a_run(of_node: Config) -> None:
    run, node = flatten(Config()), flatten(of_node)
    assert {key: node[key] for key in run} == run
    own = ('node.', 'grid.', 'obstacles.')
    assert all(key.startswith(own) for key in node.keys() - run.keys())


@pytest.mark.parametrize('path', CAMERA_FILES, ids=lambda p: p.stem)
def test_files_of_parameters_hold_what_the_camera_is_known_by(path: Path) -> None:
    """They load as they are, and cannot drift from the presets."""
    sensor = PRESETS[path.stem.removeprefix('tum_')].sensor
    for defaults in (Config(), TrackerSettings(), MapperSettings()):
        assert apply_file(defaults, path).sensor == sensor


def test_what_was_written_is_read_with_text_and_truth(tmp_path: Path) -> None:
    values = {'node.base_frame': 'base_link', 'node.resume': False, 'threads': 'auto'}
    changed = override(TrackerSettings(), values)
    assert (changed.node.base_frame, changed.node.resume) == ('base_link', False)
    write_config(tmp_path / 'a.yaml', changed)
    assert apply_file(TrackerSettings(), tmp_path / 'a.yaml') == changed


@pytest.mark.parametrize(
    ('key', 'value'),
    [
        ('node.resume', 1),
        ('node.resume', 'yes'),
        ('node.resume', None),
        ('node.base_frame', 5),
        ('node.base_frame', None),
        ('node.tf', 'odom'),
        ('node.sync_slop_s', True),
        ('node.sync_slop_s', -0.1),
        ('node.map_rate_hz', 1.0),  # the mapper's
    ],
)
def test_what_a_setting_cannot_hold_is_refused(key: str, value: object) -> None:
    with pytest.raises(ConfigError, match=key.split('.')[-1]):
        override(TrackerSettings(), {key: value})
