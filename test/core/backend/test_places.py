# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Features, the index over them, and poses from matches; on drawn data and on rendered frames."""

from __future__ import annotations

import threading
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.backend.alignment import align, match
from dcgs_ros.core.backend.features import Features, extract
from dcgs_ros.core.backend.places import Places
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.sensor import SensorNoise
from dcgs_ros.datasets.synthetic.source import SyntheticSource

ROOM = 'synthetic:room?frames=40&sensor=ideal&speed=3'
SENSOR, FOCAL = SensorNoise(), 525.0
FLIPPED = 0.06  # share of ORB's bits that another view of a corner changes
NEAR_M, NEAR_RAD = 0.02, np.radians(1.0)
G = se3.exp(np.array([0.3, -0.2, 0.1, 0.05, 0.4, -0.1]))
OFF = np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
SMALL_M, SMALL_RAD = 0.005, np.radians(0.3)


@cache
def source_of(address: str) -> SyntheticSource:
    return SyntheticSource.from_address(address)


@cache
def frames_of(address: str) -> tuple[RgbdFrame, ...]:
    return tuple(source_of(address))


def bits(rng: np.random.Generator, count: int) -> NDArray[np.uint8]:
    return rng.integers(0, 256, (count, 32), np.uint8)


def seen_again(rng: np.random.Generator, descriptors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    flips = np.packbits(rng.random((len(descriptors), 256)) < FLIPPED, axis=1)
    return descriptors ^ flips


def features(descriptors: NDArray[np.uint8], points: NDArray[np.float64]) -> Features:
    """Return features of points (N, 3) in the camera frame."""
    rays = (points[:, :2] / points[:, 2:]).astype(np.float32)
    return Features(descriptors, rays, points[:, 2].astype(np.float32))


def anywhere(descriptors: NDArray[np.uint8]) -> Features:
    return features(descriptors, np.ones((len(descriptors), 3)))


def relative(address: str, a: int, b: int) -> NDArray[np.float64]:
    truth = source_of(address).groundtruth
    assert truth is not None
    return np.asarray(se3.inverse(truth.T_world_cam[a]) @ truth.T_world_cam[b])


def assert_near(
    T: NDArray[np.float64], other: NDArray[np.float64], metres: float, radians: float
) -> None:
    xi = se3.log(se3.inverse(T) @ other)
    assert np.linalg.norm(xi[:3]) < metres and np.linalg.norm(xi[3:]) < radians


def an_index(rng: np.random.Generator, count: int) -> tuple[Places, list[NDArray[np.uint8]]]:
    places, all_bits = Places(source_of(ROOM).camera, Config()), []
    for k in range(count):
        all_bits.append(bits(rng, 100))
        places.add(10 * k, anywhere(all_bits[-1]))
    return places, all_bits


def test_the_keyframe_that_shows_the_same_corners_is_first() -> None:
    rng = np.random.default_rng(0)
    places, all_bits = an_index(rng, 60)
    for k in (0, 17, 59):
        query = np.concatenate([seen_again(rng, all_bits[k][:40]), bits(rng, 60)])
        found = places.candidates(anywhere(query), 3)
        assert found[0] == 10 * k
        assert 10 * k not in places.candidates(anywhere(query), 3, without={10 * k})
    assert len(places) == 60


def test_words_that_all_keyframes_have_say_less_than_rare_ones() -> None:
    rng = np.random.default_rng(1)
    places, common = Places(source_of(ROOM).camera, Config()), bits(rng, 60)
    rare = bits(rng, 20)
    for k in range(40):
        own = rare if k == 23 else bits(rng, 20)
        shared = common if k != 23 else common[:45]
        places.add(k, anywhere(np.concatenate([shared, own])))
    query = np.concatenate([seen_again(rng, common), seen_again(rng, rare)])
    assert places.candidates(anywhere(query), 1) == [23]


def test_nothing_looks_like_an_image_without_features() -> None:
    places, _ = an_index(np.random.default_rng(2), 3)
    assert places.candidates(anywhere(np.empty((0, 32), np.uint8)), 5) == []
    empty = Places(source_of(ROOM).camera, Config())
    assert empty.candidates(anywhere(bits(np.random.default_rng(3), 50)), 5) == []


def test_one_thread_may_add_while_another_asks() -> None:
    rng = np.random.default_rng(4)
    places, all_bits = an_index(rng, 5)
    more = [anywhere(bits(rng, 300)) for _ in range(200)]

    def add_all() -> None:
        for k, one in enumerate(more):
            places.add(1000 + k, one)

    adding = threading.Thread(target=add_all)
    adding.start()
    while adding.is_alive():
        assert places.candidates(anywhere(all_bits[2]), 1) == [20]
    adding.join()
    assert len(places) == 205


def two_views(
    seed: int, wrong: float, pixel: float
) -> tuple[Features, Features, NDArray[np.float64]]:
    """Return features of two views, `wrong` of which match something else, and T_a_b."""
    rng = np.random.default_rng(seed)
    a = np.column_stack([rng.uniform(-1, 1, (120, 2)), rng.uniform(1.5, 3.0, 120)])
    T_a_b = se3.exp(np.array([0.3, -0.1, 0.2, 0.1, -0.25, 0.3]))
    b = se3.transform(se3.inverse(T_a_b), a).astype(np.float64)
    off = rng.random(120) < wrong
    b[off] = np.column_stack([rng.uniform(-1, 1, (off.sum(), 2)), rng.uniform(1, 3, off.sum())])
    descriptors = bits(rng, 120)
    seen = features(seen_again(rng, descriptors), b)
    rays = seen.rays + (pixel / FOCAL * rng.normal(size=seen.rays.shape)).astype(np.float32)
    return features(descriptors, a), replace(seen, rays=rays), T_a_b


@pytest.mark.parametrize('wrong', [0.0, 0.5, 0.7])
def test_a_pose_is_found_among_wrong_matches(wrong: float) -> None:
    a, b, T_a_b = two_views(5, wrong, pixel=0.5)
    found = align(a, b, SENSOR, FOCAL, seed=0)
    assert found is not None
    assert_near(found.T_a_b, T_a_b, NEAR_M, NEAR_RAD)
    assert found.inliers > 0.8 * (1 - wrong) * 120
    assert np.array_equal(found.of_a, found.of_b)
    again = align(a, b, SENSOR, FOCAL, seed=0)
    assert again is not None and again.T_a_b.tobytes() == found.T_a_b.tobytes()


def test_most_features_of_the_second_view_need_no_depth() -> None:
    a, b, T_a_b = two_views(6, 0.3, pixel=0.3)
    depths = np.where(np.arange(120) % 4 == 0, b.depths_m, np.float32(0.0))
    found = align(a, replace(b, depths_m=depths), SENSOR, FOCAL, seed=0)
    assert found is not None and (depths[found.of_b] == 0).sum() > 40
    assert_near(found.T_a_b, T_a_b, NEAR_M, NEAR_RAD)


def test_what_agrees_by_chance_is_no_pose() -> None:
    a, b, _ = two_views(7, 1.0, pixel=0.5)
    assert align(a, b, SENSOR, FOCAL, seed=0) is None
    other = features(bits(np.random.default_rng(8), 120), b.points)
    assert len(match(a, other)[0]) < 5 and align(a, other, SENSOR, FOCAL, seed=0) is None
    assert align(a, b[np.arange(1)], SENSOR, FOCAL, seed=0) is None


def test_two_corners_that_look_alike_match_nothing() -> None:
    rng = np.random.default_rng(9)
    one = bits(rng, 30)
    a, twins = anywhere(one), anywhere(np.concatenate([one, seen_again(rng, one)]))
    of_a, _ = match(a, twins)
    assert len(of_a) == 30  # identical ones are clearly the better of the two
    masks = np.zeros((2, 1, 32), np.uint8)
    masks[0, 0, :4] = masks[1, 0, 4:8] = 3  # eight bits each: equally far from the first
    assert not len(match(a, anywhere(np.concatenate([one ^ masks[0], one ^ masks[1]])))[0])


def test_features_are_everywhere_in_the_image_with_their_depth() -> None:
    source, frame = source_of(ROOM), frames_of(ROOM)[0]
    found = extract(frame, source.camera, source.sensor)
    assert 150 < len(found) < 48 * 14 + 1
    pixels = source.camera.project(np.column_stack([found.rays, np.ones(len(found))]))
    cells = np.unique((pixels / (80, 80)).astype(int), axis=0)
    assert len(cells) > 24
    x, y = np.round(pixels).astype(int).T
    measured = found.depths_m > 0
    assert measured.mean() > 0.5
    off = np.abs(found.depths_m - frame.depth_m[y, x])[measured]
    assert np.median(off) < 0.01
    dark = RgbdFrame(0, 0, np.zeros_like(frame.color), frame.depth_m)
    assert len(extract(dark, source.camera, source.sensor)) == 0


def test_a_place_is_recognised_from_another_view() -> None:
    source, frames = source_of(ROOM), frames_of(ROOM)
    places = Places(source.camera, Config(sensor=source.sensor))
    for k in (0, 12, 24):
        places.add(k, extract(frames[k], source.camera, source.sensor))
    found = places.recognise(frames[15])[0]
    assert found.keyframe == 12
    T = relative(ROOM, 12, 15)
    assert_near(found.T_keyframe_cam, T, SMALL_M, SMALL_RAD)
    factors = found.factors(G, FOCAL, source.sensor)
    at = factors.normal_equations(G @ T)
    step = G @ T @ se3.exp(np.linalg.solve(at.H, at.g))
    assert_near(step, G @ T, SMALL_M, SMALL_RAD)
    right, wrong = (np.median(factors.chi2(pose)) for pose in (G @ T, G @ T @ se3.exp(OFF)))
    assert right < 3.0 < 30.0 < wrong
    dark = RgbdFrame(0, 0, np.zeros_like(frames[15].color), frames[15].depth_m)
    assert places.recognise(dark) == []
