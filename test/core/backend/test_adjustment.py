# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Bundle adjustment: derivatives, and what it recovers from noise that is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.backend.adjustment import Tracks, _sighting, adjust
from dcgs_ros.core.backend.edges import Edge
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.keyframe import Sightings

CAMERA = PinholeCamera(640, 480, 525.0, 525.0, 319.5, 239.5)
ODOMETRY = np.diag(np.square(np.repeat([0.01, 0.005], 3)))  # m, rad
STEP = 1e-6  # of finite differences
EXACT_M = 1e-5  # rays are float32
KEYFRAMES = 10


@dataclass(frozen=True)
class Scene:
    truth: NDArray[np.float64]  # (K, 4, 4)
    start: NDArray[np.float64]  # (K, 4, 4) by odometry
    edges: list[Edge]
    sightings: list[Sightings]

    def error_m(self, poses: NDArray[np.float64]) -> float:
        offsets = poses[:, :3, 3] - self.truth[:, :3, 3]
        return float(np.sqrt(np.mean(np.sum(offsets**2, axis=1))))


def scene(seed: int, pixel: float = 0.0, depth: float = 0.0, bias: float = 0.0) -> Scene:
    """Look at a wall of corners 2 to 3 m away from along 2 m; with noise of each kind.

    `pixel` in pixels, `depth` relative, and a relative `bias` that rises across the image.
    """
    rng = np.random.default_rng(seed)
    truth = np.array([
        se3.exp(np.array([0.2 * k, 0.02 * k, 0.0, 0.02 * k, -0.03 * k, 0.01 * k]))
        for k in range(KEYFRAMES)
    ])  # fmt: skip
    corners = np.column_stack([
        rng.uniform(-1.5, 3.5, 400), rng.uniform(-1.2, 1.2, 400), rng.uniform(2.0, 3.0, 400),
    ])  # fmt: skip
    start, edges = [truth[0]], []
    for k in range(1, KEYFRAMES):
        noise = np.linalg.cholesky(ODOMETRY) @ rng.normal(size=6)
        T = se3.inverse(truth[k - 1]) @ truth[k] @ se3.exp(noise)
        edges.append(Edge(k - 1, k, T, np.linalg.inv(ODOMETRY), loop=False))
        start.append(start[-1] @ T)
    return Scene(truth, np.array(start), edges, [
        seen(T, corners, rng, pixel, depth, bias) for T in truth
    ])  # fmt: skip


def seen(
    T: NDArray[np.float64],
    corners: NDArray[np.float64],
    rng: np.random.Generator,
    pixel: float,
    depth: float,
    bias: float,
) -> Sightings:
    q = se3.transform(se3.inverse(T), corners)
    rays = q[:, :2] / q[:, 2:]
    visible = np.flatnonzero((np.abs(rays) < (0.6, 0.45)).all(axis=1))
    z = q[visible, 2] * (1 + depth * rng.normal(size=len(visible)) + bias * rays[visible, 0])
    noisy = rays[visible] + pixel / CAMERA.focal * rng.normal(size=(len(visible), 2))
    return Sightings(visible, noisy.astype(np.float32), z.astype(np.float32))


def adjusted(of: Scene, config: Config | None = None) -> NDArray[np.float64]:
    return adjust(of.start, Tracks.of(of.sightings), of.edges, {0}, CAMERA, config or Config())


@pytest.mark.parametrize('depth', [0.0, 2.2, 3.5], ids=['no depth', 'near', 'outlier'])
def test_derivatives_of_a_sighting(depth: float) -> None:
    """Weights change slowly: beyond Huber's limit the derivative is that of the weighted one."""
    rng = np.random.default_rng(3)
    T, point = se3.exp(0.3 * rng.normal(size=6)), np.array([0.3, -0.2, 2.3])
    q = se3.transform(se3.inverse(T), point[None])[0]
    ray = (q[:2] / q[2] + 1e-4).astype(np.float32)
    sensor = (750.0, 0.001, 0.0015, 0.01)

    def evaluated(
        T: NDArray[np.float64], point: NDArray[np.float64]
    ) -> tuple[float, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        e, J_pose, J_point = np.empty(3), np.empty((3, 6)), np.empty((3, 3))
        cost = _sighting(ray, np.float32(depth), T, point, sensor, e, J_pose, J_point)
        return cost, e, J_pose, J_point

    _, e, J_pose, J_point = evaluated(T, point)
    for by, J, moved in (
        (6, J_pose, lambda xi: evaluated(T @ se3.exp(xi), point)[0]),
        (3, J_point, lambda d: evaluated(T, point + d)[0]),
    ):
        slopes = [(moved(STEP * d) - moved(-STEP * d)) / (2 * STEP) for d in np.eye(by)]
        np.testing.assert_allclose(2 * e @ J, slopes, rtol=1e-4, atol=1e-3)


def test_exact_sightings_leave_no_error() -> None:
    of = scene(0)
    weak = [replace(edge, information=1e-6 * edge.information) for edge in of.edges]
    found = adjust(of.start, Tracks.of(of.sightings), weak, {0}, CAMERA, Config())
    assert of.error_m(of.start) > 1e-2 > EXACT_M > of.error_m(found)


@pytest.mark.parametrize('seed', [1, 2, 3])
def test_corners_seen_by_many_keyframes_halve_the_drift(seed: int) -> None:
    of = scene(seed, pixel=0.7, depth=0.003)
    assert of.error_m(adjusted(of)) < 0.5 * of.error_m(of.start)


def test_a_bias_of_depth_harms_less_where_the_sensor_says_that_it_may_be() -> None:
    trusting = Config()
    doubting = override(trusting, {'sensor.depth_bias': 0.03})
    errors = [
        [of.error_m(adjusted(of, config)) for of in (scene(s, 0.3, 0.002, 0.06) for s in range(4))]
        for config in (trusting, doubting)
    ]
    assert np.mean(errors[1]) < 0.8 * np.mean(errors[0])


def test_a_few_wrong_sightings_do_little() -> None:
    clean = scene(4, pixel=0.7, depth=0.003)
    rng = np.random.default_rng(5)
    wrong = []
    for s in clean.sightings:
        rays = s.rays.copy()
        rays[rng.random(len(rays)) < 0.05] += np.float32(0.05)
        wrong.append(Sightings(s.ids, rays, s.depths_m))
    spoiled = Scene(clean.truth, clean.start, clean.edges, wrong)
    assert clean.error_m(adjusted(spoiled)) < 2.0 * clean.error_m(adjusted(clean)) + 1e-3


def test_fixed_keyframes_stay_and_without_corners_odometry_decides() -> None:
    of = scene(6, pixel=0.7)
    tracks = Tracks.of(of.sightings)
    poses = adjust(of.start, tracks, of.edges, {0, 1, 2}, CAMERA, Config())
    np.testing.assert_allclose(poses[:3], of.start[:3], atol=1e-12)
    assert np.abs(poses[3:] - of.start[3:]).max() > 1e-4
    none = Tracks.of([Sightings.none()] * KEYFRAMES)
    poses = adjust(of.start, none, of.edges, {0}, CAMERA, Config())
    np.testing.assert_allclose(poses, of.start, atol=1e-9)
    assert not len(adjust(np.empty((0, 4, 4)), Tracks.of([]), [], set(), CAMERA, Config()))


def sighting(ids: Sequence[int], depths_m: Sequence[float]) -> Sightings:
    rays = np.array([[0.01 * i, -0.02 * i] for i in ids], np.float32).reshape(-1, 2)
    return Sightings(np.array(ids, np.int64), rays, np.array(depths_m, np.float32))


def test_tracks_are_of_corners_that_two_see_and_one_measures() -> None:
    tracks = Tracks.of([
        sighting([7, 3, 9], [1.0, 2.0, 0.0]), sighting([9, 3], [0.0, 0.0]), sighting([3], [2])
    ])  # fmt: skip
    assert tracks.starts.tolist() == [0, 3] and tracks.keyframes.tolist() == [0, 1, 2]
    assert tracks.depths_m.tolist() == [2.0, 0.0, 2.0]
    np.testing.assert_allclose(tracks.rays, np.tile([0.03, -0.06], (3, 1)), rtol=1e-6)
    np.testing.assert_allclose(
        tracks.points(np.tile(np.eye(4), (3, 1, 1))), [[0.06, -0.12, 2.0]], rtol=1e-6
    )


def test_the_same_input_gives_the_same_bytes() -> None:
    of = scene(7, pixel=0.7, depth=0.003)
    assert adjusted(of).tobytes() == adjusted(of).tobytes()
