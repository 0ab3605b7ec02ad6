# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Cameras as the files of a dataset say them, unless the user says otherwise."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..core.camera import CameraError, PinholeCamera
from .cameras import PRESETS, CameraPreset, parse_intrinsics
from .images.association import StampPair
from .images.sequence import color_size

MAX_PIXELS = 2**25  # of an image, 8192 x 4096: more is a number that went wrong


def chosen_camera(
    text: str | None, default: CameraPreset, folder: Path, pairs: Sequence[StampPair]
) -> CameraPreset:
    """Take the default, or the preset or intrinsics (with the default's noise) of `text`.

    The depth unit is the default's in any case: files have theirs, whoever took them.
    Raises `SourceError` where the text is neither, or no image of `pairs` tells its size.
    """
    if text is None:
        return default
    if text in PRESETS:
        return dataclasses.replace(PRESETS[text], depth_per_metre=default.depth_per_metre)
    parse_intrinsics(text, 640, 480)  # complain about the text before looking for an image
    camera = parse_intrinsics(text, *color_size(folder, pairs))
    return dataclasses.replace(default, camera=camera)


def camera_of(
    values: Mapping[Any, Any], keys: Sequence[str], distortion: Sequence[Any] = ()
) -> PinholeCamera:
    """Camera of the `values` at six `keys`: width, height, fx, fy, cx, cy.

    Raises `ValueError` naming the key, or saying what is wrong with all of them.
    """
    width, height, fx, fy, cx, cy = (number_of(values, key) for key in keys)
    if not (width.is_integer() and height.is_integer() and 0 < width * height <= MAX_PIXELS):
        raise ValueError(f'{keys[0]}, {keys[1]}: no image has {width:g} x {height:g} pixels')
    numbers = {f'distortion[{k}]': number for k, number in enumerate(distortion)}
    coefficients = tuple(number_of(numbers, key) for key in numbers)
    try:
        return PinholeCamera(int(width), int(height), fx, fy, cx, cy, coefficients)
    except CameraError as error:
        raise ValueError(str(error)) from error


def depth_unit_of(values: Mapping[Any, Any], key: str) -> float:
    """Value at `key` of a 16-bit depth pixel at one metre; raises `ValueError` naming the key."""
    unit = number_of(values, key)
    if not 1 <= unit <= 1e6:
        raise ValueError(f'{key} is {unit:g}: a metre of depth is 1 to 1e6')
    return unit


def number_of(values: Mapping[Any, Any], key: str) -> float:
    """Return the value at `key` as a number; raises `ValueError` naming the key."""
    if key not in values:
        raise ValueError(f'{key} is missing')
    value = values[key]
    try:
        if isinstance(value, bool):
            raise TypeError
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f'{key} is {shown(value)}, no number') from None


def shown(value: object) -> str:
    """Text to put into a message: of containers, which may be endless, only the type."""
    return repr(value[:60]) if isinstance(value, str) else f'a {type(value).__name__}'
