# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Keyframes and answers as messages: exact, or refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip('rclpy')

from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Header

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.errors import DcgsError
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.keyframe import Keyframe, KeyframePose, MapUpdate, PosedFrame
from dcgs_ros.io.ros_images import MessageError, stamp_ns
from dcgs_ros.nodes.mapping.keyframe_subscriber import Joiner
from dcgs_ros.nodes.messages.clouds import KEYFRAME_GAUSSIAN, SHAPE, read_cloud, write_cloud
from dcgs_ros.nodes.messages.ids import EPOCH, EPOCHS, first_epoch, is_epoch, joined_ids
from dcgs_ros.nodes.messages.keyframes import (
    TOPICS,
    read_answer,
    read_keyframe,
    write_answer,
    write_keyframe,
)
from dcgs_ros.nodes.messages.packet import KeyframePacket

CAMERA = PinholeCamera(40, 30, 38.5, 38.25, 19.75, 14.5, (0.1, -0.2, 0.001, 0.002, 0.3))
STAMP = 1_700_000_000_123_456_789
POSE = 1e-12
EPOCH_NUMBERS = st.integers(1, EPOCHS - 1)
INDICES = st.lists(st.integers(0, EPOCH - 1), max_size=12, unique=True)
QUICK = settings(max_examples=50, deadline=None)


def packet_of(
    epoch: int = 5, indices: list[int] | None = None, grey: bool = False, seed: int = 0
) -> KeyframePacket:
    rng = np.random.default_rng(seed)
    ids = np.array(range(4) if indices is None else indices, np.int64)
    color = rng.integers(0, 256, (30, 40) if grey else (30, 40, 3), dtype=np.uint8)
    depth_m = rng.integers(0, 6000, (30, 40)).astype(np.float32) / np.float32(1000)
    normals = rng.normal(size=(len(ids), 3)).astype(np.float32)
    keyframe = Keyframe(
        RgbdFrame(STAMP, STAMP - 5_000_000, color, depth_m),
        se3.exp(rng.normal(size=6)), se3.exp(0.02 * rng.normal(size=6)),
        ids, rng.normal(size=(len(ids), 3)).astype(np.float32), normals,
    )  # fmt: skip
    return KeyframePacket(epoch, CAMERA, keyframe, 'optical')


def keyframe_of(packet: KeyframePacket) -> Keyframe:
    assert isinstance(packet.posed, Keyframe)
    return packet.posed


def sent(packet: KeyframePacket) -> dict[str, Any]:
    """Return the messages as they arrive."""
    messages = write_keyframe(packet, 'odom')
    return {
        name: deserialize_message(serialize_message(message), TOPICS[name])
        for name, message in messages.items()
    }


@QUICK
@given(EPOCH_NUMBERS, INDICES, st.booleans(), st.integers(0, 99))
def test_a_keyframe_arrives_as_it_was(
    epoch: int, indices: list[int], grey: bool, seed: int
) -> None:
    packet = packet_of(epoch, indices, grey, seed)
    found = read_keyframe(sent(packet))
    assert (found.camera, found.camera_frame) == (CAMERA, 'optical')
    assert_same_view(found.posed, packet.posed)
    assert found.epoch == (epoch if indices or is_epoch(epoch) else 0)
    if not indices:
        assert type(found.posed) is PosedFrame
        return
    one, other = keyframe_of(packet), keyframe_of(found)
    np.testing.assert_array_equal(other.ids, joined_ids(epoch, one.ids))
    np.testing.assert_array_equal(other.means, one.means)
    np.testing.assert_array_equal(other.normals, one.normals)
    assert other.means.dtype == other.normals.dtype == np.float32


def test_a_keyframe_tells_its_submap() -> None:
    packet = packet_of()
    there = replace(packet, posed=replace(keyframe_of(packet), submap=3))
    assert keyframe_of(read_keyframe(sent(there))).submap == 3
    rows = read_cloud(sent(there)['gaussians'], KEYFRAME_GAUSSIAN)
    for value in (-1, 4):
        rows['submap'][-1] = value
        parts = sent(there) | {'gaussians': write_cloud(rows, Header())}
        with pytest.raises(MessageError, match='in sub-maps'):
            read_keyframe(parts)


def assert_same_view(found: PosedFrame, sent: PosedFrame) -> None:
    assert found.frame.stamp_ns == STAMP
    np.testing.assert_array_equal(found.frame.color, sent.frame.color)
    np.testing.assert_array_equal(found.frame.depth_m, sent.frame.depth_m)
    np.testing.assert_allclose(found.T_world_cam, sent.T_world_cam, atol=POSE)
    np.testing.assert_allclose(found.T_cam_cam_at_depth, sent.T_cam_cam_at_depth, atol=POSE)


def test_a_view_between_keyframes_is_one_without_gaussians() -> None:
    packet = packet_of()
    view = PosedFrame(packet.posed.frame, packet.posed.T_world_cam, np.eye(4))
    parts = sent(replace(packet, posed=view))
    assert parts['gaussians'].width == 0
    found = read_keyframe(parts)
    assert found.epoch == 0 and not found.carries_gaussians
    assert type(found.posed) is PosedFrame
    assert_same_view(found.posed, view)
    told = replace(packet, posed=view, epoch=first_epoch())
    assert read_keyframe(sent(told)).epoch == told.epoch


@pytest.mark.parametrize('gaussians', [True, False])
def test_a_frame_tells_which_keyframe_it_goes_with_and_where_that_was(gaussians: bool) -> None:
    packet, T = packet_of(indices=[3] if gaussians else []), se3.exp(np.arange(6.0))
    posed = replace(packet.posed, reference=KeyframePose(STAMP - 7, T))
    found = read_keyframe(sent(replace(packet, posed=posed))).posed.reference
    assert found is not None and found.stamp_ns == STAMP - 7
    np.testing.assert_allclose(found.T_world_cam, T, atol=POSE)
    assert read_keyframe(sent(packet)).posed.reference is None


def test_an_answer_tells_the_correction_it_came_after() -> None:
    update = replace(update_of([1, 2], [], 5), revision=3)
    assert read_answer(write_answer(update, STAMP, 'odom'))[1].revision == 3


def test_all_parts_carry_one_stamp_and_the_frame_they_are_in() -> None:
    parts = sent(packet_of())
    assert parts.keys() == TOPICS.keys()
    for name, message in parts.items():
        assert stamp_ns(message.header.stamp) == STAMP
        seen = name in ('color', 'depth', 'camera_info')
        assert message.header.frame_id == ('optical' if seen else 'odom')
    joiner = Joiner(tuple(TOPICS))
    joined = [joiner.add(name, STAMP, parts[name]) for name in sorted(parts)]
    assert joined[:-1] == [None] * 6 and joined[-1] is not None
    assert read_keyframe(joined[-1]).epoch == 5


def test_others_can_read_where_gaussians_and_depth_are() -> None:
    """Means and viewpoints in the world; `depth_pose` is where the camera was at the depth."""
    packet = packet_of()
    keyframe, parts = keyframe_of(packet), sent(packet)
    rows = read_cloud(parts['gaussians'], KEYFRAME_GAUSSIAN)
    for k, axis in enumerate('xyz'):
        np.testing.assert_array_equal(rows[axis], keyframe.means[:, k])
        viewpoint = np.float32(keyframe.T_world_cam[k, 3])
        np.testing.assert_array_equal(rows[f'viewpoint_{axis}'], viewpoint)
    position = parts['depth_pose'].pose.position
    expected = (keyframe.T_world_cam @ keyframe.T_cam_cam_at_depth)[:3, 3]
    np.testing.assert_allclose([position.x, position.y, position.z], expected, atol=POSE)


def test_depth_is_rounded_to_the_millimetre_and_none_beyond_its_range() -> None:
    packet = packet_of()
    depth_m = np.full((30, 40), 1.2344, np.float32)
    depth_m[0, :6] = 0.0, np.nan, np.inf, -1.0, 65.535, 65.6
    frame = replace(keyframe_of(packet).frame, depth_m=depth_m)
    found = read_keyframe(sent(replace(packet, posed=replace(packet.posed, frame=frame))))
    expected = np.full((30, 40), 1234, np.float32) / np.float32(1000)
    expected[0, :6] = 0, 0, 0, 0, np.float32(65.535), 0
    np.testing.assert_array_equal(keyframe_of(found).frame.depth_m, expected)


def with_ids(parts: dict[str, Any], ids: list[float]) -> dict[str, Any]:
    rows = np.zeros(len(ids), KEYFRAME_GAUSSIAN)
    rows['id'] = ids
    return parts | {'gaussians': write_cloud(rows, parts['gaussians'].header)}


E5 = 5.0 * EPOCH


@pytest.mark.parametrize(
    'ids',
    [[E5, E5 + EPOCH], [-1.0], [E5, -3.0], [0.0], [EPOCH - 1.0], [E5 + 0.5], [np.nan], [np.inf],
     [-np.inf], [2.0**53], [1e300], [E5, np.nan]],
)  # fmt: skip
def test_ids_that_are_not_of_one_map_are_refused(ids: list[float]) -> None:
    with pytest.raises(DcgsError):
        read_keyframe(with_ids(sent(packet_of()), ids))


def replaced(parts: dict[str, Any], name: str, field: str, value: Any) -> dict[str, Any]:
    setattr(parts[name], field, value)
    return parts


BROKEN: dict[str, Callable[[dict[str, Any]], object]] = {
    'colour of another size': lambda p: replaced(p, 'color', 'height', 20),
    'depth of another size': lambda p: replaced(p, 'depth', 'width', 20),
    'unknown encoding': lambda p: replaced(p, 'color', 'encoding', 'yuv9'),
    'colour for depth': lambda p: replaced(p, 'depth', 'encoding', 'rgb8'),
    'too little data': lambda p: replaced(p, 'color', 'data', p['color'].data[:-1]),
    'no depth at all': lambda p: replaced(p, 'depth', 'data', bytes(len(p['depth'].data))),
    'a lens that is none': lambda p: replaced(p, 'camera_info', 'distortion_model', 'fisheye'),
    'no focal length': lambda p: replaced(p, 'camera_info', 'k', np.zeros(9)),
    'gaussians without fields': lambda p: replaced(p, 'gaussians', 'fields', []),
    'gaussians without data': lambda p: replaced(p, 'gaussians', 'data', b''),
    'no orientation': lambda p: setattr(p['pose'].pose.orientation, 'w', np.nan),
    'no position': lambda p: setattr(p['depth_pose'].pose.position, 'z', np.inf),
}


@pytest.mark.parametrize('fault', BROKEN)
def test_what_cannot_be_a_keyframe_is_refused_in_words(fault: str) -> None:
    parts = sent(packet_of())
    BROKEN[fault](parts)
    with pytest.raises(DcgsError) as refused:
        read_keyframe(parts)
    assert str(refused.value)


# What the mapper answers.


def update_of(kept: list[int], removed: list[int], epoch: int, seed: int = 0) -> MapUpdate:
    rng = np.random.default_rng(seed)
    n = len(kept)
    return MapUpdate(
        joined_ids(epoch, np.array(kept, np.int64)), rng.normal(size=(n, 3)).astype(np.float32),
        rng.normal(size=(n, 3)).astype(np.float32), rng.random(n).astype(np.float32),
        joined_ids(epoch, np.array(removed, np.int64)),
    )  # fmt: skip


@QUICK
@given(EPOCH_NUMBERS, INDICES, st.integers(0, 12))
def test_an_answer_arrives_as_it_was_with_the_trackers_ids(
    epoch: int, indices: list[int], removed: int
) -> None:
    gone, kept = indices[:removed], indices[removed:]
    update = update_of(kept, gone, epoch)
    cloud = write_answer(update, STAMP, 'odom')
    found_epoch, found = read_answer(deserialize_message(serialize_message(cloud), type(cloud)))
    assert found_epoch == (epoch if indices else 0)
    np.testing.assert_array_equal(found.ids, kept)
    np.testing.assert_array_equal(found.removed, gone)
    np.testing.assert_array_equal(found.normals, update.normals)
    np.testing.assert_array_equal(found.flatness, update.flatness)
    assert stamp_ns(cloud.header.stamp) == STAMP and cloud.header.frame_id == 'odom'


@pytest.mark.parametrize(
    'ids', [[E5, E5 + EPOCH], [-1.0], [3.0], [E5 + 0.25], [np.nan], [np.inf], [1e300]]
)
def test_an_answer_of_no_map_is_refused(ids: list[float]) -> None:
    cloud = write_answer(update_of([1], [], 5), STAMP, 'odom')
    rows = np.zeros(len(ids), SHAPE)
    rows['id'] = ids
    with pytest.raises(DcgsError):
        read_answer(write_cloud(rows, cloud.header))
