# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Live nodes and whatever a camera, a network or a user does to them."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from copy import deepcopy
from itertools import islice
from pathlib import Path
from subprocess import Popen
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')

from camera import Camera, halved, shots  # type: ignore[import-not-found]
from robot import Robot  # type: ignore[import-not-found]
from test_fuzz import (  # type: ignore[import-not-found]
    CAMERA,
    COLOR,
    DEPTH,
    IMAGE_FAULTS,
    INFO_FAULTS,
)

from dcgs_ros.core import se3
from dcgs_ros.nodes.messages.camera_info import write_camera
from dcgs_ros.nodes.messages.headers import header, time_message
from dcgs_ros.nodes.messages.images import write_color, write_depth_mm
from dcgs_ros.nodes.session import wait_until

pytestmark = pytest.mark.slow

OPTICAL_WXYZ = np.array([0.5, -0.5, 0.5, -0.5])  # of the camera on the base, REP 103
WRONG_M = 0.08  # a pose farther from the truth than this is wrong; drift over seconds is a third
KNOWN_NS = 10_000_000  # how near a pose's stamp the truth is
HAND_M_PER_S, NOISE_M = 1.5, 0.03  # how far apart two poses may be
TRACKED = 0.9  # of what can be, while the machine does other things
SOON_S = 20.0
GAP = 60  # frames
DROPPED, SWAPPED = 0.2, 0.3
FUZZED, FUZZED_KEYFRAMES = 10_000, 300
ACKNOWLEDGED_EVERY = 4  # fewer than a subscriber of images keeps
GROWTH_MB = 60.0
LINES = 40  # of the log: one in five seconds is meant
CLAIMED_BYTES = 2**31 - 1


def begin(robot: Robot, *others: str) -> tuple[Popen[bytes], Camera]:
    """Start a tracker, and a camera that it listens to."""
    tracker = robot.tracker(node__resume=False)
    camera = Camera(robot.observer.node)
    robot.wait_ready('tracker', *others)
    camera.connect()
    return tracker, camera


def log(robot: Robot, node: str = 'tracker') -> str:
    return next(robot.logs.glob(f'{node}-*.log')).read_text()


def texts(robot: Robot) -> list[str]:
    return [text for _, name, _, text in robot.observer.history if name == 'dcgs_tracker']


def settle(robot: Robot) -> None:
    """Wait until poses no longer come, and two reports after them have."""
    wait_until(lambda: not grows(lambda: len(robot.observer.poses), 0.5), SOON_S, 'rest')
    reports = len(robot.observer.history)
    wait_until(lambda: len(robot.observer.history) >= reports + 2, SOON_S, 'reports')


def grows(count: Callable[[], int], within_s: float) -> bool:
    before = count()
    time.sleep(within_s)
    return count() > before


def cameras(robot: Robot) -> dict[int, np.ndarray]:
    """T_world_cam of the poses that came, by stamp."""
    T_base_cam = se3.from_quaternion(OPTICAL_WXYZ, np.zeros(3))
    return {k: T @ T_base_cam for k, T in list(robot.observer.poses.items())}


def errors_m(robot: Robot) -> np.ndarray:
    """How far each pose is from where the camera was, seen from the first one with truth."""
    truth = robot.source.groundtruth
    poses = cameras(robot)
    stamps = np.array(sorted(poses))
    distances_ns = np.abs(truth.stamps_ns[:, None] - stamps)
    stamps = stamps[distances_ns.min(0) < KNOWN_NS]
    true = truth.T_world_cam[distances_ns.argmin(0)[distances_ns.min(0) < KNOWN_NS]]
    tracked = np.array([poses[k] for k in stamps])
    moved = se3.inverse(tracked[0]) @ tracked
    truly = np.linalg.inv(true[0]) @ true
    return np.linalg.norm(moved[:, :3, 3] - truly[:, :3, 3], axis=1)


def no_wrong_jump(robot: Robot) -> None:
    """Poses that follow each other are no farther apart than a hand moves; none is wrong."""
    poses = cameras(robot)
    stamps = np.array(sorted(poses))
    steps_m = np.linalg.norm(np.diff([poses[k][:3, 3] for k in stamps], axis=0), axis=1)
    passed_s = np.diff(stamps) * 1e-9
    far = steps_m > HAND_M_PER_S * passed_s + NOISE_M
    off_m = errors_m(robot)
    assert not far.any(), f'{steps_m[far]} m in {passed_s[far]} s'
    assert off_m.max() < WRONG_M


def test_after_a_gap_the_camera_is_found_where_it_was_or_said_to_be_lost(robot: Robot) -> None:
    tracker, camera = begin(robot)
    taken = shots(robot.source, 45 + GAP + 30)
    before, after = taken[:45], taken[45 + GAP :]
    camera.play(before)
    time.sleep(3.5)  # of which two pass before it is said
    assert any('no images for' in text for text in texts(robot))
    reports = len(texts(robot))
    camera.play(after)
    settle(robot)
    came = sum(s.stamp_ns in robot.observer.poses for s in after)
    assert came > TRACKED * len(after) or any(
        'move back to where it was tracked' in text for text in texts(robot)[reports:]
    )
    no_wrong_jump(robot)
    # The camera goes back.
    robot.observer.poses.clear()
    camera.play(before)
    settle(robot)
    assert len(robot.observer.poses) > TRACKED * len(before)
    assert tracker.poll() is None and texts(robot)[-1] != 'lost'


@pytest.mark.parametrize('topic', ['color', 'depth'])
def test_a_fifth_of_one_topic_may_be_lost(robot: Robot, topic: str) -> None:
    _, camera = begin(robot)
    rng, taken = random.Random(1), shots(robot.source, 90)
    whole = 0
    for shot in taken:
        lost = rng.random() < DROPPED
        camera.send(
            shot, *(n for n in ('camera_info', 'color', 'depth') if n != topic or not lost)
        )
        whole += not lost
        time.sleep(1 / 30)
    settle(robot)
    assert TRACKED * whole < len(robot.observer.poses) <= whole
    other = 'depth' if topic == 'color' else 'color'
    unpaired = robot.observer.value('dcgs_tracker', f'unpaired_{other}')
    assert unpaired >= len(taken) - whole - 1
    no_wrong_jump(robot)


def test_stamps_out_of_order_do_no_harm(robot: Robot) -> None:
    tracker, camera = begin(robot)
    rng, taken = random.Random(2), shots(robot.source, 90)
    for k in range(10, len(taken) - 1, 2):
        if rng.random() < SWAPPED:
            taken[k], taken[k + 1] = taken[k + 1], taken[k]
    camera.play(taken)
    settle(robot)
    assert tracker.poll() is None
    assert robot.observer.value('dcgs_tracker', 'disorder') > 0
    assert len(robot.observer.poses) > (1 - SWAPPED) * TRACKED * len(taken)
    no_wrong_jump(robot)


def test_when_the_clock_jumps_back_the_camera_is_found_in_the_map(robot: Robot) -> None:
    _, camera = begin(robot)
    taken = shots(robot.source, 60)
    camera.play(taken)
    settle(robot)
    first = dict(robot.observer.poses)
    robot.observer.poses.clear()
    camera.play(taken)
    settle(robot)
    assert 'stamps went back' in log(robot)
    common = sorted(first.keys() & robot.observer.poses.keys())
    assert len(common) > TRACKED * len(taken)
    off = [first[k][:3, 3] - robot.observer.poses[k][:3, 3] for k in common]
    assert np.linalg.norm(off, axis=1).max() < WRONG_M
    assert robot.observer.value('dcgs_tracker', 'keyframes') > 0


def test_another_resolution_begins_a_map_at_the_last_pose(robot: Robot) -> None:
    tracker, camera = begin(robot)
    source = robot.source
    frames = list(islice(source, 120))
    taken = shots(source, 120)
    taken[40:80] = [halved(frame, source.camera) for frame in frames[40:80]]
    camera.play(taken)
    settle(robot)
    assert tracker.poll() is None
    assert log(robot).count('the camera changed from') >= 1  # what repeats soon is not said again
    assert len(robot.observer.poses) > TRACKED * len(taken)
    assert texts(robot)[-1].startswith(('tracking', 'degenerate'))
    no_wrong_jump(robot)


def test_depth_of_another_frame_is_refused_with_the_reason(robot: Robot) -> None:
    tracker, camera = begin(robot)
    taken = shots(robot.source, 90)
    for shot in taken[:30]:
        shot.messages['depth'].header.frame_id = 'camera_depth_optical_frame'
    camera.play(taken[:30])
    settle(robot)
    assert not robot.observer.poses
    assert any('could be used: see the log' in text for text in texts(robot))
    assert "depth in 'camera_depth_optical_frame': it is not registered" in log(robot)
    camera.play(taken[30:])
    settle(robot)
    assert len(robot.observer.poses) > TRACKED * 60
    assert tracker.poll() is None


def rss_mb(process: Popen[bytes]) -> float:
    lines = Path(f'/proc/{process.pid}/status').read_text().splitlines()
    return int(next(line for line in lines if line.startswith('VmRSS')).split()[1]) / 1024


def broken(message: Any, faults: tuple[Any, ...], rng: random.Random) -> Any:
    for _ in range(rng.randint(1, 3)):
        rng.choice(faults)(message, rng)
    return message


def placed(message: Any, at_ns: int, rng: random.Random) -> Any:
    message.header.stamp = time_message(at_ns)
    message.header.frame_id = rng.choice(['', 'é' * 5000, 'a', 'b', 'camera'])
    return message


def fuzz_camera(camera: Camera, count: int, first_ns: int) -> None:
    """Send frames of which at least one message is broken."""
    rng = random.Random(3)
    good = {
        'color': (write_color(COLOR, header(1, '')), IMAGE_FAULTS),
        'depth': (write_depth_mm(DEPTH, header(1, '')), IMAGE_FAULTS),
        'camera_info': (write_camera(CAMERA, header(1, '')), INFO_FAULTS),
    }
    for k in range(count):
        name = rng.choice(list(good))
        at_ns = first_ns + k // 3 * 33_000_000
        message, faults = good[name]
        message = placed(broken(deepcopy(message), faults, rng), at_ns, rng)
        camera.publishers[name].publish(message)
        if k % ACKNOWLEDGED_EVERY == 0:
            for publisher in camera.publishers.values():
                publisher.wait_for_all_acked()


def test_ten_thousand_broken_messages_do_not_stop_the_tracker(robot: Robot) -> None:
    tracker, camera = begin(robot)
    taken = shots(robot.source, 90)
    camera.play(taken[:45])
    settle(robot)
    last_ns = taken[44].stamp_ns
    fuzz_camera(camera, FUZZED // 10, last_ns)  # loads what is loaded once
    settle(robot)
    before_mb, lines = rss_mb(tracker), len(log(robot).splitlines())
    fuzz_camera(camera, FUZZED, last_ns + 10**12)
    settle(robot)
    assert tracker.poll() is None
    assert rss_mb(tracker) - before_mb < GROWTH_MB
    assert len(log(robot).splitlines()) - lines < LINES
    robot.observer.poses.clear()
    camera.play(taken[45:])
    settle(robot)
    assert len(robot.observer.poses) > TRACKED * 45
    assert texts(robot)[-1].startswith(('tracking', 'degenerate'))
