# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Camera intrinsics from the command line or from the files of a dataset."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ...core.camera import CameraError, PinholeCamera
from ..camera_presets import PRESETS, CameraPreset
from ..images.association import StampPair
from ..images.sequence import color_size
from ..source import SourceError
from .text_files import number_at

MAX_PIXELS = 2**25  # of an image, 8192 x 4096: a larger size is a corrupt number


def parse_intrinsics(text: str, width: int, height: int) -> PinholeCamera:
    """Parse `fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]` in pixels, for images of `width` x `height`.

    Raises `SourceError` if the text has another form or describes no valid camera.
    """
    try:
        numbers = [float(word) for word in text.split(',')]
    except ValueError:
        numbers = []
    if len(numbers) not in (4, 8, 9, 12):
        raise SourceError(
            f'camera {text!r} is neither one of {", ".join(PRESETS)} '
            'nor fx,fy,cx,cy[,k1,k2,p1,p2[,k3]] in pixels'
        )
    try:
        fx, fy, cx, cy, *distortion = numbers
        return PinholeCamera(width, height, fx, fy, cx, cy, tuple(distortion))
    except CameraError as error:
        raise SourceError(f'camera {text!r}: {error}') from error


def choose_camera(
    text: str | None,
    default: CameraPreset,
    folder: Path,
    pairs: Sequence[StampPair],
    depth_per_metre: float | None = None,
) -> CameraPreset:
    """Return the preset or intrinsics that `text` names, or the default if it is None.

    The depth unit is `depth_per_metre` or else the default's, whatever `text` names, as it is a
    property of the files. Intrinsics come with the default's noise and the size of the images.
    Raises `SourceError` if `text` is neither preset nor intrinsics, or if no image of `pairs` can
    be read for its size.
    """
    if depth_per_metre is not None:
        default = dataclasses.replace(default, depth_per_metre=depth_per_metre)
    if text is None:
        return default
    if text in PRESETS:
        return dataclasses.replace(PRESETS[text], depth_per_metre=default.depth_per_metre)
    parse_intrinsics(text, 640, 480)  # report a wrong text before searching for an image
    camera = parse_intrinsics(text, *color_size(folder, pairs))
    return dataclasses.replace(default, camera=camera)


def camera_from_fields(
    values: Mapping[Any, Any], keys: Sequence[str], distortion: Sequence[Any] = ()
) -> PinholeCamera:
    """Return the camera whose width, height, fx, fy, cx, cy are the `values` at six `keys`.

    Raises `ValueError` naming the key, or what is wrong with the camera as a whole.
    """
    width, height, fx, fy, cx, cy = (number_at(values, key) for key in keys)
    if not (width.is_integer() and height.is_integer() and 0 < width * height <= MAX_PIXELS):
        raise ValueError(f'{keys[0]}, {keys[1]}: {width:g} x {height:g} is not an image size')
    numbers = {f'distortion[{k}]': number for k, number in enumerate(distortion)}
    coefficients = tuple(number_at(numbers, key) for key in numbers)
    try:
        return PinholeCamera(int(width), int(height), fx, fy, cx, cy, coefficients)
    except CameraError as error:
        raise ValueError(str(error)) from error
