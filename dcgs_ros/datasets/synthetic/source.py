# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Synthetic sequences with exact ground truth: `synthetic:room?sensor=d435i&seed=1`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, TypeVar
from urllib.parse import parse_qsl, urlsplit

import numpy as np
from numpy.typing import NDArray

from ...core.camera import PinholeCamera
from ...core.frame import RgbdFrame
from ...core.sensor import SensorNoise
from ...core.trajectory import Trajectory
from ..source import ImuSample, SourceError
from .camera_motion import HandHeldPath
from .color_camera import (
    EXPOSURE_S,
    AutoExposure,
    FixedExposure,
    expose,
    ideal_image,
    through_lens,
)
from .depth_cameras import ActiveStereo, DepthCamera, IdealDepth, StructuredLight
from .raycast import SceneView, cast
from .scenes import SCENE_NAMES, build_scenario
from .textures import build_textures

_SENSORS: dict[str, type[DepthCamera]] = {
    'kinect': StructuredLight,
    'd435i': ActiveStereo,
    'ideal': IdealDepth,
}
_IndexT = TypeVar('_IndexT', int, NDArray[np.int64])
_START_NS = 1_000_000_000_000
_RATE_HZ = 30
_FRAMES_RANGE, _SEED_RANGE, _SPEED_RANGE = (1, 1_000_000), (0, 2**31 - 1), (0.1, 10.0)


@dataclass(frozen=True)
class SyntheticOptions:
    """The options in an address, after the question mark."""

    frames: int = 300
    seed: int = 0  # of noise, hand shake and clutter
    sensor: str = 'kinect'
    speed: float = 1.0  # of the hand along its path

    def __post_init__(self) -> None:
        """Check the options; raises `SourceError` with the valid choices."""
        if self.sensor not in _SENSORS:
            raise SourceError(f'unknown sensor {self.sensor!r}: one of {", ".join(_SENSORS)}')
        for key, (low, high) in (
            ('frames', _FRAMES_RANGE),
            ('seed', _SEED_RANGE),
            ('speed', _SPEED_RANGE),
        ):
            if not low <= getattr(self, key) <= high:
                raise SourceError(f'{key}={getattr(self, key)} is not within {low} to {high}')


class SyntheticSource:
    """A `Source` that renders each frame when it is requested."""

    camera = PinholeCamera(640, 480, 525.0, 525.0, 319.5, 239.5)

    def __init__(
        self, scene: str, options: SyntheticOptions | None = None, name: str = ''
    ) -> None:
        """Build `scene`, one of room, plane and zigzag."""
        if scene not in SCENE_NAMES:
            raise SourceError(f'unknown scene {scene!r}: one of {", ".join(SCENE_NAMES)}')
        self.options = options or SyntheticOptions()
        self.name = name or f'synthetic:{scene}'
        self._scenario = build_scenario(scene, self.options.seed)
        self._path = HandHeldPath(self._scenario.motion, self.options.seed, self.options.speed)
        self._depth_camera: DepthCamera = _SENSORS[self.options.sensor]()
        self._ideal = self.options.sensor == 'ideal'
        self._lag_phases = np.random.default_rng((self.options.seed, 3)).uniform(0, 2 * np.pi, 3)
        self.sensor: SensorNoise = self._depth_camera.noise
        # True time of a depth image minus its stamp, which a tracker may estimate.
        self.colour_depth_offset_ms: float = self._depth_camera.offset_ms

    @classmethod
    def from_address(cls, address: str) -> SyntheticSource:
        """Open `synthetic:scene[?frames=300&seed=0&sensor=kinect&speed=1]`."""
        parts = urlsplit(address)
        if parts.scheme != 'synthetic':
            raise SourceError(f'{address!r} does not begin with synthetic:')
        return cls(parts.path, _parse_options(parts.query), address)

    def __len__(self) -> int:
        """Return the number of frames."""
        return self.options.frames

    def __iter__(self) -> Iterator[RgbdFrame]:
        """Render the frames from the first; the bytes are the same each time."""
        exposure = FixedExposure() if self._ideal else AutoExposure()
        for index in range(self.options.frames):
            yield self.render(index, exposure)

    def imu(self) -> Iterator[ImuSample]:
        """Return nothing: there is no IMU."""
        return iter(())

    @cached_property
    def groundtruth(self) -> Trajectory | None:
        """True camera poses at the colour stamps."""
        stamps_ns = self._stamp_ns(np.arange(self.options.frames, dtype=np.int64))
        return Trajectory(stamps_ns, self._path.poses((stamps_ns - _START_NS) * 1e-9))

    def pose(self, stamp_ns: int) -> NDArray[np.float64]:
        """Return the true T_world_cam (4, 4) at any time."""
        return self._path.poses(np.array([(stamp_ns - _START_NS) * 1e-9]))[0]

    def depth_lag_ns(self, index: int) -> int:
        """Return by how much depth's stamp precedes colour's: it drifts, as of separate clocks."""
        low, high = self._depth_camera.lag_ms
        waves = np.sin(2 * np.pi * index / np.array([211.0, 83.0, 9.7]) + self._lag_phases)
        share = 0.5 + waves @ np.array([0.25, 0.17, 0.08])
        return round((low + (high - low) * share) * 1e6)

    def _stamp_ns(self, index: _IndexT) -> _IndexT:
        return _START_NS + (index * 1_000_000_000 + _RATE_HZ // 2) // _RATE_HZ

    def render(
        self, index: int, exposure: AutoExposure | FixedExposure | None = None
    ) -> RgbdFrame:
        """Render one frame, at unit gain unless given the exposure after the frames before it."""
        stamp_ns = self._stamp_ns(index)
        depth_stamp_ns = stamp_ns - self.depth_lag_ns(index)
        view = self._cast(stamp_ns, color=True)
        view.radiance[...] = through_lens(view.radiance)
        if self._ideal:
            return RgbdFrame(stamp_ns, depth_stamp_ns, ideal_image(view), view.depth_m)
        exposure = exposure or FixedExposure()
        seed = self.options.seed
        end = self.pose(stamp_ns + round(EXPOSURE_S * 0.5e9))
        T_later_now = np.linalg.inv(end) @ self.pose(stamp_ns)
        color = expose(view, self.camera, T_later_now, exposure.gain, seed, index)
        exposure.react(view.radiance)
        true_ns = depth_stamp_ns + round(self.colour_depth_offset_ms * 1e6)
        then = self._cast(true_ns, color=self._depth_camera.sees_texture)
        depth_m = self._depth_camera.measure(
            then, self.camera, self._scenario.pattern, seed, index
        )
        return RgbdFrame(stamp_ns, depth_stamp_ns, color, depth_m)

    def _cast(self, stamp_ns: int, color: bool) -> SceneView:
        textures, pose = build_textures(), self.pose(stamp_ns)
        return cast(self._scenario.scene, textures, self.camera, pose, color=color)


def _parse_options(query: str) -> SyntheticOptions:
    """Parse key=value pairs; raises `SourceError` with the valid keys or values."""
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query))
    except ValueError as error:
        raise SourceError(f'cannot read {query!r}: expected key=value[&key=value]') from error
    known = [field.name for field in fields(SyntheticOptions)]
    for k, (key, _) in enumerate(pairs):
        if key not in known:
            raise SourceError(f'unknown key {key!r}: one of {", ".join(known)}')
        if key in dict(pairs[:k]):
            raise SourceError(f'{key} is given twice')
    values: dict[str, Any] = {key: _parse_value(key, text) for key, text in pairs}
    return SyntheticOptions(**values)


def _parse_value(key: str, text: str) -> int | float | str:
    if key == 'sensor':
        return text
    kind, kind_name = (float, 'a number') if key == 'speed' else (int, 'an integer')
    try:
        return kind(text)
    except ValueError as error:
        raise SourceError(f'{key}={text!r} is not {kind_name}') from error
