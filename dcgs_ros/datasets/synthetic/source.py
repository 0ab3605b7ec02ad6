# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Synthetic sequences with exact ground truth: `synthetic:room?sensor=d435i&seed=1`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ...core.camera import PinholeCamera
from ...core.frame import RgbdFrame
from ...core.sensor import SensorNoise
from ...core.trajectory import Trajectory
from ..source import ImuSample, OdometrySample
from .motion.imu import ACCELEROMETER_NOISE, GYRO_NOISE, NO_NOISE, T_CAM_IMU, measured_imu
from .motion.odometry import NO_ERRORS, WHEELS, measured_odometry
from .motion.path import ImageMotion
from .options import SyntheticOptions, parse_address
from .raycast import Scene, SceneView, cast
from .scenes.catalogue import SCENES, build_scenario
from .sensors.catalogue import SENSORS
from .sensors.color_camera import expose, ideal_image, through_lens
from .sensors.depth_camera import DepthCamera, Shot
from .sensors.exposure import AutoExposure, Exposure, FixedExposure, MeteredExposure
from .textures import build_textures

_IndexT = TypeVar('_IndexT', int, NDArray[np.int64])
_START_NS = 1_000_000_000_000
_RATE_HZ = 30
_MARGIN_S = 0.1  # by which IMU and odometry begin before the first frame and go on after the last
IMU_FRAME = 'camera_imu_optical_frame'
_BASE_FRAMES = ('odom', 'base_link')
_LAG_STREAM, _REPEAT_STREAM = 3, 5


class SyntheticSource:
    """A `Source` that renders each frame when it is requested.

    Colour's stamp is the middle of the exposure of its middle row; with a rolling shutter row y of
    H is taken (y + 1/2) / H - 1/2 of the readout later. Depth has one instant.
    """

    def __init__(
        self, scene: str, options: SyntheticOptions | None = None, name: str = ''
    ) -> None:
        """Build `scene`, one of `SCENE_NAMES`; raises `SourceError` for options it lacks."""
        self.options = (options or SyntheticOptions()).of_scene(scene)
        self.name = name or f'synthetic:{scene}'
        seed = self.options.seed
        extras = {key: getattr(self.options, key) for key in SCENES[scene].extras}
        self._scenario = build_scenario(scene, seed, self.options.motion, **extras)
        self._path = self._scenario.motion.path(seed, self.options.speed)
        self._mover = None if self._scenario.mover is None else self._scenario.mover(self._path)
        self._kind = SENSORS[str(self.options.sensor)]
        self._depth_camera: DepthCamera = self._kind.depth(seed)
        self._lag_phases = np.random.default_rng((seed, _LAG_STREAM)).uniform(0, 2 * np.pi, 3)
        self.camera: PinholeCamera = self._kind.camera
        self._image_motion = ImageMotion(self._path, _RATE_HZ, self.camera.focal)
        self.sensor: SensorNoise = replace(
            self._depth_camera.noise, color_readout_ms=1e3 * self._kind.readout_s
        )
        self.T_cam_imu = T_CAM_IMU  # IMU to colour camera
        self.imu_frames: tuple[str, ...] = (IMU_FRAME,)
        # Camera to base, on wheels, but for vibration; None where a hand holds the camera.
        self.T_base_cam: NDArray[np.float64] | None = self._path.T_base_cam
        self.base_frame = _BASE_FRAMES[1]
        # True time of a depth image minus its stamp, which a tracker may estimate.
        self.depth_per_metre: float | None = None
        self.notes: tuple[str, ...] = ()
        self.colour_depth_offset_ms: float = self._depth_camera.offset_ms

    @classmethod
    def from_address(cls, address: str) -> SyntheticSource:
        """Open `synthetic:SCENE[?key=value&...]`; the keys are those of `SyntheticOptions`."""
        scene, options = parse_address(address)
        return cls(scene, options, address)

    def __len__(self) -> int:
        """Return the number of frames."""
        return self.options.frames

    def __iter__(self) -> Iterator[RgbdFrame]:
        """Render the frames from the first; the bytes are the same each time."""
        exposure = self._settled(0) if self._kind.metered else AutoExposure()
        color, depth_m = np.empty(0, np.uint8), np.empty(0, np.float32)
        for index in range(self.options.frames):
            # An image that comes again has the stamps of the one that should have come.
            color_again, depth_again = self._repeats[index]
            color = color.copy() if color_again else self._color(index, exposure)
            depth_m = depth_m.copy() if depth_again else self._depth(index)
            yield RgbdFrame(*self._stamps_ns(index), color, depth_m)

    def render(self, index: int) -> RgbdFrame:
        """Render one frame at unit gain, or as exposure would settle on it, and never repeated."""
        exposure = self._settled(index) if self._kind.metered else FixedExposure()
        color, depth_m = self._color(index, exposure), self._depth(index)
        return RgbdFrame(*self._stamps_ns(index), color, depth_m)

    def imu(self) -> Iterator[ImuSample]:
        """Measure rates and specific forces at 200 Hz, axes parallel to the camera's."""
        noises = (NO_NOISE, NO_NOISE) if self._kind.ideal else (GYRO_NOISE, ACCELEROMETER_NOISE)
        for block in measured_imu(self._path, *self._span_s, self.options.seed, *noises):
            stamps_ns = _START_NS + np.round(block.times_s * 1e9).astype(np.int64)
            for stamp_ns, rate, force in zip(
                stamps_ns.tolist(), block.rates.tolist(), block.forces.tolist(), strict=True
            ):
                yield ImuSample(stamp_ns, IMU_FRAME, tuple(force), tuple(rate))

    def odometry(self) -> Iterator[OdometrySample]:
        """Measure what wheels under the camera would at 50 Hz; where a hand holds it, as well."""
        errors = NO_ERRORS if self._kind.ideal else WHEELS
        for block in measured_odometry(self._path, *self._span_s, self.options.seed, errors):
            stamps_ns = _START_NS + np.round(block.times_s * 1e9).astype(np.int64)
            for stamp_ns, pose, velocity in zip(
                stamps_ns.tolist(), block.poses.tolist(), block.velocities.tolist(), strict=True
            ):
                yield OdometrySample(stamp_ns, *_BASE_FRAMES, tuple(pose), tuple(velocity))

    @property
    def scene(self) -> Scene:
        """What the camera sees, but for what moves."""
        return self._scenario.scene

    def scene_at(self, stamp_ns: int) -> Scene:
        """Return all that the camera sees at a time."""
        if self._mover is None:
            return self.scene
        there = self._mover.at((stamp_ns - _START_NS) * 1e-9)
        return self.scene if there is None else self.scene.beside(there)

    @property
    def _span_s(self) -> tuple[float, float]:
        """First and last second of what is measured beside the frames."""
        last_ns = self._stamp_ns(self.options.frames - 1)
        return -_MARGIN_S, (last_ns - _START_NS) * 1e-9 + _MARGIN_S

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

    def _stamps_ns(self, index: int) -> tuple[int, int]:
        """Return the stamps of colour and depth."""
        stamp_ns = self._stamp_ns(index)
        return stamp_ns, stamp_ns - self.depth_lag_ns(index)

    @cached_property
    def _repeats(self) -> NDArray[np.bool_]:
        """(frames, 2) whether colour and depth are the last image again."""
        rng = np.random.default_rng((self.options.seed, _REPEAT_STREAM))
        shares = self._kind.repeated_color, self._kind.repeated_depth
        drawn: NDArray[np.bool_] = rng.random((self.options.frames, 2)) < shares
        drawn[0] = False
        return drawn

    def _settled(self, index: int) -> MeteredExposure:
        return MeteredExposure(self._see(index).radiance)

    def _see(self, index: int) -> SceneView:
        """Return what the colour camera's lens gathers for a frame."""
        stamp_ns = self._stamp_ns(index)
        rows = None
        if self._kind.readout_s:
            shares = (np.arange(self.camera.height) + 0.5) / self.camera.height - 0.5
            times_s = (stamp_ns - _START_NS) * 1e-9 + shares * self._kind.readout_s
            rows = self._path.poses(times_s)
        view = self._cast(self.camera, stamp_ns, color=True, T_world_rows=rows)
        view.radiance[...] = through_lens(view.radiance) * np.float32(self.options.light)
        return view

    def _color(self, index: int, exposure: Exposure) -> NDArray[np.uint8]:
        view = self._see(index)
        if self._kind.ideal:
            return ideal_image(view)
        stamp_ns = self._stamp_ns(index)
        end = self.pose(stamp_ns + round(exposure.time_s * 0.5e9))
        T_later_now = np.linalg.inv(end) @ self.pose(stamp_ns)
        color = expose(view, self.camera, T_later_now, exposure, self.options.seed, index)
        exposure.react(view.radiance)
        return color

    def _depth(self, index: int) -> NDArray[np.float32]:
        _, depth_stamp_ns = self._stamps_ns(index)
        true_ns = depth_stamp_ns + round(self.colour_depth_offset_ms * 1e6)
        x, y = self._depth_camera.shift_px
        camera = replace(self.camera, cx=self.camera.cx + x, cy=self.camera.cy + y)
        view = self._cast(camera, true_ns, color=self._depth_camera.sees_texture)
        options, travel_px = self.options, self._image_motion(index)
        shot = Shot(options.seed, index, self._scenario.pattern, options.light, travel_px)
        return self._depth_camera.measure(view, camera, shot)

    def _cast(
        self,
        camera: PinholeCamera,
        stamp_ns: int,
        color: bool,
        T_world_rows: NDArray[np.float64] | None = None,
    ) -> SceneView:
        scene, pose = self.scene_at(stamp_ns), self.pose(stamp_ns)
        textures = build_textures()
        return cast(scene, textures, camera, pose, color=color, T_world_rows=T_world_rows)
