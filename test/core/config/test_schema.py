# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Settings: walking, replacing and refusing them."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from dcgs_ros.core.config.schema import ConfigError, flatten, nested, override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.sensor import SensorError


def test_flatten_reaches_every_leaf() -> None:
    flat = flatten(Config())
    stages = [f.name for f in dataclasses.fields(Config())]
    assert {key.split('.')[0] for key in flat} == set(stages)
    assert not any(dataclasses.is_dataclass(value) for value in flat.values())
    for key, value in flat.items():
        found: Any = Config()
        for name in key.split('.'):
            found = getattr(found, name)
        assert found == value


@pytest.mark.parametrize('key', flatten(Config()))
def test_each_setting_survives_being_text(key: str) -> None:
    """What a command line or a YAML file hands over is what was meant."""
    value = flatten(Config())[key]
    assert override(Config(), {key: str(value)}) == Config()
    assert override(Config(), {key: value}) == Config()


def test_override_changes_that_setting_alone() -> None:
    before = flatten(Config())
    after = flatten(override(Config(), {'cloud.stride_px': '7', 'registration.radius_m': 0.05}))
    changed = {key: after[key] for key in after if after[key] != before[key]}
    assert changed == {'cloud.stride_px': 7, 'registration.radius_m': 0.05}
    assert isinstance(after['cloud.stride_px'], int)


def test_override_twice_is_override_with_both() -> None:
    one, other = {'cloud.stride_px': 7}, {'landmarks.corners': 50}
    assert override(override(Config(), one), other) == override(Config(), one | other)


def test_nothing_is_none_where_none_is_allowed() -> None:
    config = override(Config(), {'threads': '2', 'timing.colour_depth_offset_ms': 4})
    assert config.threads == 2
    assert config.timing.colour_depth_offset_ms == 4.0
    for nothing in (None, 'none', 'None', 'null', ''):
        assert override(config, {'threads': nothing}).threads is None


def test_nested_flattens_what_yaml_gives() -> None:
    values = {'ablation': 'sigma_t', 'cloud': {'stride_px': 8}, 'timing': {}}
    assert nested(values) == {'ablation': 'sigma_t', 'cloud.stride_px': 8}
    config = override(Config(), nested(values))
    assert (config.ablation, config.cloud.stride_px) == ('sigma_t', 8)


def test_an_unknown_setting_names_the_valid_ones() -> None:
    with pytest.raises(ConfigError, match='stride') as refused:
        override(Config(), {'cloud.strude_px': 8})
    assert all(key in str(refused.value) for key in flatten(Config()))


@pytest.mark.parametrize('key', ['cloud', 'cloud.', '', 'stride_px'])
def test_a_stage_is_no_setting(key: str) -> None:
    with pytest.raises(ConfigError, match='unknown'):
        override(Config(), {key: 1})


@pytest.mark.parametrize(
    ('key', 'value'),
    [
        ('cloud.stride_px', 'ten'),
        ('cloud.stride_px', 2.5),
        ('cloud.stride_px', '2.5'),
        ('cloud.stride_px', None),
        ('cloud.stride_px', True),
        ('cloud.stride_px', 'inf'),
        ('registration.radius_m', 'nan'),
        ('registration.radius_m', float('inf')),
        ('registration.radius_m', [0.1]),
        ('registration.radius_m', ''),
        ('ablation', 'fool'),
        ('ablation', None),
    ],
)
def test_a_value_the_field_cannot_hold_is_refused(key: str, value: object) -> None:
    with pytest.raises(ConfigError, match=key):
        override(Config(), {key: value})


@pytest.mark.parametrize(
    ('key', 'value'),
    [
        ('cloud.stride_px', 0),
        ('cloud.half_window', -1),
        ('cloud.dilation_px', 0),
        ('landmarks.window_px', 2),
        ('landmarks.levels', -1),
        ('registration.radius_m', 0),
        ('registration.max_iterations', 0),
        ('keyframes.spawn_stride_px', 0),
        ('keyframes.overlap', 0),
        ('keyframes.landmarks', 0),
        ('timing.prior_ms', 0),
        ('timing.memory_s', 0),
        ('threads', 0),
    ],
)
def test_a_value_the_tracker_could_not_work_with_is_refused(key: str, value: float) -> None:
    """At once and by name, not by a division by zero at the first keyframe."""
    with pytest.raises(ConfigError, match=key.split('.')[-1]):
        override(Config(), {key: value})


def test_noise_the_sensor_cannot_have_is_refused() -> None:
    with pytest.raises(SensorError):
        override(Config(), {'sensor.a_m': -1})


def test_settings_are_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        Config().threads = 3  # type: ignore[misc]


def test_distances_in_pixels_follow_small_images_only() -> None:
    config = Config()
    assert config.scaled_to(640, 480) is config and config.scaled_to(1280, 720) is config
    half, tiny = config.scaled_to(320, 240), config.scaled_to(64, 48)
    assert (half.cloud.stride_px, half.landmarks.min_distance_px) == (5, 6)
    assert half.keyframes.spawn_px == 2.0
    assert half.landmarks.sigma_px == config.landmarks.sigma_px
    assert (tiny.cloud.stride_px, tiny.cloud.dilation_px) == (3, 1)
