# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The configuration of a run, from all that has a say in it."""

from __future__ import annotations

from ..core.config import ONLINE, Config, ConfigError, override
from ..core.sensor import SensorNoise
from ..io.settings import apply_file
from .arguments import RunArguments, UsageError

# What --quality asks of the mapper: more steps, and for those also more Gaussians and views.
QUALITIES: dict[str, dict[str, float]] = {
    'draft': {'mapping.steps_per_frame': 1, 'mapping.final_steps': 100},
    'default': {},
    'high': {
        'mapping.steps_per_frame': 4,
        'mapping.final_steps': 6000,
        'mapping.spawn_stride_px': 3,
        'mapping.view_interval': 2,
        'mapping.exposure_share': 0.9,
    },
}


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
