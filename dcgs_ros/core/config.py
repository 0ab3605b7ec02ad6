# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Every setting: one frozen dataclass a stage, with the defaults, which stand nowhere else."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from .errors import DcgsError
from .sensor import SensorNoise


class ConfigError(DcgsError):
    """A key that does not exist or a value that its field cannot hold."""


def ranged(default: Any, low: float, high: float) -> Any:
    """Field with the range of its values; `None`, where the type admits it, is always allowed."""
    return field(default=default, metadata={'range': (low, high)})


class Stage:
    """Base of the configurations: checks the ranges."""

    def __post_init__(self) -> None:
        """Refuse a value out of its range."""
        for f in dataclasses.fields(self):  # type: ignore[arg-type]
            value = getattr(self, f.name)
            if value is None or 'range' not in f.metadata:
                continue
            low, high = f.metadata['range']
            if not low <= value <= high:
                raise ConfigError(f'{f.name} is {value}, not within {low:g} to {high:g}')


@dataclass(frozen=True)
class CloudConfig(Stage):
    """Sampling of a depth image into points with normals."""

    stride_px: int = ranged(10, 2, 64)  # one jittered sample in each stride x stride cell
    dilation_px: int = ranged(3, 1, 16)  # spacing of the neighbours that give the scatter Q_i
    half_window: int = ranged(2, 1, 5)  # neighbours: the black squares of (2 half + 1)^2
    min_neighbours: float = ranged(0.6, 0, 1)  # share of them with depth on the same surface
    min_view_cosine: float = ranged(0.17, 0, 0.99)  # |n . v|: drops grazing samples below it


@dataclass(frozen=True)
class LandmarkConfig(Stage):
    """KLT corners and the image residual."""

    corners: int = ranged(300, 1, 5000)  # kept alive
    min_distance_px: int = ranged(12, 2, 200)  # between corners
    quality: float = ranged(0.01, 1e-6, 1)  # of the weakest corner against the strongest
    min_gradient: float = ranged(4.0, 0, 100)  # of a corner's weakest direction, grey levels / px
    window_px: int = ranged(13, 5, 63)  # KLT window
    levels: int = ranged(3, 0, 6)  # KLT pyramid levels above the image
    back_check_px: float = ranged(1.0, 0.01, 100)  # largest forward-backward disagreement
    sigma_px: float = ranged(0.7, 0.01, 100)  # sigma_m: precision of the matcher (paper: 2)
    huber: float = ranged(2.0, 0.1, 1e6)  # delta on sqrt(chi2)
    drop_chi2: float = ranged(50.0, 1, 1e12)  # a landmark beyond it is dropped
    anchor_radius_m: float = ranged(0.03, 1e-3, 1)  # to the Gaussian that carries the landmark
    min_start: int = ranged(20, 6, 5000)  # landmarks that can start the registration


@dataclass(frozen=True)
class RegistrationConfig(Stage):
    """Joint Levenberg-Marquardt on SE(3)."""

    radius_m: float = ranged(0.03, 2e-3, 1)  # r: of the association, and its ambiguity in D_i
    guess_radius_m: float = ranged(0.12, 2e-3, 2)  # of the first search where no landmarks help
    footprint_px: float = ranged(1.0, 0.01, 100)  # p_d: lateral precision of a depth sample
    anchor_px: float = ranged(0.5, 0.01, 100)  # p: lateral precision of a Gaussian
    min_normal_cosine: float = ranged(0.7, -1, 1)  # between the normals of a pair
    max_iterations: int = ranged(8, 1, 100)
    tolerance_m: float = ranged(5e-4, 1e-9, 1)
    tolerance_rad: float = ranged(3e-4, 1e-9, 1)
    min_pairs: int = ranged(100, 6, 1000000)  # fewer depth pairs do not fix a pose
    degenerate_ratio: float = ranged(200.0, 1, 1e12)  # of the eigenvalues of a block of H


@dataclass(frozen=True)
class KeyframeConfig(Stage):
    """When the map grows, and how."""

    translation_m: float = ranged(0.08, 1e-6, 100)
    rotation_rad: float = ranged(0.105, 1e-6, 3.2)
    overlap: float = ranged(0.85, 0.01, 1)  # of the overlap seen just after the last keyframe
    landmarks: float = ranged(0.5, 0.01, 1)  # of those alive just after the last keyframe
    min_landmarks: int = ranged(20, 1, 5000)  # if fewer were found then, losing them is no reason
    min_interval_s: float = ranged(0.4, 0, 60)  # budget: motion and overlap ask no faster
    max_turn_rad_s: float = ranged(1.2, 0.01, 100)  # ... nor in a faster turn
    spawn_stride_px: int = ranged(5, 2, 64)
    spawn_min_m: float = ranged(0.015, 1e-4, 1)  # apart, of Gaussians on one surface
    spawn_px: float = ranged(4.0, 0.1, 100)  # ... and this many pixels


@dataclass(frozen=True)
class TimingConfig(Stage):
    """Colour and depth are not taken at the same instant."""

    # True time of a depth image less its stamp; None: estimate it.
    colour_depth_offset_ms: float | None = ranged(None, -100, 100)
    prior_ms: float = ranged(15.0, 0.1, 100)  # its standard deviation before anything is seen
    memory_s: float = ranged(10.0, 0.1, 1e4)  # the estimate forgets what is older


@dataclass(frozen=True)
class MappingConfig(Stage):
    """The mapper: which views it gets, where Gaussians come and go, how long it optimises."""

    view_interval: int = ranged(4, 1, 1000)  # frames after which one is mapped, keyframe or not
    steps_per_frame: float = ranged(3.0, 0, 1000)  # in lockstep with the tracker
    final_steps: int = ranged(2500, 0, 1000000)  # after the last frame
    newest_share: float = ranged(0.2, 0, 1)  # of the steps: on the view that had the fewest
    coarse_share: float = ranged(0.5, 0, 1)  # of the steps before the last frame: half resolution
    ssim_weight: float = ranged(0.2, 0, 1)
    depth_weight: float = ranged(0.03, 0, 100)  # 1 / m
    exposure_share: float = ranged(0.6, 0, 1)  # of a view's exposure; the rest is the map's
    spawn_stride_px: int = ranged(6, 1, 64)
    spawn_transmittance: float = ranged(0.3, 0, 1)  # above it the map lacks Gaussians
    spawn_scale: float = ranged(0.6, 0.1, 10)  # sigma of a new Gaussian, in its spacing
    spawn_flatness: float = ranged(0.15, 1e-3, 1)  # its third sigma against the others
    spawn_opacity: float = ranged(0.7, 0.01, 0.99)
    fill_opacity: float = ranged(0.7, 0.01, 0.99)  # ... where depth is a neighbour's
    reach_sigmas: float = ranged(0.5, 0, 1e6)  # sigma_z that a measured mean may be moved by
    prune_interval: int = ranged(100, 1, 100000)  # steps
    prune_opacity: float = ranged(0.02, 0, 1)
    prune_weight: float = ranged(0.5, 0, 1e6)  # pixels: one that never had more in an image goes
    prune_scale_m: float = ranged(0.5, 1e-3, 1e3)  # largest sigma
    trial_visits: int = ranged(60, 1, 100000)  # steps before a Gaussian is judged by its weight
    max_gaussians: int = ranged(400000, 1000, 20000000)
    image_memory_mb: float = ranged(300.0, 1, 1e6)  # views beyond it are kept compressed
    seed: int = ranged(0, 0, 2**31)


@dataclass(frozen=True)
class RatesConfig(Stage):
    """Learning rates of the mapper's Adam."""

    mean_m: float = ranged(8e-4, 0, 1)
    log_scale: float = ranged(1e-2, 0, 1)
    rotation: float = ranged(4e-3, 0, 1)
    opacity: float = ranged(4e-2, 0, 1)  # of the logit
    color: float = ranged(2e-2, 0, 1)
    pose_m: float = ranged(6e-4, 0, 1)
    pose_rad: float = ranged(3e-4, 0, 1)
    exposure: float = ranged(0.3, 0, 1)  # share of the way to the fit, every fourth visit
    final: float = ranged(0.1, 0, 1)  # share of the rates that the final steps end with


@dataclass(frozen=True)
class Config(Stage):
    """All stages."""

    ablation: Literal['full', 'sigma_t', 'shared', 'shared_klt'] = 'full'
    shared_klt_weight: float = ranged(1.0, 0, 1e6)  # w of the image residual in `shared_klt`
    threads: int | None = ranged(None, 1, 1024)  # of the kernels; None: all cores but one
    sensor: SensorNoise = field(default_factory=SensorNoise)
    cloud: CloudConfig = field(default_factory=CloudConfig)
    landmarks: LandmarkConfig = field(default_factory=LandmarkConfig)
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    timing: TimingConfig = field(default_factory=TimingConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    rates: RatesConfig = field(default_factory=RatesConfig)


def flatten(config: Any, prefix: str = '') -> dict[str, Any]:
    """Walk the fields: {'stage.field': value}."""
    flat: dict[str, Any] = {}
    for f in dataclasses.fields(config):
        value = getattr(config, f.name)
        if dataclasses.is_dataclass(value):
            flat |= flatten(value, f'{prefix}{f.name}.')
        else:
            flat[prefix + f.name] = value
    return flat


def override(config: Config, values: Mapping[str, Any]) -> Config:
    """Copy of `config` with {'stage.field': value} replaced; values may be text.

    Raises `ConfigError` for an unknown key (with the valid ones) or a value of the wrong type.
    """
    known = flatten(config)
    for key in values:
        if key not in known:
            raise ConfigError(f'unknown setting {key!r}; the valid ones are {", ".join(known)}')
    return _replace(config, values, '')


def nested(values: Mapping[str, Any], prefix: str = '') -> dict[str, Any]:
    """Flatten nested mappings, as YAML gives them, into {'stage.field': value}."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            flat |= nested(value, f'{prefix}{key}.')
        else:
            flat[f'{prefix}{key}'] = value
    return flat


def _replace(config: Any, values: Mapping[str, Any], prefix: str) -> Any:
    hints = typing.get_type_hints(type(config))
    changes: dict[str, Any] = {}
    for f in dataclasses.fields(config):
        key, current = prefix + f.name, getattr(config, f.name)
        if dataclasses.is_dataclass(current):
            changes[f.name] = _replace(current, values, f'{key}.')
        elif key in values:
            changes[f.name] = _converted(values[key], hints[f.name], key)
    return dataclasses.replace(config, **changes)


def _converted(value: Any, hint: Any, key: str) -> Any:
    """Read `value`, text or not, as the field's type."""
    if typing.get_origin(hint) is Literal:
        if value not in typing.get_args(hint):
            raise ConfigError(f'{key} is {value!r}, not one of {typing.get_args(hint)}')
        return value
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        if value is None or str(value).lower() in ('none', 'null', ''):
            return None
        hint = next(a for a in typing.get_args(hint) if a is not type(None))
    try:
        if isinstance(value, bool):
            raise ValueError
        number = float(value)
        if hint is int:
            if number != int(number):
                raise ValueError
            return int(number)
        if number != number or number in (float('inf'), float('-inf')):
            raise ValueError
        return number
    except (TypeError, ValueError, OverflowError):
        raise ConfigError(f'{key} is {value!r}, not a finite {hint.__name__}') from None
