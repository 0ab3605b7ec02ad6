# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Checks of the parts of a map file."""

from __future__ import annotations

import operator
from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..core.camera import PinholeCamera
from ..core.errors import DcgsError

_Part = TypeVar('_Part')


class MapFileError(DcgsError):
    """The parts of a map do not fit each other, or its file cannot be read or written."""


def part(parts: Mapping[str, _Part], name: str) -> _Part:
    """Return a part by name; raises `MapFileError` if it is missing."""
    if name not in parts:
        raise MapFileError(f'holds no {name!r}')
    return parts[name]


def check(name: str, array: NDArray[Any], dtype: DTypeLike, shape: tuple[int, ...]) -> None:
    """Check type and shape; raises `MapFileError`."""
    if array.dtype != dtype or array.shape != shape:
        raise MapFileError(
            f'{name} is {array.dtype} of shape {array.shape}, not {np.dtype(dtype)} of {shape}'
        )


def check_finite(name: str, rows: NDArray[np.floating]) -> None:
    """Check that all of `rows` (M, ...) are finite; raises `MapFileError`."""
    bad = np.count_nonzero(~np.isfinite(rows).all(axis=tuple(range(1, rows.ndim))))
    if bad:
        raise MapFileError(f'{name}: {bad} of {len(rows)} are not finite')


def check_unique(ids: NDArray[np.int64]) -> None:
    """Check that all ids (N,) differ; raises `MapFileError`."""
    different = len(np.unique(ids))
    if different != len(ids):
        raise MapFileError(f'{len(ids)} Gaussians have only {different} different ids')


def check_keyframes(name: str, rows: NDArray[np.int32], keyframes: int, what: str) -> None:
    """Check that `rows` (N,) are numbers of keyframes; raises `MapFileError`."""
    strange = np.flatnonzero((rows < 0) | (rows >= keyframes))
    if len(strange):
        raise MapFileError(
            f'{name} of {len(strange)} of {len(rows)} Gaussians, the first {rows[strange[0]]}, '
            f'are none of the {keyframes} {what}'
        )


def read_camera(fields: Any) -> PinholeCamera:
    """Return the camera of a JSON object of its fields; raises a `DcgsError`."""
    try:
        width, height = (operator.index(fields[name]) for name in ('width', 'height'))
        fx, fy, cx, cy = (float(fields[name]) for name in ('fx', 'fy', 'cx', 'cy'))
        distortion = tuple(float(number) for number in fields['distortion'])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise MapFileError(f'camera is not usable: {type(error).__name__}: {error}') from error
    return PinholeCamera(width, height, fx, fy, cx, cy, distortion)
