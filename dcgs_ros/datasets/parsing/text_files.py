# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Text files of datasets, and the numbers in them, checked before they are used."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..source import SourceError


def read_text(path: Path, max_bytes: int) -> str:
    """Read a text file; raises `SourceError` if it cannot be read or exceeds `max_bytes`."""
    try:
        size = path.stat().st_size
        if size > max_bytes:
            raise SourceError(f'{path}: has {size} bytes, more than the {max_bytes} it may have')
        return path.read_text(encoding='utf-8', errors='replace')
    except OSError as error:
        raise SourceError(f'{path}: cannot be read: {error.strerror}') from error


def number_at(values: Mapping[Any, Any], key: str) -> float:
    """Return the value at `key` as a number; raises `ValueError` naming the key."""
    if key not in values:
        raise ValueError(f'{key} is missing')
    value = values[key]
    try:
        if isinstance(value, bool):
            raise TypeError
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f'{key} is {shown(value)}, not a number') from None


def depth_unit_at(values: Mapping[Any, Any], key: str) -> float:
    """Return the value at `key`: that of a 16-bit depth pixel at one metre.

    Raises `ValueError` naming the key.
    """
    unit = number_at(values, key)
    if not 1 <= unit <= 1e6:
        raise ValueError(f'{key} is {unit:g}: one metre of depth must be 1 to 1e6')
    return unit


def shown(value: object) -> str:
    """Return a short text for messages: of containers, which may be endless, only the type."""
    return repr(value[:60]) if isinstance(value, str) else f'a {type(value).__name__}'
