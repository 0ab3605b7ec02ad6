# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The configuration as a YAML file: plain, or as ROS 2's parameter files."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from ..core.config.schema import ConfigError, nested, override
from ..core.config.stages import Config
from ..core.errors import DcgsError
from .whole_files import replacing
from .yaml_text import load_yaml

_MAX_BYTES = 2**20
_ROS_BLOCK = 'ros__parameters'


class SettingsFileError(ConfigError):
    """A settings file cannot be read, or is not valid."""


def apply_file(config: Config, path: Path | str) -> Config:
    """Return a copy of `config` with the settings of a YAML file.

    The file maps stages to fields (`sensor: {a_m: 0.001}`), plainly or below a node's name and
    `ros__parameters`, as ROS 2's files do; of several nodes' blocks the last one wins. An empty
    file sets nothing. Raises `SettingsFileError` naming the file.
    """
    try:
        return override(config, _read(Path(path)))
    except SettingsFileError:
        raise
    except DcgsError as error:
        raise SettingsFileError(f'{path}: {error}') from error


def write_config(path: Path | str, config: Config) -> None:
    """Write every field: `apply_file` then gives an equal configuration from any other."""
    text = yaml.safe_dump(dataclasses.asdict(config), sort_keys=False)
    with replacing(Path(path)) as temporary:
        temporary.write_text(text, encoding='utf-8')


def _read(path: Path) -> dict[str, Any]:
    """Read a settings file as {'stage.field': value}."""
    try:
        with path.open('rb') as file:
            text = file.read(_MAX_BYTES + 1)
        if len(text) > _MAX_BYTES:
            raise ValueError(f'no settings: more than {_MAX_BYTES} bytes')
        tree = load_yaml(text)
    except OSError as error:
        raise SettingsFileError(f'{path}: cannot be read: {error.strerror}') from error
    except ValueError as error:
        raise SettingsFileError(f'{path}: {error}') from None
    if tree is None:
        return {}
    if not isinstance(tree, Mapping):
        raise SettingsFileError(
            f'{path}: holds a {type(tree).__name__}, not settings as stage: {{field: value}}'
        )
    flat: dict[str, Any] = {}
    for key, value in nested(tree).items():
        field = key.rpartition(f'{_ROS_BLOCK}.')[2]
        if value is not None or not field.endswith(_ROS_BLOCK):  # else: an empty block
            flat[field] = value
    return flat
