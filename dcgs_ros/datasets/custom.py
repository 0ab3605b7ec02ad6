# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Custom datasets: folders of images that a file in them, `dcgs.yaml`, describes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

import yaml

from ..core.camera import PinholeCamera
from ..core.config.schema import ConfigError, override
from ..core.sensor import SensorError, SensorNoise
from ..io.trajectory import read_tum
from ..io.whole_files import replacing
from ..io.yaml_text import load_yaml
from .camera_presets import PRESETS, CameraPreset
from .images.file_patterns import pair_by_name, pair_by_order
from .images.pairing import PairedImages, pair_images
from .images.sequence import ImageSequence
from .options import AS_STORED, SourceOptions, merged
from .parsing.intrinsics import camera_from_fields, choose_camera
from .parsing.text_files import number_at, read_text, shown
from .source import SourceError
from .tum.index import check_inside, read_index

FILE = 'dcgs.yaml'
LAYOUT = f'{FILE} and the images it names (see docs/datasets.md)'

_CAMERA_KEYS = ('width', 'height', 'fx', 'fy', 'cx', 'cy')
_SENSOR_KEYS = tuple(field.name for field in dataclasses.fields(SensorNoise))
_KEYS = (
    *('camera', 'color', 'depth', 'rate_hz', 'stamps'),
    *('depth_per_metre', 'sync_slop_s', 'sensor', 'groundtruth'),
)
_MAX_BYTES = 2**16


def is_custom(path: Path) -> bool:
    """Return whether the path is a folder with a `dcgs.yaml`."""
    return (path / FILE).is_file()


def open_custom(
    path: Path | str,
    camera: str | None = None,
    groundtruth: Path | str | None = None,
    options: SourceOptions = AS_STORED,
) -> ImageSequence:
    """Open a folder as its `dcgs.yaml` describes it.

    `camera: PRESET` or `{width, height, fx, fy, cx, cy, distortion: [...]}`; `color`, `depth`:
    either index files (`.txt`, as TUM's rgb.txt), or patterns of file names (`rgb/*.png`) with
    `rate_hz: 30` (paired in order) or `stamps: names` (the names are seconds);
    `depth_per_metre`, optional with a preset; optionally `sync_slop_s` between the stamps of
    colour and depth, `sensor: {a_m, b_per_m, depth_min_m, depth_max_m}` and `groundtruth`, a TUM
    trajectory. The arguments override the file.

    Raises `SourceError` (or `TrajectoryFileError`) naming the file and the key or line.
    """
    folder = Path(path)
    file = folder / FILE
    try:
        tree = _load(file)
        options = _with_own(tree, options)
        own = _own_camera(tree, options.depth_per_metre)
        pairs, notes = _pairs(folder, tree, options)
        if groundtruth is None and 'groundtruth' in tree:
            groundtruth = folder / _path_at(tree, 'groundtruth')
    except (ValueError, SensorError, ConfigError) as error:
        raise SourceError(f'{file}: {error}') from None
    chosen = choose_camera(camera, own, folder, pairs)
    left_out = [*notes]
    truth = None if groundtruth is None else read_tum(groundtruth, left_out)
    return ImageSequence.from_preset(folder, pairs, chosen, truth, notes=left_out)


def write_description(
    folder: Path, camera: PinholeCamera, sensor: SensorNoise, depth_per_metre: float
) -> None:
    """Write the `dcgs.yaml` of a folder in TUM's layout; `open_custom` reads exactly these values.

    Raises `SourceError` if the file cannot be written.
    """
    intrinsics = {key: float(getattr(camera, key)) for key in _CAMERA_KEYS[2:]}
    distortion = [float(number) for number in camera.distortion]
    size = {'width': int(camera.width), 'height': int(camera.height)}
    tree: dict[str, Any] = {
        'camera': {**size, **intrinsics, 'distortion': distortion},
        'color': 'rgb.txt',
        'depth': 'depth.txt',
        'depth_per_metre': float(depth_per_metre),
        'sensor': {key: float(getattr(sensor, key)) for key in _SENSOR_KEYS},
    }
    if (folder / 'groundtruth.txt').is_file():
        tree['groundtruth'] = 'groundtruth.txt'
    try:
        with replacing(folder / FILE) as temporary:
            temporary.write_text(yaml.safe_dump(tree, sort_keys=False), encoding='utf-8')
    except OSError as error:
        raise SourceError(f'{folder / FILE}: cannot be written: {error.strerror}') from error


def _load(file: Path) -> dict[str, Any]:
    tree = load_yaml(read_text(file, _MAX_BYTES))
    _check_map(tree, 'the file holds', _KEYS)
    return tree


def _check_map(value: object, name: str, valid: tuple[str, ...]) -> None:
    """Check that the value is a map with valid keys only; raises `ValueError`."""
    if not isinstance(value, Mapping):
        raise ValueError(f'{name} {shown(value)}, not a map of {", ".join(valid)}')
    for unknown in value.keys() - set(valid):
        raise ValueError(f'{name} a key {shown(unknown)}; there are {", ".join(valid)}')


def _with_own(tree: Mapping[str, Any], options: SourceOptions) -> SourceOptions:
    """Return the options of the file, overridden; raises `ValueError` or `ConfigError`."""
    names = [field.name for field in dataclasses.fields(SourceOptions)]
    own = {key: number_at(tree, key) for key in names if key in tree}
    return merged(override(AS_STORED, own), options)


def _own_camera(tree: Mapping[str, Any], unit: float | None) -> CameraPreset:
    """Return camera, noise and depth unit; raises `ValueError` or `SensorError`."""
    value = tree.get('camera')
    if isinstance(value, str) and value in PRESETS:
        preset = PRESETS[value]
        camera, sensor = preset.camera, preset.sensor
        unit = unit or preset.depth_per_metre
    else:
        camera, sensor = _camera(value), SensorNoise.structured_light()
    if 'sensor' in tree:
        _check_map(tree['sensor'], 'sensor has', _SENSOR_KEYS)
        numbers = {key: number_at(tree['sensor'], key) for key in tree['sensor']}
        sensor = dataclasses.replace(sensor, **numbers)
    if unit is None:
        raise ValueError('depth_per_metre is missing')
    return CameraPreset(camera, sensor, unit)


def _camera(value: object) -> PinholeCamera:
    if not isinstance(value, Mapping):
        raise ValueError(
            f'camera is {shown(value)}, neither a map of {", ".join(_CAMERA_KEYS)}, distortion '
            f'nor one of {", ".join(PRESETS)}'
        )
    _check_map(value, 'camera has', (*_CAMERA_KEYS, 'distortion'))
    distortion = value.get('distortion', [])
    if not isinstance(distortion, list):
        raise ValueError(f'camera.distortion is {shown(distortion)}, not a list of numbers')
    try:
        return camera_from_fields(value, _CAMERA_KEYS, distortion)
    except ValueError as error:
        raise ValueError(f'camera: {error}') from None


def _pairs(folder: Path, tree: Mapping[str, Any], options: SourceOptions) -> PairedImages:
    color, depth = _path_at(tree, 'color'), _path_at(tree, 'depth')
    ways = [
        name
        for name, given in (
            ('index files', color.endswith('.txt') and depth.endswith('.txt')),
            ('rate_hz', 'rate_hz' in tree),
            ('stamps', 'stamps' in tree),
        )
        if given
    ]
    if len(ways) != 1:
        raise ValueError(
            f'{" and ".join(ways) or "nothing"} for the stamps; exactly one is needed: color and '
            'depth are index files (.txt), or rate_hz: NUMBER, or stamps: names'
        )
    if ways == ['index files']:
        colors, depths = (
            [row[0] for row in read_index(folder / name, 1)] for name in (color, depth)
        )
        return pair_images(folder, colors, depths, options)
    if ways == ['stamps'] and tree['stamps'] != 'names':
        raise ValueError(f'stamps is {shown(tree["stamps"])}; it can be: names')
    if options.rate_hz is not None:
        return pair_by_order(folder, color, depth, Fraction(options.rate_hz))
    return pair_by_name(folder, color, depth, options)


def _path_at(tree: Mapping[str, Any], key: str) -> str:
    """Return the path or pattern at a key; raises `ValueError` if it may leave the folder."""
    value = tree.get(key)
    if not isinstance(value, str) or not value:
        raise ValueError(f'{key} is {shown(value)}, not a path')
    try:
        check_inside(value)
    except ValueError as error:
        raise ValueError(f'{key}: {error}') from None
    return value
