# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The mapper's map as rows, and as its topics publish it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

pytest.importorskip('rclpy')

from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.nodes import MapperNodeSettings
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.kernels.workers import Workers
from dcgs_ros.core.mapping.mapper import Mapper
from dcgs_ros.core.mapping.rectification import Images
from dcgs_ros.core.mapping.splats import SH_C0, Splats
from dcgs_ros.core.mapping.views import KeyframeView
from dcgs_ros.core.render.cpu import CpuRenderer
from dcgs_ros.io.ros_images import MessageError, stamp_ns
from dcgs_ros.nodes.mapping import outputs as module
from dcgs_ros.nodes.mapping.outputs import MapOutputs
from dcgs_ros.nodes.messages.clouds import KEYFRAME_POSE, MAP_GAUSSIAN, read_cloud, unpack_rgb
from dcgs_ros.nodes.messages.ids import EPOCH
from dcgs_ros.nodes.messages.map_rows import keyframe_rows, map_rows
from dcgs_ros.nodes.messages.maps import UPDATES_KEPT, read_poses, read_stamps
from dcgs_ros.nodes.tracking.map_mirror import MapMirror

CAMERA = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
FLOAT32 = 1e-5  # relative
POSE = 1e-6
NOTHING = Images(np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64), np.uint16))


def view_of(index: int, stamp: int, seed: int = 0) -> KeyframeView:
    rng = np.random.default_rng((seed, index))
    tracked, refined = (se3.exp(rng.normal(size=6) * 0.3) for _ in range(2))
    view = KeyframeView.of(index, stamp, tracked, NOTHING, None)
    view.T_world_cam = refined
    return view


def mapper_with(ids: NDArray[np.int64], seed: int = 0, views: int = 3) -> Mapper:
    """Mapper with random Gaussians of these ids, in any order."""
    workers = Workers(1)
    mapper = Mapper(CAMERA, Config(), CpuRenderer(workers), workers)
    mapper.views = [view_of(k, 10**18 + 33_000_001 * k, seed) for k in range(views)]
    fill(mapper, ids, seed)
    return mapper


def fill(mapper: Mapper, ids: NDArray[np.int64], seed: int) -> None:
    rng, n = np.random.default_rng(seed), len(ids)
    planes = rng.normal(size=(14, n)).astype(np.float32)
    planes[3:6] -= 4
    for host in range(len(mapper.views)):
        mine = np.flatnonzero(np.arange(n) % len(mapper.views) == host)
        mapper.table.append(
            Splats(planes[:, mine]), ids[mine], host, planes[:3, mine] + np.float32(0.01),
            np.full(len(mine), np.inf, np.float32),
        )  # fmt: skip


def some_ids(count: int, seed: int = 1) -> NDArray[np.int64]:
    """Return ids of a tracker with the highest epoch and of the mapper, shuffled."""
    rng = np.random.default_rng(seed)
    tracked = ((1 << 20) - 1) * EPOCH + rng.permutation(count)
    return rng.permutation(np.concatenate([tracked, -1 - np.arange(count // 2)]))


def test_each_row_is_its_gaussian() -> None:
    mapper = mapper_with(some_ids(40))
    rows, table = map_rows(mapper), mapper.table
    assert (np.diff(rows['id']) > 0).all() and rows.dtype == MAP_GAUSSIAN
    column = {int(id): k for k, id in enumerate(table.ids)}
    assert {int(id) for id in rows['id']} == column.keys()
    for row in rows:
        planes = table.splats.planes[:, column[int(row['id'])]].astype(float)
        np.testing.assert_array_equal([row['x'], row['y'], row['z']], planes[:3].astype('f4'))
        scales = [row[f'scale_{k}'] for k in range(3)]
        np.testing.assert_allclose(scales, np.exp(planes[3:6]), rtol=FLOAT32)
        quat = np.array([row[f'rot_{k}'] for k in range(4)])
        np.testing.assert_allclose(quat, planes[6:10] / np.linalg.norm(planes[6:10]), rtol=1e-4)
        assert row['opacity'] == pytest.approx(1 / (1 + np.exp(-planes[10])), rel=FLOAT32)
        color = 255 * np.clip(0.5 + SH_C0 * planes[11:14], 0, 1)
        np.testing.assert_allclose(unpack_rgb(row['rgb'][None])[0], color, atol=0.51)
        assert row['keyframe'] == table.hosts[column[int(row['id'])]]


def test_the_tracking_covariance_is_the_sensors_as_the_host_saw_it() -> None:
    mapper = mapper_with(some_ids(40))
    rows, table, config = map_rows(mapper), mapper.table, mapper.config
    column = {int(id): k for k, id in enumerate(table.ids)}
    elements = ('xx', 'xy', 'xz', 'yy', 'yz', 'zz')
    for row in rows:
        found = np.array([row[f'track_cov_{name}'] for name in elements])
        if row['id'] < 0:
            assert np.isnan(found).all()
            continue
        host = mapper.views[row['keyframe']].T_tracked
        ray = table.measured[:, column[int(row['id'])]] - host[:3, 3]
        reach = np.linalg.norm(ray)
        along = np.outer(ray, ray) / reach**2
        sideways = (reach * config.registration.anchor_px / CAMERA.focal) ** 2
        depth = (config.sensor.a_m + config.sensor.b_per_m * reach**2) ** 2
        expected = sideways * (np.eye(3) - along) + depth * along
        np.testing.assert_allclose(
            found, expected[np.triu_indices(3)], rtol=1e-4, atol=FLOAT32 * float(depth)
        )


@pytest.mark.filterwarnings('error')
def test_an_empty_map_and_one_without_views_have_no_rows() -> None:
    empty = mapper_with(np.empty(0, np.int64), views=0)
    assert map_rows(empty).shape == (0,) and keyframe_rows(empty.views, empty.submaps).shape == (
        0,
    )


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('garbage', [np.nan, np.inf, -np.inf, 3e38, -3e38, 0.0])
def test_no_row_is_of_what_is_not_finite(garbage: float) -> None:
    """A Gaussian with unusable parameters has no row."""
    mapper = mapper_with(some_ids(60))
    for k in range(14):
        mapper.table.splats.planes[k, 2 * k] = garbage
    mapper.table.splats.planes[6:10, 40] = garbage
    with np.errstate(over='ignore', under='ignore'):
        rows = map_rows(mapper)
    assert len(rows) >= 90 - 15
    for name in MAP_GAUSSIAN.names or ():
        if not name.startswith('track_cov'):
            assert np.isfinite(rows[name]).all(), name
    lengths = sum(rows[f'rot_{k}'] ** 2 for k in range(4))
    np.testing.assert_allclose(lengths, 1, rtol=1e-4)


def test_keyframes_tell_stamps_to_the_nanosecond_and_refined_poses() -> None:
    stamps = [0, 999_999_999, 10**9, 1_700_000_000_123_456_789, (2**31 - 1) * 10**9 + 999_999_999]
    views = [view_of(k, stamp) for k, stamp in enumerate(stamps)]
    rows = keyframe_rows(views, range(5))
    assert read_stamps(rows) == stamps and rows['submap'].tolist() == [0, 1, 2, 3, 4]
    for view, T in zip(views, read_poses(rows), strict=True):
        np.testing.assert_allclose(T, view.T_world_cam, atol=POSE)
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert read_poses(rows[:0]) == [] and read_stamps(rows[:0]) == []


@pytest.mark.parametrize('names', ['x', 'qw', 'qx qy qz qw'])
@pytest.mark.parametrize('value', [np.nan, np.inf, 0.0])
def test_keyframes_without_a_pose_are_refused(names: str, value: float) -> None:
    rows = keyframe_rows([view_of(k, k) for k in range(3)], [0] * 3)
    for name in names.split():
        rows[name][1] = value
    if value == 0.0 and names != 'qx qy qz qw':
        assert len(read_poses(rows)) == 3
        return
    with pytest.raises(MessageError, match='1 of 3'):
        read_poses(rows)


# What is published.


class Topic:
    """A publisher that keeps what a late subscriber would still get, and more."""

    def __init__(self, name: str, depth: int) -> None:
        self.name, self.depth = name, depth
        self.messages: list[Any] = []

    def publish(self, message: Any) -> None:
        self.messages.append(deserialize_message(serialize_message(message), type(message)))

    def get_subscription_count(self) -> int:
        return 1


class FakeNode:
    def __init__(self) -> None:
        self.topics: dict[str, Topic] = {}

    def create_publisher(self, _: type, name: str, qos: Any) -> Topic:
        return self.topics.setdefault(name, Topic(name, qos.depth))


class Clock:
    """Monotonic time under the control of the test."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s


@pytest.fixture(scope='module')
def clock() -> Iterator[Clock]:
    with pytest.MonkeyPatch.context() as patch:
        clock = Clock()
        patch.setattr(module, 'time', clock)
        yield clock


def outputs_with(**values: Any) -> tuple[FakeNode, MapOutputs]:
    node = FakeNode()
    settings = replace(MapperNodeSettings(), **values)
    return node, MapOutputs(node, settings)  # type: ignore[arg-type]


def listener(node: FakeNode) -> MapMirror:
    """Return the mirror of a subscriber that starts now."""
    mirror = MapMirror()
    for name, take in (('gaussian_map_updates', mirror.update), ('gaussian_map', mirror.whole)):
        topic = node.topics[name]
        for cloud in topic.messages[-topic.depth :]:
            take(stamp_ns(cloud.header.stamp), read_cloud(cloud, MAP_GAUSSIAN))
    return mirror


def assert_same(rows: NDArray[Any] | None, expected: NDArray[Any]) -> None:
    assert rows is not None and len(rows) == len(expected)
    for name in MAP_GAUSSIAN.names or ():
        one, other = (np.ascontiguousarray(r[name]).view(np.uint8) for r in (rows, expected))
        np.testing.assert_array_equal(one, other, err_msg=name)


ACTIONS = st.lists(
    st.sampled_from(['step', 'prune', 'spawn', 'view', 'reset', 'nothing', 'poison']), max_size=12
)


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(ACTIONS, st.sampled_from([0.0, 0.1, 30.0]), st.floats(0.01, 30.0))
def test_a_subscriber_has_the_map_as_it_is_whenever_it_starts(
    clock: Clock, actions: list[str], map_rate_hz: float, pause_s: float
) -> None:
    """Exactly, even where the whole map is hardly ever published, and after a reset."""
    node, outputs = outputs_with(map_rate_hz=map_rate_hz)
    mapper: Mapper | None = mapper_with(some_ids(12))
    outputs.update(mapper)
    for k, action in enumerate(actions):
        clock.now_s += pause_s
        rng = np.random.default_rng(k)
        if action == 'reset' or mapper is None:
            mapper = None if mapper is not None else mapper_with(some_ids(9, k), k, 1 + k % 3)
        elif action == 'step':
            some = rng.random(len(mapper.table)) < 0.3
            mapper.table.splats.planes[:, some] += rng.normal(size=(14, some.sum())).astype('f4')
        elif action == 'prune':
            mapper.table.keep(rng.random(len(mapper.table)) < 0.7)
        elif action == 'spawn':
            fill(mapper, 7 * EPOCH + 100 * k + np.arange(5), k)
        elif action == 'view':
            mapper.views.append(view_of(len(mapper.views), 10**18 - k))
        elif action == 'poison' and len(mapper.table):
            mapper.table.splats.planes[k % 14, k % len(mapper.table)] = np.nan
        outputs.update(mapper)
        expected = np.zeros(0, MAP_GAUSSIAN) if mapper is None else map_rows(mapper)
        assert_same(listener(node).rows, expected)


def test_stamps_grow_and_are_those_of_the_newest_keyframe(clock: Clock) -> None:
    node, outputs = outputs_with()
    mapper = mapper_with(some_ids(5))
    for k in range(4):
        mapper.table.splats.planes[0] += 1
        if k == 2:
            mapper.views.append(view_of(3, 10**18 + 5 * 10**9))
        outputs.update(mapper)
    stamps = [stamp_ns(c.header.stamp) for c in node.topics['gaussian_map_updates'].messages]
    newest = 10**18 + 2 * 33_000_001
    assert stamps == [newest, newest + 1, 10**18 + 5 * 10**9, 10**18 + 5 * 10**9 + 1]


def test_what_did_not_change_is_not_published(clock: Clock) -> None:
    node, outputs = outputs_with(map_rate_hz=30.0)
    mapper = mapper_with(some_ids(5))
    for _ in range(5):
        clock.now_s += 10
        outputs.update(mapper)
    for name in ('gaussian_map', 'gaussian_map_updates'):
        assert len(node.topics[name].messages) == 1


def test_the_whole_map_comes_at_its_rate_and_before_updates_are_forgotten(clock: Clock) -> None:
    for rate_hz, pause_s, expected in ((0.5, 1.0, 50), (0.0, 1.0, 4), (0.001, 1.0, 4)):
        node, outputs = outputs_with(map_rate_hz=rate_hz)
        mapper = mapper_with(some_ids(2))
        for _ in range(100):
            clock.now_s += pause_s
            mapper.table.splats.planes[0] += 1
            outputs.update(mapper)
        wholes = node.topics['gaussian_map'].messages
        assert len(node.topics['gaussian_map_updates'].messages) == 100
        assert abs(len(wholes) - expected) <= 1
        assert node.topics['gaussian_map_updates'].depth == UPDATES_KEPT


def test_updates_come_at_their_rate_or_not_at_all(clock: Clock) -> None:
    for rate_hz, expected in ((1.0, 20), (0.0, 0)):
        node, outputs = outputs_with(update_rate_hz=rate_hz)
        mapper = mapper_with(some_ids(2))
        for _ in range(200):
            clock.now_s += 0.1
            mapper.table.splats.planes[0] += 1
            outputs.update_when_due(mapper)
        outputs.update_when_due(None)
        found = len(node.topics['gaussian_map_updates'].messages)
        assert abs(found - expected) <= 1


def test_the_list_of_keyframes_is_whole_each_time(clock: Clock) -> None:
    node, outputs = outputs_with()
    mapper = mapper_with(some_ids(3))
    outputs.keyframes(None)
    outputs.keyframes(mapper)
    first, second = (
        read_stamps(read_cloud(cloud, KEYFRAME_POSE))
        for cloud in node.topics['keyframe/received'].messages
    )
    assert first == [] and second == [view.stamp_ns for view in mapper.views]


def test_fields_are_those_that_rviz_and_pcl_know(clock: Clock) -> None:
    node, outputs = outputs_with()
    outputs.update(mapper_with(some_ids(3)))
    cloud: PointCloud2 = node.topics['gaussian_map'].messages[0]
    names = [field.name for field in cloud.fields]
    assert names[:5] == ['id', 'x', 'y', 'z', 'rgb']
    assert {'opacity', 'scale_2', 'rot_3', 'track_cov_zz', 'keyframe'} <= set(names)
    assert cloud.header.frame_id == 'map' and cloud.height == 1
