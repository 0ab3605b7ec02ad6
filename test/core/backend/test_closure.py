# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Loops between keyframes of rendered scenes, and the ones that must not be found."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.backend.closure import Closures
from dcgs_ros.core.backend.warmup import warm_up
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.keyframe import Keyframe, Odometry
from dcgs_ros.datasets.synthetic.source import SyntheticSource

ROOM = 'synthetic:room?frames=40&sensor=d435i&speed=3'
PLANE = 'synthetic:plane?frames=40&sensor=kinect&speed=3'
NEAR_M, NEAR_RAD = 0.01, np.radians(0.4)
CHI2 = 30.0  # of 6 degrees of freedom; beyond it one of 25 000


@cache
def source_of(address: str) -> SyntheticSource:
    return SyntheticSource.from_address(address)


@cache
def frames_of(address: str) -> tuple[RgbdFrame, ...]:
    return tuple(source_of(address))


def relative(address: str, a: int, b: int) -> NDArray[np.float64]:
    truth = source_of(address).groundtruth
    assert truth is not None
    return np.asarray(se3.inverse(truth.T_world_cam[a]) @ truth.T_world_cam[b])


def keyframe(
    number: int, frame: RgbdFrame, hosts: Sequence[int], T_host_cam: NDArray[np.float64]
) -> Keyframe:
    odometry = Odometry(
        number, 0, np.array(hosts, np.int32), T_host_cam.reshape(-1, 4, 4),
        np.tile(1e5 / max(len(hosts), 1) * np.eye(6), (len(hosts), 1, 1)), 1e-5 * np.eye(6),
    )  # fmt: skip
    none = np.empty((0, 3), np.float32)
    return Keyframe(frame, np.eye(4), np.eye(4), np.empty(0, np.int64), none, none, odometry)


def closures(address: str, visited: Sequence[int], linked: bool) -> Closures:
    """Add frames as keyframes; each is tracked against the last one, or begins a map."""
    source = source_of(address)
    found = Closures(source.camera, Config(sensor=source.sensor))
    for number, frame in enumerate(visited):
        hosts = [number - 1] if linked and number else []
        T = np.array([relative(address, visited[h], frame) for h in hosts])
        found.add(keyframe(number, frames_of(address)[frame], hosts, T))
    return found


@pytest.mark.parametrize('b', [13, 14])
def test_a_place_that_is_seen_again_is_a_loop(b: int) -> None:
    found = closures(ROOM, [0, 12, 30, b], linked=False)
    loops = found.close(3)
    assert (1, 3) in [(loop.a, loop.b) for loop in loops]
    for loop in loops:
        true = relative(ROOM, [0, 12, 30][loop.a], b)
        xi = se3.log(se3.inverse(true) @ loop.T_a_b)
        assert np.linalg.norm(xi[:3]) < NEAR_M and np.linalg.norm(xi[3:]) < NEAR_RAD
        assert xi @ np.linalg.solve(loop.covariance, xi) < CHI2
        assert loop.inliers >= 25


def test_features_that_are_known_are_not_looked_for() -> None:
    found, known = closures(ROOM, [0, 12], linked=False), closures(ROOM, [0], linked=False)
    features = known.places.features_of(0)
    no_hosts = np.empty((0, 4, 4))
    found.add(keyframe(2, frames_of(ROOM)[30], [], no_hosts), features=features)
    assert found.places.features_of(2) is features


def test_keyframes_that_odometry_links_need_no_loop() -> None:
    assert closures(ROOM, [10, 12, 14], linked=False).close(2) != []
    assert closures(ROOM, [10, 12, 14], linked=True).close(2) == []


def test_a_place_that_is_seen_again_and_again_is_kept_once() -> None:
    """Two views in turn: all that comes after the first two is as good as linked with those."""
    found = closures(ROOM, [0, 12] * 3, linked=True)
    assert len(found.places) == 2
    assert found.places.candidates(found.places.features_of(5), 6) == [1, 0]
    assert found.close(5) == []
    with pytest.raises(KeyError):
        found.places.features_of(4)
    assert all(found.places.knows(k) for k in range(6)) and not found.places.knows(6)


def test_the_warm_up_registers_keyframes_although_the_camera_rests() -> None:
    warm_up(source_of(ROOM).camera)


def test_a_view_that_was_seen_before_closes_its_loops_first() -> None:
    found = closures(ROOM, [13, 0, 12, 12], linked=False)
    before = [(loop.a, loop.b) for loop in found.close(3)]
    assert (0, 3) in before and (2, 3) in before
    linked = closures(ROOM, [13, 0, 12], linked=False)
    linked.add(keyframe(3, frames_of(ROOM)[12], [2], np.eye(4)))
    assert [(loop.a, loop.b) for loop in linked.close(3)] == [(0, 3)]


def test_features_in_one_plane_are_no_loop_however_many_agree() -> None:
    """A floor that repeats itself gives as many at a wrong place."""
    found = closures(PLANE, [0, 3], linked=False)
    features = found.places.features_of(1)
    alignment = found.places.align(0, features)
    assert alignment is not None and alignment.inliers > 50
    assert found.close(1) == []


def test_another_place_is_no_loop() -> None:
    other = SyntheticSource.from_address('synthetic:desk?frames=2&sensor=kinect')
    found = closures(ROOM, [0, 10, 20, 30], linked=False)
    found.add(keyframe(4, next(iter(other)), [], np.empty(0)))
    assert found.close(4) == []


def test_a_pose_that_depth_contradicts_is_no_loop() -> None:
    """The right image with the depth of a camera 8 % off in scale does not fit both ways."""
    frame = frames_of(ROOM)[14]
    far = RgbdFrame(frame.stamp_ns, frame.stamp_ns, frame.color, frame.depth_m * np.float32(1.08))
    found = closures(ROOM, [0, 12, 30], linked=False)
    found.add(keyframe(3, far, [], np.empty(0)))
    assert found.close(3) == []
