# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Settings files: what is written reads back equal, and what is wrong is named."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import yaml

from dcgs_ros.core.config.schema import ConfigError, flatten, override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.sensor import SensorNoise
from dcgs_ros.datasets.camera_presets import PRESETS
from dcgs_ros.io.config_file import apply_file, write_config

CONFIG = Path(__file__).resolve().parents[2] / 'config'
AWKWARD = {
    'ablation': 'shared_klt',
    'threads': 2,
    'sensor.a_m': 1e-5 / 3,
    'timing.colour_depth_offset_ms': -7.25,
    'registration.tolerance_rad': 1.25e-9,
}


BILLION_LAUGHS = '\n'.join(
    ['k0: &k0 {a: 1}', *(f'k{n}: &k{n} {{a: *k{n - 1}, b: *k{n - 1}}}' for n in range(1, 60))]
)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / 'settings.yaml'


@pytest.mark.parametrize('config', [Config(), override(Config(), AWKWARD)])
def test_a_written_configuration_reads_back_equal(file: Path, config: Config) -> None:
    write_config(file, config)
    assert apply_file(Config(), file) == config
    other = override(Config(), {'threads': 1, 'sensor.a_m': 0.5, 'cloud.stride_px': 3})
    assert apply_file(other, file) == config


def test_every_field_is_written(file: Path) -> None:
    write_config(file, Config())
    written = yaml.safe_load(file.read_text())
    assert written == dataclasses.asdict(Config())


@pytest.mark.parametrize(
    'text',
    [
        'sensor: {a_m: 0.5}\nthreads: 1',
        'sensor.a_m: 0.5\nthreads: 1',
        '/**:\n  ros__parameters:\n    sensor: {a_m: 0.5}\n    threads: 1',
        'dcgs_tracker:\n  ros__parameters: {sensor.a_m: 0.5, threads: 1}',
        '/robot:\n  dcgs_tracker:\n    ros__parameters: {sensor: {a_m: 0.5}, threads: 1}',
        '/**: {ros__parameters: {sensor: {a_m: 7}, threads: 1}}\n'
        'dcgs_tracker: {ros__parameters: {sensor: {a_m: 0.5}}}',
    ],
)
def test_plain_and_ros_forms_say_the_same(file: Path, text: str) -> None:
    file.write_text(text)
    wanted = override(Config(), {'sensor.a_m': 0.5, 'threads': 1})
    assert apply_file(Config(), file) == wanted


@pytest.mark.parametrize('text', ['', '# nothing\n', '{}', '/**:\n  ros__parameters:\n'])
def test_an_empty_file_sets_nothing(file: Path, text: str) -> None:
    file.write_text(text)
    config = Config(sensor=SensorNoise.floor())
    assert apply_file(config, file) == config


def test_an_unknown_key_is_answered_with_the_valid_ones(file: Path) -> None:
    file.write_text('/**: {ros__parameters: {sensor: {a_mm: 1}}}')
    with pytest.raises(ConfigError) as caught:
        apply_file(Config(), file)
    message = str(caught.value)
    assert str(file) in message
    assert "'sensor.a_mm'" in message
    assert all(key in message for key in flatten(Config()))


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        ('- 1\n- 2\n', 'holds a list'),
        ('just words', 'holds a str'),
        ('a: [1', 'in line'),
        ('a: b: c', 'in line 1'),
        ('\x00', 'no YAML'),
        ('a: ' + '[' * 3000 + ']' * 3000, 'no YAML: more than 100 brackets within each other'),
        ('{a: ' * 3000, 'no YAML: more than 100 brackets within each other'),
        ('- ' * 3000, 'no YAML: its blocks are nested too deeply'),
        ('a: &a [*a]', 'more than 10000 values; does an alias'),
        ('a: &a {b: *a}', 'more than 10000 values; does an alias'),
        (BILLION_LAUGHS, 'more than 10000 values; does an alias'),
        ('a: *b', "no YAML: found undefined alias 'b' in line 1"),
        ('a: !!int ""', 'no YAML: '),
        ('threads: ' + '1:' * 200 + '1.0', 'no YAML: '),
        ('a: !!python/object/apply:os.system ["true"]', 'no YAML: could not determine a constr'),
        ('a: ' + 'x' * 2**20, 'more than 1048576 bytes'),
        ('sensor: 5', "unknown setting 'sensor'"),
        ('sensor: {a_m: wide}', "'wide'"),
        ('sensor: {a_m: .nan}', 'sensor.a_m is nan'),
        ('sensor: {a_m: [1, 2]}', 'sensor.a_m'),
        ('sensor: {a_m: -1}', 'a_m > 0'),
        ('cloud: {stride_px: 2.5}', 'cloud.stride_px'),
        ('ablation: best', 'shared_klt'),
        ('1: 2', "unknown setting '1'"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(file: Path, text: str, reason: str) -> None:
    file.write_text(text)
    with pytest.raises(ConfigError) as caught:
        apply_file(Config(), file)
    message = str(caught.value)
    assert message.startswith(f'{file}: ')
    assert reason in message
    assert '\n' not in message


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    for path in (tmp_path / 'none.yaml', tmp_path):
        with pytest.raises(ConfigError, match=f'{path}: cannot be read'):
            apply_file(Config(), path)


@pytest.mark.parametrize('preset', PRESETS)
def test_a_cameras_file_sets_its_presets_sensor(preset: str) -> None:
    other = Config(sensor=SensorNoise(a_m=0.003))
    name = f'tum_{preset}' if preset.startswith('fr') else preset
    config = apply_file(other, CONFIG / f'{name}.yaml')
    assert config == dataclasses.replace(other, sensor=PRESETS[preset].sensor)
