# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A correction goes from the tracker's back end to the mapper's map, over DDS."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip('rclpy')

from geometry_msgs.msg import Point, Pose, TransformStamped
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import PointCloud2

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.keyframe import Correction, Keyframe
from dcgs_ros.core.tracking.result import TrackingState
from dcgs_ros.datasets.synthetic.source import SyntheticSource
from dcgs_ros.nodes import mapper, tracker
from dcgs_ros.nodes.mapper import MapperNode
from dcgs_ros.nodes.messages.clouds import MAP_GAUSSIAN, read_cloud
from dcgs_ros.nodes.messages.ids import first_epoch
from dcgs_ros.nodes.messages.odometry import CameraToBase
from dcgs_ros.nodes.messages.packet import KeyframePacket
from dcgs_ros.nodes.messages.poses import matrix
from dcgs_ros.nodes.tracker import TrackerNode
from dcgs_ros.nodes.tracking import back_end, back_end_worker
from dcgs_ros.nodes.tracking.back_end_worker import BackEndWorker
from dcgs_ros.nodes.tracking.keyframe_publisher import KeyframePublisher
from dcgs_ros.nodes.transport import latched

HANGS_S = 60.0  # only a failure takes so long
PATIENCE_S = 600.0  # likewise, with much to be done
FRAMES = 12
SOURCE = SyntheticSource.from_address(f'synthetic:room?frames={FRAMES}&sensor=ideal')
CAMERA = PinholeCamera(
    SOURCE.camera.width // 2, SOURCE.camera.height // 2,
    SOURCE.camera.fx / 2, SOURCE.camera.fy / 2, SOURCE.camera.cx / 2, SOURCE.camera.cy / 2,
)  # fmt: skip
EAGER = {
    'keyframes.min_interval_s': 0.0, 'keyframes.translation_m': 1e-6,
    'mapping.view_interval': 1,
}  # fmt: skip
BEND = np.array([0.02, 0.01, 0.0, 0.0, 0.01, 0.0])  # a keyframe, of what the correction moves
AT = 5  # keyframes that the back end corrects
# A robot that turns on the spot: it sees one half of a room, after a jump the other half, which
# begins a sub-map, and then the first again.
TURNING = 'synthetic:room?motion=turning&frames=500&sensor=ideal&speed=0.35'
FIRST, OTHER, AGAIN = range(86, 207), range(350, 493), range(80, 192)
STEP_NS = 33_333_333
CONTINUOUS_M, CONTINUOUS_RAD = 0.03, 0.08  # from frame to frame; it turns with 1 rad/s
NEAR_M = 0.06  # of the truth, after a turn and a half; without the loop a kilometre


class Scripted:
    """Corrects the first keyframes once it has them, and is let."""

    def __init__(self, go: threading.Event) -> None:
        self.go = go
        self.places: Any = SimpleNamespace(recognise=lambda _: [])
        self.loops: list[object] = []
        self.keyframes: list[Keyframe] = []

    def restore(self, *_: Any) -> None:
        raise AssertionError('the map is a new one')

    def add(self, keyframe: Keyframe) -> None:
        self.keyframes.append(keyframe)

    def work(self) -> Correction | None:
        if self.loops or len(self.keyframes) < AT:
            return None
        assert self.go.wait(HANGS_S)
        self.loops.append(object())
        n = len(self.keyframes)
        stamps = np.array([keyframe.frame.stamp_ns for keyframe in self.keyframes], np.int64)
        bends = np.array([se3.exp(k * BEND) for k in range(n)])
        T = bends @ np.array([keyframe.T_world_cam for keyframe in self.keyframes])
        return Correction(1, stamps, T, np.zeros((n, 6, 6)), np.zeros(n, np.int32))


class Robot:
    """A tracker that is fed by hand, and mappers, in one process but over DDS."""

    def __init__(self, eye: Any, go: threading.Event) -> None:
        self.eye, self.executor, self._go = eye, SingleThreadedExecutor(), go
        self.executor.add_node(eye)
        self.mappers: list[Any] = []
        self.kept: list[Correction] = []  # what the sender of keyframes was told
        eye._sender.correct = self.kept.append
        self.packets: list[KeyframePacket] = []
        self.publisher = KeyframePublisher(eye, eye._outputs.world)
        self.frames = iter(SOURCE)
        self.stamp_ns = 10**9

    def correct(self, brain: Any) -> None:
        """Have the back end correct, and wait until a mapper has it."""
        self._go.set()
        self.spin(lambda: brain._session.mapper.revision == 1)

    def mapper(self) -> Any:
        brain = MapperNode()
        self.mappers.append(brain)
        self.executor.add_node(brain)
        self.spin(lambda: self.publisher.connected())
        return brain

    def track(self, count: int) -> None:
        """Track frames as the node does, and keep what the mapper should get."""
        session = self.eye._session
        for _ in range(count):
            frame = next(self.frames)
            small = SimpleNamespace(color=frame.color[::2, ::2], depth_m=frame.depth_m[::2, ::2])
            frame = type(frame)(
                frame.stamp_ns, frame.depth_stamp_ns, small.color.copy(), small.depth_m.copy()
            )
            result = session.track(frame, CAMERA)
            self.packets += session.packets(frame, result, 'optical')

    def send(self, packets: list[KeyframePacket], brain: Any) -> None:
        """Send them until a mapper has them all, as the sender does."""
        for packet in packets:
            self.publisher.send(packet)
            self.spin(lambda stamp=packet.stamp_ns: stamp in brain._session.stamps)  # type: ignore[misc]

    def drive(self, indices: Iterable[int], brain: Any) -> None:
        """Track frames of `TURNING` as the node does, and have the mapper take what it gets."""
        outputs, session = self.eye._outputs, self.eye._session
        source = SyntheticSource.from_address(TURNING)
        for index in indices:
            whole, self.stamp_ns = source.render(index), self.stamp_ns + STEP_NS
            color, depth_m = whole.color[::2, ::2].copy(), whole.depth_m[::2, ::2].copy()
            frame = RgbdFrame(self.stamp_ns, self.stamp_ns, color, depth_m)
            result = session.track(frame, CAMERA)
            if result.state is TrackingState.LOST:
                outputs.lose()
            else:
                outputs.publish(result, CameraToBase(np.eye(4)))
            packets = session.packets(frame, result, 'optical')
            self.packets += packets
            self.send(packets, brain)
            self.spin(lambda: session._loops.figures()['keyframes_unchecked'] == 0, PATIENCE_S)
            self.eye._camera.queue.take(0.0)

    def spin(self, condition: Callable[[], Any], patience_s: float = HANGS_S) -> None:
        end = time.monotonic() + patience_s
        while not condition():
            assert time.monotonic() < end
            self.executor.spin_once(timeout_sec=0.01)
            for brain in self.mappers:
                parts = brain._queue.take(0.0)
                if parts is not None:
                    brain._insert(parts)
                    brain._session.advance()
            self.eye._camera.queue.take(0.0)

    def poses(self) -> dict[int, NDArray[np.float64]]:
        """Return where the tracker has its keyframes, by their names."""
        visited, names = self.eye._session.tracker.visited, self.eye._session._names
        return {names[k]: T for k, T in enumerate(visited.poses) if k in names}


def poses_of(brain: Any) -> dict[int, NDArray[np.float64]]:
    return {view.stamp_ns: view.T_tracked for view in brain._session.mapper.views}


def assert_one_world(robot: Robot, brain: Any) -> None:
    """The mapper has keyframes where the tracker has them, and views beside theirs."""
    found, expected = poses_of(brain), robot.poses()
    for stamp, T in expected.items():
        np.testing.assert_allclose(found[stamp], T, atol=1e-9)
    for packet in robot.packets:
        reference = packet.posed.reference
        if reference is not None:
            beside = se3.inverse(reference.T_world_cam) @ packet.posed.T_world_cam
            T = expected[reference.stamp_ns] @ beside
            np.testing.assert_allclose(found[packet.stamp_ns], T, atol=1e-9)


@pytest.fixture
def home(ros: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[Robot]:
    """Return a robot whose back end finds loops, and gives way to nobody."""
    monkeypatch.setattr(back_end_worker, 'give_way', lambda: None)
    yield from running(monkeypatch, {'keyframes.new_submap_s': 0.3}, threading.Event())


@pytest.fixture
def robot(ros: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[Robot]:
    go = threading.Event()
    monkeypatch.setattr(
        tracker, 'make_loops',
        lambda config, take, warn: BackEndWorker(lambda *_: Scripted(go), take, warn),
    )  # fmt: skip
    yield from running(monkeypatch, EAGER, go)


def running(
    monkeypatch: pytest.MonkeyPatch, settings: Mapping[str, Any], go: threading.Event
) -> Iterator[Robot]:
    idle = SimpleNamespace(join=lambda: None, leave=lambda: None)
    for module in (tracker, mapper):
        monkeypatch.setattr(module, 'Worker', lambda node, work, name: idle)
    made = Robot(TrackerNode(), go)
    made.eye._session.config = override(Config(sensor=SOURCE.sensor), settings)
    yield made
    go.set()
    for node in (made.eye, *made.mappers):
        node._ready = False
        node.close()
        node.destroy_node()


def test_a_correction_moves_the_mappers_map_once_and_late_joiners_have_it_too(
    robot: Robot,
) -> None:
    brain, updates = robot.mapper(), list[PointCloud2]()
    robot.track(6)
    before = list(robot.packets)
    robot.send(before[:-1], brain)
    brain._outputs.update(brain._session.mapper)
    brain._outputs._updates = SimpleNamespace(publish=updates.append)
    received: list[PointCloud2] = []
    brain._outputs._received = SimpleNamespace(publish=received.append)
    robot.correct(brain)
    assert len(received) == 1 and not updates  # those have their rate
    assert [told.revision for told in robot.kept] == [1]

    # All Gaussians of moved keyframes are changed, and no other.
    views, table = brain._session.mapper.views, brain._session.mapper.table
    first = views[0].stamp_ns  # which the correction leaves where it was
    moved = np.array([view.reference_ns != first for view in views])[table.hosts]
    brain._outputs.update(brain._session.mapper)
    rows = read_cloud(updates[-1], MAP_GAUSSIAN)
    assert set(rows['id'].tolist()) == set(table.ids[moved].tolist()) != set(table.ids.tolist())

    robot.send(before[-1:], brain)  # which was on its way meanwhile
    assert_one_world(robot, brain)

    # What is tracked from now on is in the corrected world.
    robot.track(3)
    robot.send(robot.packets[len(before) :], brain)
    assert_one_world(robot, brain)
    assert len(robot.poses()) > AT

    # A mapper that starts late gets keyframes as they were kept, from before the correction.
    late = robot.mapper()
    robot.send(robot.packets, late)
    robot.spin(lambda: late._session.mapper.revision == 1)
    assert_one_world(robot, late)

    # So does one that is reset: the poses are still known.
    late._session.reset()
    robot.send(robot.packets, late)
    assert_one_world(robot, late)


@pytest.mark.slow
def test_a_loop_moves_the_map_and_map_to_odom_but_not_odom_to_base(home: Robot) -> None:
    brain, sent = home.mapper(), list[TransformStamped]()
    home.eye._outputs._transforms = SimpleNamespace(send=sent.append)
    home.drive((*FIRST, *OTHER), brain)
    session, mapping = home.eye._session, brain._session.mapper
    assert len(set(session.tracker.keyframe_submaps.tolist())) == 2 and not home.kept
    apart = mapping.table.splats.means[0].max()
    before, seen = len(sent), len(home.packets)
    home.drive(AGAIN[:-5], brain)
    home.spin(lambda: bool(home.kept) and mapping.revision >= 1, PATIENCE_S)
    home.drive(AGAIN[-5:], brain)
    assert not session.tracker.keyframe_submaps.any() and len(home.packets) > seen
    assert home.kept[-1].revision >= 1 and session._loops.figures()['loops'] > 0

    # The sub-map's Gaussians, a kilometre away, are in the room now.
    assert apart > 900.0 and np.abs(mapping.table.splats.means).max() < 10.0
    assert_one_world(home, brain)

    # odom moves as the robot does, and has another place in the map.
    odom = [matrix_of(one) for one in sent[before:] if one.child_frame_id == 'camera_link']
    steps = [se3.log(se3.inverse(a) @ b) for a, b in pairwise(odom)]
    assert max(np.linalg.norm(step[:3]) for step in steps) < CONTINUOUS_M
    assert max(np.linalg.norm(step[3:]) for step in steps) < CONTINUOUS_RAD
    places = [matrix_of(one) for one in sent if one.child_frame_id == 'odom']
    assert np.linalg.norm(se3.log(se3.inverse(places[0]) @ places[-1])) > 0.1

    # And it is where it is.
    source = SyntheticSource.from_address(TURNING)
    truth = source.groundtruth
    assert truth is not None
    first, last = (truth.T_world_cam[k] for k in (FIRST[0], AGAIN[-1]))
    off = se3.log(se3.inverse(session.tracker.T_world_cam) @ se3.inverse(first) @ last)
    assert np.linalg.norm(off[:3]) < NEAR_M


def matrix_of(message: TransformStamped) -> NDArray[np.float64]:
    where = message.transform
    t = where.translation
    return matrix(Pose(position=Point(x=t.x, y=t.y, z=t.z), orientation=where.rotation))


def test_an_answer_from_before_the_correction_turns_no_normals(robot: Robot) -> None:
    brain, answers = robot.mapper(), list[Any]()
    robot.track(6)
    robot.eye._mapper._pass_answer = lambda update, epoch: answers.append((update, epoch))
    robot.send(robot.packets[:-1], brain)
    robot.correct(brain)
    robot.send(robot.packets[-1:], brain)
    robot.spin(lambda: len(answers) == len(robot.packets))
    told = [(update, epoch) for update, epoch in answers if len(update.ids)]
    assert [update.revision for update, _ in told] == [0] * (len(told) - 1) + [1]
    session = robot.eye._session
    normals = session.tracker.gaussians.normals.copy()
    session.apply(*told[0])
    np.testing.assert_array_equal(session.tracker.gaussians.normals, normals)
    session.apply(*told[-1])
    assert (session.tracker.gaussians.normals != normals).any()


def test_a_rivals_poses_move_nothing(robot: Robot) -> None:
    brain = robot.mapper()
    robot.track(4)
    robot.send(robot.packets, brain)
    before = poses_of(brain)
    outputs = robot.eye._outputs
    named = robot.eye._session._named(robot.eye._session.tracker.corrected_poses)
    rival = robot.eye.create_publisher(PointCloud2, 'keyframe_poses', latched(1))
    from dcgs_ros.nodes.messages.corrections import write_correction

    moved = Correction(
        9, named.stamps_ns, named.T_world_cam + 1.0, named.covariances, named.submaps
    )
    rival.publish(write_correction(moved, first_epoch(), outputs.world))
    robot.spin(lambda: bool(brain._session._corrections))
    for stamp, T in poses_of(brain).items():
        np.testing.assert_array_equal(T, before[stamp])


def test_the_back_end_of_a_node_is_there_unless_it_is_not_wanted() -> None:
    config = override(Config(), {'backend.loops': False})
    assert back_end.make_loops(config, print, print).figures() == {}


@pytest.mark.parametrize('loops', [True, False])
def test_its_kernels_are_loaded_before_the_first_frame(
    loops: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded: list[bool] = []
    monkeypatch.setattr(back_end, 'warm_up', lambda *_: loaded.append(True))
    back_end.warm_up_loops(override(Config(), {'backend.loops': loops}))
    assert loaded == [True] * loops
