# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Live nodes and whatever a camera, a network or a user does to them."""

from __future__ import annotations

import random
import time
from copy import deepcopy
from dataclasses import replace
from itertools import islice
from pathlib import Path
from subprocess import Popen
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip('rclpy')

from camera import (  # type: ignore[import-not-found]
    Camera,
    Shot,
    halved,
    shots,
    zoomed,
)
from camera import shot as shot_of
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.srv import DescribeParameters, SetParameters
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from robot import Robot  # type: ignore[import-not-found]
from test_fuzz import (  # type: ignore[import-not-found]
    CAMERA,
    CLOUD_FAULTS,
    COLOR,
    DEPTH,
    IMAGE_FAULTS,
    INFO_FAULTS,
    coordinate,
)

from dcgs_ros.core import se3
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.keyframe import Keyframe
from dcgs_ros.datasets.source import BadFrame
from dcgs_ros.nodes.harness.observer import wait_until
from dcgs_ros.nodes.messages.images import (
    header,
    time_message,
    write_camera,
    write_color,
    write_depth_mm,
)
from dcgs_ros.nodes.messages.keyframes import TOPICS, write_keyframe
from dcgs_ros.nodes.messages.packet import KeyframePacket
from dcgs_ros.nodes.transport import RELIABLE

pytestmark = pytest.mark.slow

PARTS = {
    'color': IMAGE_FAULTS, 'depth': IMAGE_FAULTS, 'camera_info': INFO_FAULTS,
    'gaussians': CLOUD_FAULTS,
}  # fmt: skip

OPTICAL_WXYZ = np.array([0.5, -0.5, 0.5, -0.5])  # of the camera on the base, REP 103
WRONG_M = 0.08  # a pose farther from the truth than this is wrong; drift over seconds is a third
KNOWN_NS = 10_000_000  # how near a pose's stamp the truth is
HAND_M_PER_S, NOISE_M = 1.5, 0.03  # how far apart two poses may be
TRACKED = 0.9  # where the camera is looked for: it is found within a few frames
SOON_S = 300.0  # only a failure takes so long
GAP = 60  # frames
DROPPED, SWAPPED = 0.2, 0.3
FUZZED, FUZZED_KEYFRAMES = 6_000, 300  # images, which makes ten thousand messages
PAUSE_S = 0.001  # between broken messages
GROWTH_MB = 60.0
MAPPER_GROWTH_MB = 400.0  # of which a map of some keyframes has half
LINES, THROTTLE_S = 16, 5.0  # of the log: one in five seconds is meant, and a few
CLAIMED_BYTES = 2**31 - 1


def begin(robot: Robot, *others: str, **parameters: object) -> tuple[Popen[bytes], Camera]:
    """Start a tracker, and a camera that it listens to."""
    tracker = robot.tracker(node__resume=False, **parameters)
    camera = Camera(robot.observer)
    robot.wait_ready('tracker', *others)
    camera.connect(robot.source.camera)
    return tracker, camera


def log(robot: Robot, node: str = 'tracker') -> str:
    return next(robot.logs.glob(f'{node}-*.log')).read_text()


def texts(robot: Robot) -> list[str]:
    return [text for _, name, _, text in robot.observer.history if name == 'dcgs_tracker']


def verdict(robot: Robot) -> str:
    """Return what was said last while images came."""
    return next(text for text in reversed(texts(robot)) if 'no images' not in text)


def cameras(robot: Robot) -> dict[int, NDArray[np.float64]]:
    """T_world_cam of the poses that came, by stamp."""
    T_base_cam = se3.from_quaternion(OPTICAL_WXYZ, np.zeros(3))
    return {k: T @ T_base_cam for k, T in list(robot.observer.poses.items())}


def errors_m(robot: Robot) -> NDArray[np.float64]:
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
    wait_until(lambda: 'no images for' in texts(robot)[-1], SOON_S, 'silence is noticed')
    reports = len(texts(robot))
    camera.play(after)
    camera.settle()
    came = sum(s.stamp_ns in robot.observer.poses for s in after)
    assert came > TRACKED * len(after) or any(
        'move back to where it was tracked' in text for text in texts(robot)[reports:]
    )
    no_wrong_jump(robot)
    # The camera goes back.
    robot.observer.poses.clear()
    camera.play(before)
    camera.settle()
    assert len(robot.observer.poses) > TRACKED * len(before)
    assert tracker.poll() is None


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
    camera.settle()
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
    camera.settle()
    assert tracker.poll() is None
    assert robot.observer.value('dcgs_tracker', 'disorder') > 0
    assert len(robot.observer.poses) > (1 - SWAPPED) * TRACKED * len(taken)
    no_wrong_jump(robot)


def test_when_the_clock_jumps_back_the_camera_is_found_in_the_map(robot: Robot) -> None:
    _, camera = begin(robot)
    taken = shots(robot.source, 60)
    camera.play(taken)
    camera.settle()
    first = dict(robot.observer.poses)
    robot.observer.poses.clear()
    camera.play(taken)
    camera.settle()
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
    camera.settle()
    assert tracker.poll() is None
    assert log(robot).count('the camera changed from') >= 1  # what repeats soon is not said again
    assert len(robot.observer.poses) > TRACKED * len(taken)
    assert verdict(robot).startswith(('tracking', 'degenerate'))
    no_wrong_jump(robot)


def in_depths_frame(robot: Robot, count: int) -> list[Shot]:
    taken: list[Shot] = shots(robot.source, count)
    for shot in taken:
        shot.messages['depth'].header.frame_id = 'camera_depth_optical_frame'
    return taken


def test_registered_depth_in_the_depth_cameras_frame_is_tracked_and_told(robot: Robot) -> None:
    tracker, camera = begin(robot)
    taken = in_depths_frame(robot, 31)  # the last may wait for a nearer partner
    camera.play(taken)
    camera.settle()
    assert {shot.stamp_ns for shot in taken[:30]} <= robot.observer.poses.keys()
    assert log(robot).count('registration of depth: as recorded, as its name says, though in') == 1
    assert tracker.poll() is None


def test_depth_that_nothing_registers_is_refused_with_the_reason(robot: Robot) -> None:
    tracker, camera = begin(robot, node__depth_registration='extrinsics')
    camera.play(in_depths_frame(robot, 12))
    camera.settle()
    assert not robot.observer.poses
    assert any('could be used: /camera' in text for text in texts(robot))
    assert "is in frame 'camera_depth_optical_frame'" in log(robot)
    assert 'depth is not registered to colour, and no extrinsics' in log(robot)
    assert tracker.poll() is None


def test_intrinsics_that_drift_keep_the_map(robot: Robot) -> None:
    """A camera that focuses: other intrinsics with every frame, and images that follow them."""
    tracker, camera = begin(robot)
    source = robot.source
    frames = [f for f in islice(source, 60) if not isinstance(f, BadFrame)]
    taken = [
        zoomed(frame, source.camera, 1.0 + 0.03 * k / len(frames))
        for k, frame in enumerate(frames)
    ]
    camera.play(taken)
    camera.settle()
    assert len(robot.observer.poses) == len(taken)
    assert 'the camera changed' not in log(robot) and 'a new map' not in log(robot)
    no_wrong_jump(robot)
    assert tracker.poll() is None


def test_depth_in_another_unit_is_tracked_in_metres_once_it_is_told(robot: Robot) -> None:
    _, camera = begin(robot, node__depth_per_metre=1000.0)
    frames = islice(robot.source, 24)
    camera.play(
        shot_of(replace(f, depth_m=1000 * f.depth_m), robot.source.camera)
        for f in frames
        if isinstance(f, RgbdFrame)
    )
    camera.settle()
    assert len(robot.observer.poses) == 24
    no_wrong_jump(robot)


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


def fuzz_camera(robot: Robot, camera: Camera, count: int, first_ns: int) -> None:
    """Send frames of which at least one message is broken, until `count` images have come."""
    rng, before, k = random.Random(3), received(robot), 0
    good = {
        'color': (write_color(COLOR, header(1, '')), IMAGE_FAULTS),
        'depth': (write_depth_mm(DEPTH, header(1, '')), IMAGE_FAULTS),
        'camera_info': (write_camera(CAMERA, header(1, '')), INFO_FAULTS),
    }
    while received(robot) < before + count:
        name = rng.choice(list(good))
        message, faults = good[name]
        message = broken(deepcopy(message), faults, rng)
        camera.publishers[name].publish(placed(message, first_ns + k // 3 * 33_000_000, rng))
        time.sleep(PAUSE_S)
        k += 1
    camera.take_stock()


def received(robot: Robot) -> float:
    """Count the images that the tracker has had."""
    return robot.observer.value('dcgs_tracker', 'color') + robot.observer.value(
        'dcgs_tracker', 'depth'
    )


def cut_short(camera: Camera) -> None:
    """Send bytes that are no message: an image's data end early, and claim to be 2 GB."""
    whole = serialize_message(write_color(COLOR, header(1, 'camera')))
    at = whole.index(len(COLOR.tobytes()).to_bytes(4, 'little'))
    claims = whole[:at] + CLAIMED_BYTES.to_bytes(4, 'little') + whole[at + 4 :][:99]
    for data in (claims, whole[: at + 99], whole[:20]):
        camera.publishers['color'].publish(data)
        camera.next_report()


def test_ten_thousand_broken_messages_do_not_stop_the_tracker(robot: Robot) -> None:
    tracker, camera = begin(robot)
    taken = shots(robot.source, 90)
    camera.play(taken[:45])
    camera.settle()
    first_ns = taken[44].stamp_ns
    fuzz_camera(robot, camera, FUZZED // 10, first_ns)  # loads what is loaded once
    before_mb, lines, start_s = rss_mb(tracker), len(log(robot).splitlines()), time.monotonic()
    fuzz_camera(robot, camera, FUZZED, first_ns + 10**12)
    assert tracker.poll() is None
    assert rss_mb(tracker) - before_mb < GROWTH_MB
    passed_s = time.monotonic() - start_s
    assert len(log(robot).splitlines()) - lines < LINES + passed_s / THROTTLE_S
    robot.observer.poses.clear()
    camera.play(taken[45:])
    camera.settle()
    assert len(robot.observer.poses) > TRACKED * 45
    assert verdict(robot).startswith(('tracking', 'degenerate'))


def test_bytes_that_are_no_message_do_not_stop_the_tracker(robot: Robot) -> None:
    tracker, camera = begin(robot)
    before_mb = rss_mb(tracker)
    cut_short(camera)
    camera.take_stock()
    assert tracker.poll() is None, log(robot)
    assert rss_mb(tracker) - before_mb < GROWTH_MB
    taken = shots(robot.source, 30)
    camera.play(taken)
    camera.settle()
    assert len(robot.observer.poses) > TRACKED * len(taken)


def fuzz_keyframes(robot: Robot, count: int) -> None:
    """Send keyframes of which at least one message is broken."""
    rng, node = random.Random(4), robot.observer.node
    publishers = {
        name: node.create_publisher(kind, f'keyframe/{name}', RELIABLE)
        for name, kind in TOPICS.items()
    }
    wait_until(
        lambda: all(p.get_subscription_count() for p in publishers.values()), SOON_S, 'a mapper'
    )
    means = np.random.default_rng(4).normal(0, 1, (40, 3)).astype(np.float32)
    for k in range(count):
        frame = RgbdFrame(k + 1, k + 1, COLOR, DEPTH)
        keyframe = Keyframe(frame, np.eye(4), np.eye(4), np.arange(40), means, means)
        messages = write_keyframe(KeyframePacket(1, CAMERA, keyframe, 'camera'), 'odom')
        name = rng.choice(list(messages))
        if name == 'reference':
            messages[name].poses = [PoseStamped()]
            coordinate(messages[name].poses[0].pose, rng)
        elif name.endswith('pose'):
            coordinate(messages[name].pose, rng)
        else:
            broken(messages[name], PARTS[name], rng)
        for part, message in messages.items():
            publishers[part].publish(message)
        time.sleep(PAUSE_S * len(messages))
    for publisher in publishers.values():
        node.destroy_publisher(publisher)


def test_broken_keyframes_do_not_stop_the_mapper(robot: Robot) -> None:
    mapper = robot.mapper()
    tracker, camera = begin(robot, 'mapper')
    observer = robot.observer
    taken = shots(robot.source, 90)
    camera.play(taken[:45])
    robot.wait(lambda: observer.value('dcgs_mapper', 'keyframes') > 0, 'keyframes')
    before_mb, lines = rss_mb(mapper), len(log(robot, 'mapper').splitlines())
    start_s = time.monotonic()
    fuzz_keyframes(robot, FUZZED_KEYFRAMES)
    assert mapper.poll() is None and tracker.poll() is None
    passed_s = time.monotonic() - start_s
    assert len(log(robot, 'mapper').splitlines()) - lines < LINES + passed_s / THROTTLE_S
    camera.play(taken[45:])
    robot.wait(lambda: observer.value('dcgs_tracker', 'keyframes_missing') == 0, 'given again')
    assert rss_mb(mapper) - before_mb < MAPPER_GROWTH_MB
    assert mapper.poll() is None and tracker.poll() is None


def asked(robot: Robot, kind: type, service: str, request: Any) -> Any:
    client = robot.observer.node.create_client(kind, service)
    assert client.wait_for_service(SOON_S)
    future = client.call_async(request)
    wait_until(future.done, SOON_S, service)
    return future.result()


def set_parameter(robot: Robot, node: str, name: str, value: Any) -> Any:
    request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
    return asked(robot, SetParameters, f'/{node}/set_parameters', request).results[0]


def test_parameters_of_live_nodes_change_or_say_why_not(robot: Robot) -> None:
    robot.mapper()
    _, camera = begin(robot, 'mapper')
    for node, live in (('dcgs_tracker', 'registration.radius_m'), ('dcgs_mapper', 'rates.mean_m')):
        answer = set_parameter(robot, node, live, 0.05)
        assert answer.successful, answer.reason
        answer = set_parameter(robot, node, live, -1.0)
        assert not answer.successful and live in answer.reason
        answer = set_parameter(robot, node, live, 'much')
        assert not answer.successful and answer.reason
        answer = set_parameter(robot, node, 'node.map_frame', 'elsewhere')
        assert not answer.successful and 'read-only' in answer.reason
        request = DescribeParameters.Request(names=[live, 'node.map_frame'])
        described = asked(robot, DescribeParameters, f'/{node}/describe_parameters', request)
        for descriptor in described.descriptors:
            assert len(descriptor.description) > 10
        assert [d.read_only for d in described.descriptors] == [False, True]
        assert described.descriptors[0].floating_point_range
    taken = shots(robot.source, 30)
    camera.play(taken)
    camera.settle()
    assert len(robot.observer.poses) > TRACKED * len(taken)
