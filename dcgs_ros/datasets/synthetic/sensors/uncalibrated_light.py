# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Simulated structured light as it is used without a calibration: biased and misregistered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ....core.camera import PinholeCamera
from ....core.sensor import SensorNoise
from ..noise import smoothed, white_noise
from ..raycast import SceneView
from .color_camera import LUMA
from .depth_camera import DEPTH_NOISE, Shot
from .structured_light import StructuredLight

_BIAS_STREAM, _HOLE_STREAM = 4, DEPTH_NOISE + 1
_WHITE_LEVEL = 200.0  # grey levels of a white surface
_LEAST_RETURN = 0.055  # of a white surface at 1 m, seen straight on


class UncalibratedLight:
    """Kinect v1 with a depth bias and a misregistration of its own, holes where little returns."""

    noise = replace(StructuredLight.noise, depth_bias=SensorNoise.kinect().depth_bias)
    lag_ms = StructuredLight.lag_ms
    offset_ms = StructuredLight.offset_ms
    sees_texture = True

    def __init__(self, seed: int) -> None:
        """Draw the camera: a quadratic bias of 1.5 to 3 % at most, 1 to 2 pixels of shift."""
        rng = np.random.default_rng((seed, _BIAS_STREAM))
        radius, angle = rng.uniform(1.0, 2.0), rng.uniform(0, 2 * np.pi)
        self.shift_px = (float(radius * np.cos(angle)), float(radius * np.sin(angle)))
        self._coefficients = rng.standard_normal(5)
        self._most = float(rng.uniform(0.015, 0.03))
        self._camera = StructuredLight()

    def bias(self, height: int, width: int) -> NDArray[np.float64]:
        """Return the relative error (H, W) of depth; its mean is about zero."""
        y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing='ij')
        terms = np.stack([x, y, x * y, x * x - 1 / 3, y * y - 1 / 3])
        field = np.tensordot(self._coefficients, terms, 1)
        result: NDArray[np.float64] = field * (self._most / np.abs(field).max())
        return result

    def measure(self, view: SceneView, camera: PinholeCamera, shot: Shot) -> NDArray[np.float32]:
        """Measure as `StructuredLight` does, lose what is dark, far or grazing, bias the rest."""
        measured = self._camera.measure(view, camera, shot)
        shape = (measured.shape[0], measured.shape[1])
        ragged = smoothed(white_noise(shot.seed, shot.index, _HOLE_STREAM, (1, *shape))[0], 1.5)
        albedo = view.radiance @ LUMA / np.float32(_WHITE_LEVEL)
        z = np.maximum(view.depth_m, np.float32(0.1))
        returned = albedo * view.cosine / (z * z)
        lost = returned < np.float32(_LEAST_RETURN) * (1 + np.float32(0.2) * ragged)
        biased = measured * (1 + self.bias(*shape)).astype(np.float32)
        return np.where(lost, np.float32(0.0), biased)
