# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The options of a synthetic address."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from ..source import SourceError
from .scenes.catalogue import SCENES
from .scenes.movers import MOVERS
from .sensors.catalogue import SENSORS

_RANGES = {
    'frames': (1, 1_000_000),
    'seed': (0, 2**31 - 1),
    'speed': (0.1, 10.0),
    'light': (0.01, 10.0),
    'period': (0.0, 10.0),
}
_CHOICES = {'sensor': tuple(SENSORS), 'direction': ('ccw', 'cw'), 'mover': tuple(MOVERS)}
_INTEGERS = ('frames', 'seed')


@dataclass(frozen=True)
class SyntheticOptions:
    """The options in an address, after the question mark; None is the scene's own choice."""

    frames: int = 300
    seed: int = 0  # of noise, shake, clutter, and a sensor's own errors
    sensor: str | None = None
    speed: float = 1.0  # along the path
    light: float = 1.0  # as a share of the scene's own
    motion: str | None = None  # who carries the camera
    period: float | None = None  # metres after which the floor repeats; 0 = never
    direction: str | None = None  # in which the loop is closed, seen from above
    mover: str | None = None  # what moves in front of the camera

    def __post_init__(self) -> None:
        """Check the options by themselves; raises `SourceError` with the valid choices."""
        for key, choices in _CHOICES.items():
            value = getattr(self, key)
            if value is not None and value not in choices:
                raise SourceError(f'unknown {key} {value!r}: one of {", ".join(choices)}')
        for key, (low, high) in _RANGES.items():
            value = getattr(self, key)
            if value is not None and not low <= value <= high:
                raise SourceError(f'{key}={value} is not within {low} to {high}')

    def of_scene(self, scene: str) -> SyntheticOptions:
        """Return the options with the scene's choices; raises `SourceError` for what it lacks."""
        if scene not in SCENES:
            raise SourceError(f'unknown scene {scene!r}: one of {", ".join(SCENES)}')
        kind = SCENES[scene]
        motion = self.motion or kind.motions[0]
        if motion not in kind.motions:
            raise SourceError(f'{scene} has no motion {motion!r}: {" or ".join(kind.motions)}')
        values: dict[str, Any] = {'motion': motion, 'sensor': self.sensor or kind.sensor}
        for key in ('period', 'direction', 'mover'):
            if getattr(self, key) is None:
                values[key] = kind.extras.get(key)
            elif key not in kind.extras:
                having = [name for name in SCENES if key in SCENES[name].extras]
                raise SourceError(f'{scene} has no {key}: only {", ".join(having)} has')
        return replace(self, **values)


def parse_address(address: str) -> tuple[str, SyntheticOptions]:
    """Return scene and options of `synthetic:scene[?key=value&...]`.

    Raises `SourceError` with the valid keys or values.
    """
    parts = urlsplit(address)
    if parts.scheme != 'synthetic':
        raise SourceError(f'{address!r} does not begin with synthetic:')
    try:
        pairs = parse_qsl(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query))
    except ValueError as error:
        raise SourceError(
            f'cannot read {parts.query!r}: expected key=value[&key=value]'
        ) from error
    known = [field.name for field in fields(SyntheticOptions)]
    for k, (key, _) in enumerate(pairs):
        if key not in known:
            raise SourceError(f'unknown key {key!r}: one of {", ".join(known)}')
        if key in dict(pairs[:k]):
            raise SourceError(f'{key} is given twice')
    values: dict[str, Any] = {key: _parse_value(key, text) for key, text in pairs}
    return parts.path, SyntheticOptions(**values)


def _parse_value(key: str, text: str) -> int | float | str:
    if key not in _RANGES:
        return text
    kind, kind_name = (int, 'an integer') if key in _INTEGERS else (float, 'a number')
    try:
        return kind(text)
    except ValueError as error:
        raise SourceError(f'{key}={text!r} is not {kind_name}') from error
