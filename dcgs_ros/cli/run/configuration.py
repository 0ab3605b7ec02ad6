# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The configuration of a run, from all that has a say in it."""

from __future__ import annotations

from ...core.config.presets import ONLINE, QUALITIES
from ...core.config.schema import ConfigError, override
from ...core.config.stages import Config
from ...core.sensor import SensorNoise
from ...io.config_file import apply_file
from ..arguments import RunArguments, UsageError

# What --quality asks of the mapper: more steps, and for those also more Gaussians and views.


def configure(sensor: SensorNoise, arguments: RunArguments) -> Config:
    """Layer sensor, --quality, --online, the file, --ablation and --set, the last on top."""
    if arguments.quality not in QUALITIES:
        raise UsageError(f'--quality {arguments.quality}: one of {", ".join(QUALITIES)}')
    config = override(Config(sensor=sensor), QUALITIES[arguments.quality])
    if arguments.online:
        config = override(config, ONLINE)
    if arguments.config is not None:
        config = apply_file(config, arguments.config)
    if arguments.ablation is not None:
        config = override(config, {'ablation': arguments.ablation})
    values: dict[str, str] = {}
    for text in (text for group in arguments.settings for text in group):
        key, equals, value = text.partition('=')
        if not equals:
            raise ConfigError(f'--set {text}: expected stage.field=value')
        values[key.strip()] = value.strip()
    return override(config, values)
