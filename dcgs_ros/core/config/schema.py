# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Declaration, listing and overriding of settings, for YAML, ROS parameters and CLI flags."""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

from ..errors import DcgsError

_NONE = ('auto', 'none', 'null', '')  # how None is written as text
_KINDS = {int: 'a finite int', float: 'a finite float', bool: 'true or false', str: 'text'}


class ConfigError(DcgsError):
    """A setting that does not exist, or a value of the wrong type or out of range."""


def ranged(default: Any, low: float, high: float, doc: str) -> Any:
    """Return a field with a range of values; `None` is allowed too if its type includes it.

    `doc` says what it is and in which unit: `ros2 param describe` shows it.
    """
    return field(default=default, metadata={'range': (low, high), 'doc': doc})


def described(default: Any, doc: str) -> Any:
    """Return a field without a range: text, a choice, or a bool."""
    return field(default=default, metadata={'doc': doc})


class Stage:
    """Base class of the settings of a stage: checks the ranges."""

    def __post_init__(self) -> None:
        """Raise `ConfigError` for a value out of its range."""
        for f in dataclasses.fields(self):  # type: ignore[arg-type]
            value = getattr(self, f.name)
            if value is None or 'range' not in f.metadata:
                continue
            low, high = f.metadata['range']
            if not low <= value <= high:
                raise ConfigError(f'{f.name} is {value}, not within {low:g} to {high:g}')


S = TypeVar('S', bound=Stage)


@dataclass(frozen=True)
class Setting:
    """One setting of any stage."""

    key: str  # stage.field
    value: Any
    kind: type  # int, float, bool or str
    choices: tuple[str, ...]  # the allowed values; empty: any of its kind and range
    optional: bool  # may be None
    range: tuple[float, float] | None
    doc: str


def settings(config: Any, prefix: str = '') -> Iterator[Setting]:
    """Yield all settings, stage by stage."""
    hints = typing.get_type_hints(type(config))
    for f in dataclasses.fields(config):
        key, value = prefix + f.name, getattr(config, f.name)
        if dataclasses.is_dataclass(value):
            yield from settings(value, f'{key}.')
            continue
        hint, arguments = hints[f.name], typing.get_args(hints[f.name])
        literal = typing.get_origin(hint) is Literal
        yield Setting(
            key=key,
            value=value,
            kind=str if literal else next(a for a in (*arguments, hint) if a is not type(None)),
            choices=arguments if literal else (),
            optional=type(None) in arguments,
            range=f.metadata.get('range'),
            doc=f.metadata['doc'],
        )


def flatten(config: Any) -> dict[str, Any]:
    """Return all settings as {'stage.field': value}."""
    return {setting.key: setting.value for setting in settings(config)}


def override(config: S, values: Mapping[str, Any]) -> S:
    """Return a copy of `config` with {'stage.field': value} replaced; values may be text.

    Raises `ConfigError` for an unknown key (it lists the valid ones) or a value of the wrong type.
    """
    known = {setting.key: setting for setting in settings(config)}
    for key in values:
        if key not in known:
            raise ConfigError(f'unknown setting {key!r}; the valid ones are {", ".join(known)}')
    return _replace(config, {key: _converted(v, known[key]) for key, v in values.items()}, '')


def nested(values: Mapping[str, Any], prefix: str = '') -> dict[str, Any]:
    """Return nested mappings, as read from YAML, as {'stage.field': value}."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            flat |= nested(value, f'{prefix}{key}.')
        else:
            flat[f'{prefix}{key}'] = value
    return flat


def _replace(config: Any, values: Mapping[str, Any], prefix: str) -> Any:
    changes: dict[str, Any] = {}
    for f in dataclasses.fields(config):
        key, current = prefix + f.name, getattr(config, f.name)
        if dataclasses.is_dataclass(current):
            changes[f.name] = _replace(current, values, f'{key}.')
        elif key in values:
            changes[f.name] = values[key]
    return dataclasses.replace(config, **changes)


def _converted(value: Any, setting: Setting) -> Any:
    """Return `value`, which may be text, as the setting's type."""
    if setting.choices:
        if value not in setting.choices:
            raise ConfigError(f'{setting.key} is {value!r}, not one of {setting.choices}')
        return value
    if setting.optional and (value is None or str(value).lower() in _NONE):
        return None
    try:
        if setting.kind is str:
            return _text(value)
        return _truth(value) if setting.kind is bool else _number(value, setting.kind)
    except (TypeError, ValueError, OverflowError):
        raise ConfigError(f'{setting.key} is {value!r}, not {_KINDS[setting.kind]}') from None


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError
    return value


def _truth(value: Any) -> bool:
    if str(value).lower() not in ('true', 'false'):
        raise ValueError
    return str(value).lower() == 'true'


def _number(value: Any, kind: type) -> float:
    """Return a finite number; an integer may be written as 2.0."""
    number = float(value)
    if isinstance(value, bool) or not math.isfinite(number):
        raise ValueError
    if kind is float:
        return number
    if number != int(number):
        raise ValueError
    return int(number)
