# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The replay node as a process of its own: over DDS comes what was recorded, when it is due."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')
pytest.importorskip('rosbags')

from bags import (  # type: ignore[import-not-found]
    COLOR,
    DEPTH,
    INFO,
    MCAP,
    SQLITE,
    Entry,
    depth_of,
    recording,
    write_bag,
)
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from realsense_bags import compressed  # type: ignore[import-not-found]
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image

from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.datasets.bag.messages import read_header
from dcgs_ros.datasets.open import open_source
from dcgs_ros.io.ros_images import read_camera, read_color, read_depth, stamp_ns
from dcgs_ros.nodes.messages.images import header
from dcgs_ros.nodes.playback.sources import open_playback

ENDS_S = 120.0  # only a failure takes so long
FRAMES = 12
DDS_ALIGNMENT = 4  # bytes, to which it fills a message up
INTERVAL_S = 0.03  # of tum_folder's stamps
LONG_S = 60.0  # between two frames of a recording that nobody has the time to wait for
PART_S = 2.0  # of a real sequence
ROUNDING_S = 0.05  # of what the node says
CAMERA = '50,50,31.5,23.5'  # of small images
TYPES: dict[str, type] = {COLOR: Image, DEPTH: Image, INFO: CameraInfo, '/clock': Clock}
PROGRAM = 'import sys; from dcgs_ros.nodes.start import replay; sys.exit(replay())'

pytestmark = pytest.mark.usefixtures('ros')


class Ear:
    """Keeps what comes on the camera's topics, as bytes or as messages."""

    def __init__(self, raw: bool) -> None:
        self.heard: dict[str, list[Any]] = {topic: [] for topic in TYPES}
        self.out = ''  # of the node
        self.node = Node('ear')
        for topic, type_ in TYPES.items():
            self.node.create_subscription(
                type_, topic, partial(self._hear, topic), QoSProfile(depth=1000), raw=raw
            )

    def _hear(self, topic: str, message: Any) -> None:
        self.heard[topic].append(message)

    @property
    def seconds(self) -> float:
        """How long the playback took, as the node says."""
        said = re.search(r'frames in ([0-9.]+) s', self.out)
        assert said is not None, self.out
        return float(said[1])


@contextmanager
def listening(raw: bool = False) -> Iterator[Ear]:
    """Spin in the background."""
    ear, executor = Ear(raw), SingleThreadedExecutor()
    executor.add_node(ear.node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    try:
        yield ear
    finally:
        executor.shutdown()
        thread.join()
        ear.node.destroy_node()


@contextmanager
def replay(source: Path | str, **parameters: object) -> Iterator[subprocess.Popen[str]]:
    """Start to play as soon as this process listens."""
    values = {'source': source, 'wait_for_subscribers': 1, **parameters}
    arguments = [part for name in values for part in ('-p', f'{name}:={values[name]}')]
    process = subprocess.Popen(
        [sys.executable, '-c', PROGRAM, '--ros-args', *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def played(
    source: Path | str, frames: int, raw: bool = False, rate: float = 0.0, **parameters: object
) -> Ear:
    """Play to the end, by default as fast as it is heard, and wait for so many frames."""
    with listening(raw) as ear, replay(source, rate=rate, **parameters) as process:
        ear.out, _ = process.communicate(timeout=ENDS_S)
        assert process.returncode == 0, ear.out
        # What is acknowledged is still to be taken by the executor.
        until(lambda: min(len(ear.heard[topic]) for topic in (COLOR, DEPTH, INFO)) >= frames)
    return ear


def stamps(messages: list[Any]) -> list[int]:
    return [stamp_ns(message.header.stamp) for message in messages]


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + ENDS_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.slow
def test_every_frame_arrives_as_it_is(tum_folder: Callable[..., Path]) -> None:
    folder = tum_folder('fr1_small', frames=FRAMES, size=(640, 480))  # as fr1's camera wants it
    source = open_source(str(folder))
    frames = [frame for frame in source if isinstance(frame, RgbdFrame)]
    ear = played(folder, FRAMES)
    colors, depths, infos = (ear.heard[topic] for topic in (COLOR, DEPTH, INFO))
    assert stamps(colors) == stamps(infos) == [frame.stamp_ns for frame in frames]
    assert stamps(depths) == [frame.depth_stamp_ns for frame in frames]
    for frame, color, depth, info in zip(frames, colors, depths, infos, strict=True):
        np.testing.assert_array_equal(read_color(color), frame.color)
        np.testing.assert_array_equal(read_depth(depth), frame.depth_m)
        assert (color.encoding, depth.encoding) == ('rgb8', '16UC1')
        assert read_camera(info) == source.camera
        for message in (color, depth, info):
            assert message.header.frame_id == 'camera_color_optical_frame'
    clock = [stamp_ns(message.clock) for message in ear.heard['/clock']]
    assert clock[0] == frames[0].depth_stamp_ns  # the later of the two
    assert clock[-1] == frames[-1].depth_stamp_ns
    assert (np.diff(clock) >= 0).all()


@pytest.mark.slow
@pytest.mark.parametrize('plugin', [MCAP, SQLITE], ids=['mcap', 'sqlite3'])
def test_a_bag_is_replayed_byte_for_byte(tmp_path: Path, plugin: int) -> None:
    entries: list[Entry] = list(recording(FRAMES))
    ear = played(write_bag(tmp_path / 'bag', entries, plugin), FRAMES, raw=True)
    for topic in (COLOR, DEPTH, INFO):
        recorded = [entry.cdr for entry in entries if entry.topic == topic]
        assert ear.heard[topic] == [cdr + bytes(-len(cdr) % DDS_ALIGNMENT) for cdr in recorded]


@pytest.mark.slow
def test_a_bag_of_another_camera_comes_on_the_usual_topics(tmp_path: Path) -> None:
    entries = list(recording(FRAMES, '/front/rgb/image', '/front/depth/image'))
    ear = played(write_bag(tmp_path / 'bag', entries), FRAMES, raw=True)
    expected = [entry.cdr for entry in entries if entry.topic == '/front/rgb/image']
    assert ear.heard[COLOR] == expected


@pytest.mark.slow
def test_start_duration_and_rate(tum_folder: Callable[..., Path]) -> None:
    folder = tum_folder('small', frames=25, interval_s=LONG_S)
    frames = open_source(str(folder), CAMERA)
    all_ns = [frame.stamp_ns for frame in frames if isinstance(frame, RgbdFrame)]
    ear = played(
        folder, 10, camera=CAMERA, start_s=5 * LONG_S, duration_s=10 * LONG_S, rate=500.0,
        clock=False,
    )  # fmt: skip
    assert stamps(ear.heard[COLOR]) == all_ns[5:15]
    assert ear.seconds >= 9 * LONG_S / 500 - ROUNDING_S  # and not nine minutes
    assert not ear.heard['/clock']


@pytest.mark.slow
def test_at_its_own_rate_no_frame_comes_before_its_time(tum_folder: Callable[..., Path]) -> None:
    ear = played(tum_folder('small', frames=4, interval_s=0.5), 4, camera=CAMERA, rate=1.0)
    assert ear.seconds >= 1.5 - ROUNDING_S


@pytest.mark.slow
@pytest.mark.parametrize('continuous', [False, True])
@pytest.mark.parametrize(
    ('as_bag', 'number'), [(False, signal.SIGINT), (True, signal.SIGTERM)], ids=['tum', 'bag']
)
def test_a_loop_goes_on_until_it_is_told_to_end(
    tum_folder: Callable[..., Path], tmp_path: Path, continuous: bool, number: int, as_bag: bool
) -> None:
    source = tum_folder('small', frames=5)
    options: dict[str, object] = {'loop': True, 'rate': 0.0, 'continuous_stamps': continuous}
    if as_bag:
        source = write_bag(tmp_path / 'bag', recording(5))
    else:
        options['camera'] = CAMERA
    with listening(raw=as_bag) as ear, replay(source, **options) as process:
        until(lambda: len(ear.heard[COLOR]) >= 13)
        process.send_signal(number)
        out, _ = process.communicate(timeout=ENDS_S)
        assert process.returncode == 0, out
        assert 'Traceback' not in out
    heard = ear.heard[COLOR][:13]
    at = [read_header(message)[0] for message in heard] if as_bag else stamps(heard)
    if continuous:
        assert (np.diff(at) > 0).all()
        assert np.diff(at).max() < 2e9 * INTERVAL_S
    else:
        assert at == (at[:5] * 3)[:13]


@pytest.mark.slow
def test_as_fast_as_possible_loses_nothing(tum_folder: Callable[..., Path]) -> None:
    ear = played(tum_folder('fr1_small', frames=25, size=(640, 480), interval_s=LONG_S), 25)
    for topic in (COLOR, DEPTH, INFO):
        assert len(ear.heard[topic]) == 25


@pytest.mark.slow
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_it_ends_while_it_waits_for_subscribers(
    tum_folder: Callable[..., Path], number: int
) -> None:
    with replay(tum_folder('fr1_small'), wait_for_subscribers=2) as process:
        with listening() as ear:  # only one
            until(lambda: 'dcgs_replay' in ear.node.get_node_names())
            time.sleep(0.5)
            assert process.poll() is None
        process.send_signal(number)
        out, _ = process.communicate(timeout=ENDS_S)
        assert process.returncode == 0, out
        assert 'Traceback' not in out
        assert f'waiting for 2 subscribers of {INFO}, which has ' in out


@pytest.mark.slow
def test_what_cannot_be_played_is_told_in_one_line(tum_folder: Callable[..., Path]) -> None:
    with replay('/nowhere') as process:
        out, _ = process.communicate(timeout=ENDS_S)
    assert process.returncode == 2
    assert out.splitlines() == [
        '/nowhere: no such folder or file, and no address that begins with synthetic:'
    ]
    with replay(tum_folder('fr1_small'), wait_for_subscribers=0, start_s=100.0) as process:
        out, _ = process.communicate(timeout=ENDS_S)
    assert process.returncode == 1
    assert 'nothing to replay: no frame from 100 s on' in out


@pytest.mark.slow
def test_a_real_sequence_arrives_whole(data_dir: Path) -> None:
    folder = data_dir / 'tum_fr3_teddy_200'
    frames = [frame for frame in open_source(str(folder)) if isinstance(frame, RgbdFrame)]
    due_ns = [max(frame.stamp_ns, frame.depth_stamp_ns) for frame in frames]
    sent = frames[: np.searchsorted(due_ns, due_ns[0] + round(1e9 * PART_S))]
    ear = played(folder, len(sent), duration_s=PART_S)
    assert len(ear.heard[COLOR]) == len(ear.heard[DEPTH]) == len(sent)
    for k in (0, len(sent) // 2, len(sent) - 1):
        np.testing.assert_array_equal(read_color(ear.heard[COLOR][k]), sent[k].color)
        np.testing.assert_array_equal(read_depth(ear.heard[DEPTH][k]), sent[k].depth_m)


def test_depth_is_sent_in_millimetres_only_where_they_tell_all(
    tum_folder: Callable[..., Path],
) -> None:
    playback = open_playback(str(tum_folder('fr1_small')), None, 'link', 'optical', lambda _: None)
    whole = np.full((480, 640), 1.234, np.float32)
    finer, farther = whole.copy(), whole.copy()
    finer[3, 5], farther[3, 5] = 1.2342, 65.536
    color = np.zeros((480, 640), np.uint8)
    for depth_m, encoding in ((whole, '16UC1'), (finer, '32FC1'), (farther, '32FC1')):
        messages = dict(playback.messages(RgbdFrame(10, 20, color, depth_m), shift_ns=5))
        assert messages['depth'].encoding == encoding
        assert messages['color'].encoding == 'mono8'
        assert messages['depth'].header == header(25, 'optical')
        assert messages['color'].header == messages['camera_info'].header == header(15, 'optical')
        np.testing.assert_array_equal(read_depth(messages['depth']), depth_m)


def test_frames_that_cannot_be_read_are_told_and_left_out(tum_folder: Callable[..., Path]) -> None:
    folder = tum_folder('small', frames=3)
    said: list[str] = []
    (folder / 'depth' / '1.png').write_bytes(b'no image')
    playback = open_playback(str(folder), CAMERA, 'link', 'optical', said.append)
    assert len(list(playback.items())) == 2
    assert len(said) == 1 and 'frame 2 of 3' in said[0]


def test_a_synthetic_scene_may_have_options() -> None:
    playback = open_playback('synthetic:plane?frames=2', None, 'link', 'optical', lambda _: None)
    items = [item for _, item in playback.items()]
    assert sum(isinstance(item, RgbdFrame) for item in items) == 2


def test_a_bag_for_which_a_camera_is_given_is_converted(tmp_path: Path) -> None:
    path = str(write_bag(tmp_path / 'bag', recording(2)))
    raw = open_playback(path, None, 'link', 'optical', lambda _: None)
    assert raw.camera_frame == 'camera_color_optical_frame'
    converted = open_playback(path, '60,61,32,24', 'link', 'optical', lambda _: None)
    assert converted.camera_frame == raw.camera_frame  # that of the images
    (_, frame), _ = converted.items()
    assert read_camera(dict(converted.messages(frame, 0))['camera_info']).fy == 61


def test_a_bag_in_another_unit_or_without_stamps_is_converted(tmp_path: Path) -> None:
    path = write_bag(tmp_path / 'bag', list(recording(4))[:-1])  # the last colour is missing
    said: list[str] = []
    converted = open_playback(
        f'{path}?depth_per_metre=4000&rate_hz=10', None, 'link', 'optical', said.append
    )
    items = list(converted.items())
    assert [stamp_ns for stamp_ns, _ in items] == [0, 10**8, 2 * 10**8]
    depth = read_depth(dict(converted.messages(items[0][1], 0))['depth'])
    np.testing.assert_array_equal(depth, depth_of(0) / np.float32(4000))
    assert '3 colour and 4 depth images' in said[0]


def test_a_bag_of_compressed_images_is_converted(tmp_path: Path) -> None:
    entries = [entry for entry in recording(2) if entry.topic == INFO]
    path = str(write_bag(tmp_path / 'bag', [*entries, *compressed(2)]))
    playback = open_playback(path, None, 'link', 'optical', lambda _: None)
    assert playback.camera_frame == 'camera_color_optical_frame'
    for (_, frame), expected in zip(playback.items(), open_source(path), strict=True):
        assert isinstance(expected, RgbdFrame)
        messages = dict(playback.messages(frame, 0))
        np.testing.assert_array_equal(read_color(messages['color']), expected.color)
        np.testing.assert_array_equal(read_depth(messages['depth']), expected.depth_m)
