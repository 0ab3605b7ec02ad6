# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The configuration of a run: defaults, overridden by presets, file and flags."""

from __future__ import annotations

from ...core.config.presets import ONLINE, QUALITIES
from ...core.config.schema import ConfigError, override
from ...core.config.stages import Config
from ...core.sensor import SensorNoise
from ...io.config_file import apply_file
from ..arguments import RunArguments


def configure(sensor: SensorNoise, arguments: RunArguments) -> Config:
    """Apply --quality, --online, --config, --ablation, --no-loops and --set, in this order.

    Raises `ConfigError` for an unknown setting or a value that it cannot have.
    """
    config = override(Config(sensor=sensor), QUALITIES[arguments.quality])
    if arguments.online:
        config = override(config, ONLINE)
    if arguments.config is not None:
        config = apply_file(config, arguments.config)
    if arguments.ablation is not None:
        config = override(config, {'ablation': arguments.ablation})
    if not arguments.loops:
        config = override(config, {'backend.loops': False})
    texts = [text for group in arguments.settings for text in group]
    return override(config, dict(_key_and_value(text) for text in texts))


def _key_and_value(text: str) -> tuple[str, str]:
    key, equals, value = text.partition('=')
    if not equals:
        raise ConfigError(f'--set {text}: expected stage.field=value')
    return key.strip(), value.strip()
