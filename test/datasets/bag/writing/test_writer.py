# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Written recordings: what any reader reads from them is what was given."""

from __future__ import annotations

import json
import sqlite3
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from sources import (  # type: ignore[import-not-found]
    INTERVAL_NS,
    SENSOR,
    START_NS,
    MemorySource,
    frames_of,
    same_frames,
    samples_of,
    truth_of,
)

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.datasets.bag.source import BagSource
from dcgs_ros.datasets.bag.writing.encoding import EncodingError
from dcgs_ros.datasets.bag.writing.storage import STORAGES, BagOptions
from dcgs_ros.datasets.bag.writing.writer import write_bag
from dcgs_ros.io.whole_files import StagingError, staged_folder

pytest.importorskip('rosbags')

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

COLOR = '/camera/camera/color/image_raw'
DEPTH = '/camera/camera/aligned_depth_to_color/image_raw'
ROTATION = 1e-12  # of a matrix that was a quaternion in between
HALF_MM = 0.0005 + 1e-6  # metres
ALL_OPTIONS = [BagOptions(s, zstd=z) for s in STORAGES for z in (False, True)]


def written(folder: Path, source: MemorySource, options: BagOptions | None = None) -> list[str]:
    return write_bag(folder, source, iter(source.frames), options or BagOptions())


def messages_of(folder: Path) -> list[tuple[str, int, Any]]:
    with AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        return [
            (connection.topic, recorded_ns, reader.deserialize(cdr, connection.msgtype))
            for connection, recorded_ns, cdr in reader.messages()
        ]


def nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


@pytest.mark.parametrize('options', ALL_OPTIONS)
@pytest.mark.parametrize('per_metre', [1000.0, 5000.0])
def test_frames_come_back_bit_for_bit(
    tmp_path: Path, options: BagOptions, per_metre: float
) -> None:
    source = MemorySource(frames_of(5, per_metre))
    assert written(tmp_path / 'bag', source, options) == []
    back = BagSource(tmp_path / 'bag')
    assert same_frames(list(back), source.frames)  # type: ignore[arg-type]
    assert back.camera == source.camera
    assert back.sensor == SENSOR


@pytest.mark.parametrize('numbers', [(), (0.1, -0.2, 0.01, 0.02, 0.3, 0.4, -0.5, 0.6)])
def test_every_lens_comes_back(tmp_path: Path, numbers: tuple[float, ...]) -> None:
    camera = PinholeCamera(64, 48, 50.1, 51.2, 31.3, 23.4, numbers)
    written(tmp_path / 'bag', MemorySource(frames_of(1, 1000.0), camera))
    assert BagSource(tmp_path / 'bag').camera == camera


def test_depth_is_sent_in_millimetres_where_they_tell_all(tmp_path: Path) -> None:
    for per_metre, encoding in ((1000.0, '16UC1'), (5000.0, '32FC1')):
        folder = tmp_path / encoding
        written(folder, MemorySource(frames_of(1, per_metre, grey=True)))
        encodings = {t: m.encoding for t, _, m in messages_of(folder) if t in (COLOR, DEPTH)}
        assert encodings == {COLOR: 'mono8', DEPTH: encoding}


def test_compressed_depth_is_whole_millimetres_and_color_a_jpeg(tmp_path: Path) -> None:
    source = MemorySource(frames_of(3, 5000.0))
    lost = written(tmp_path / 'bag', source, BagOptions(compress=True))
    assert lost == ['depth of 3 frames was rounded to 1 mm']
    images = {topic: m for topic, _, m in messages_of(tmp_path / 'bag')}
    frame = source.frames[-1]
    color, depth = images[f'{COLOR}/compressed'], images[f'{DEPTH}/compressedDepth']
    assert (color.format, depth.format) == (
        'rgb8; jpeg compressed bgr8',
        '16UC1; compressedDepth png',
    )
    assert bytes(depth.data[:12]) == bytes(12)
    raw = cv2.imdecode(depth.data[12:], cv2.IMREAD_UNCHANGED)
    assert raw is not None and raw.dtype == np.uint16
    assert np.abs(raw / 1000 - frame.depth_m).max() <= HALF_MM
    parameters = [cv2.IMWRITE_JPEG_QUALITY, 95]
    jpeg = cv2.imencode('.jpg', cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR), parameters)[1]
    assert bytes(color.data) == jpeg.tobytes()


def test_a_compressed_recording_is_read_as_a_sequence(tmp_path: Path) -> None:
    source = MemorySource(frames_of(3, 1000.0))
    assert written(tmp_path / 'bag', source, BagOptions(compress=True)) == []
    for frame, back in zip(source.frames, BagSource(tmp_path / 'bag'), strict=True):
        assert isinstance(back, RgbdFrame)
        assert back.stamp_ns == frame.stamp_ns
        np.testing.assert_array_equal(back.depth_m, frame.depth_m)


@pytest.mark.parametrize('apart', [False, True])
def test_messages_are_in_the_order_of_their_stamps(tmp_path: Path, apart: bool) -> None:
    samples = samples_of(48, 5_000_000, apart)
    truth = truth_of(START_NS - 2_000_000_000, 6.0)
    source = MemorySource(frames_of(6, 5000.0), samples=samples, groundtruth=truth)
    written(tmp_path / 'bag', source)
    messages = messages_of(tmp_path / 'bag')
    recorded = [stamp_ns for _, stamp_ns, _ in messages]
    assert recorded == sorted(recorded)
    for topic, stamp_ns, message in messages[1:]:
        assert nanoseconds(message.header.stamp) == stamp_ns, topic
    imu = {'/camera/camera/accel/sample', '/camera/camera/gyro/sample'}
    assert {t for t, _, m in messages if 'Imu' in m.__msgtype__} == (
        imu if apart else {'/camera/camera/imu'}
    )
    assert tuple(BagSource(tmp_path / 'bag').imu()) == samples


def test_the_file_itself_is_in_the_order_of_the_stamps(tmp_path: Path) -> None:
    source = MemorySource(frames_of(8, 5000.0), samples=samples_of(60, 5_000_000, True))
    written(tmp_path / 'bag', source, BagOptions('sqlite3'))
    database = sqlite3.connect(tmp_path / 'bag' / 'bag.db3')
    stamps = [row[0] for row in database.execute('SELECT timestamp FROM messages ORDER BY id')]
    assert stamps == sorted(stamps)


def test_poses_come_back_and_only_those_beside_the_frames(tmp_path: Path) -> None:
    truth = truth_of(START_NS - 2_000_000_000, 6.0)
    source = MemorySource(frames_of(6, 5000.0), groundtruth=truth)
    written(tmp_path / 'bag', source)
    back = BagSource(tmp_path / 'bag').groundtruth
    assert back is not None
    first, last = back.stamps_ns[[0, -1]] - START_NS
    assert -200_000_000 < first < -90_000_000
    assert 90_000_000 < last - 5 * INTERVAL_NS < 200_000_000
    at = np.searchsorted(truth.stamps_ns, back.stamps_ns)
    np.testing.assert_array_equal(truth.stamps_ns[at], back.stamps_ns)
    np.testing.assert_allclose(truth.T_world_cam[at], back.T_world_cam, atol=ROTATION)


def test_the_camera_looks_along_its_link(tmp_path: Path) -> None:
    written(tmp_path / 'bag', MemorySource(frames_of(1, 1000.0)))
    topic, _, message = messages_of(tmp_path / 'bag')[0]
    assert topic == '/tf_static'
    (stamped,) = message.transforms
    frames = stamped.header.frame_id, stamped.child_frame_id
    assert frames == ('camera_link', 'camera_color_optical_frame')
    q = stamped.transform.rotation
    u = np.array([q.x, q.y, q.z])
    axis = np.array([0.0, 0.0, 1.0])  # optical z is the link's x
    turned = axis + 2 * np.cross(u, np.cross(u, axis) + q.w * axis)
    np.testing.assert_allclose(turned, [1, 0, 0], atol=ROTATION)


def test_metadata_holds_the_noise_and_what_playing_needs(tmp_path: Path) -> None:
    written(tmp_path / 'bag', MemorySource(frames_of(2, 1000.0)))
    text = (tmp_path / 'bag' / 'metadata.yaml').read_text()
    info = yaml.safe_load(text)['rosbag2_bagfile_information']
    assert (info['version'], info['storage_identifier']) == (9, 'mcap')
    assert info['relative_file_paths'] == ['bag.mcap']
    assert json.loads(info['custom_data']['dcgs_ros.sensor']) == asdict(SENSOR)
    for topic in info['topics_with_message_count']:
        (qos,) = topic['topic_metadata']['offered_qos_profiles']
        latched = topic['topic_metadata']['name'] == '/tf_static'
        assert qos['reliability'] == 'reliable'
        assert qos['durability'] == ('transient_local' if latched else 'volatile')


@pytest.mark.parametrize('zstd', [False, True])
def test_mcap_reads_what_was_written(tmp_path: Path, zstd: bool) -> None:
    reader = pytest.importorskip('mcap.reader')
    decoding = pytest.importorskip('mcap_ros2.decoder')
    source = MemorySource(frames_of(3, 1000.0))
    written(tmp_path / 'bag', source, BagOptions(zstd=zstd))
    with (tmp_path / 'bag' / 'bag.mcap').open('rb') as file:
        factory = decoding.DecoderFactory()
        made = reader.make_reader(file, validate_crcs=True, decoder_factories=[factory])
        images = [found[3] for found in made.iter_decoded_messages([COLOR])]
        depths = [found[3] for found in made.iter_decoded_messages([DEPTH])]
    for frame, color, depth in zip(source.frames, images, depths, strict=True):
        assert nanoseconds(color.header.stamp) == frame.stamp_ns
        assert nanoseconds(depth.header.stamp) == frame.depth_stamp_ns
        assert bytes(color.data) == frame.color.tobytes()
        raw = np.frombuffer(bytes(depth.data), '<u2').reshape(48, 64)
        np.testing.assert_array_equal(raw.astype(np.float32) / 1000, frame.depth_m)


@pytest.mark.parametrize('stamp_ns', [-1, 2**31 * 1_000_000_000])
def test_a_stamp_that_no_message_holds_is_refused(tmp_path: Path, stamp_ns: int) -> None:
    (frame,) = frames_of(1, 1000.0)
    source = MemorySource([replace(frame, stamp_ns=stamp_ns, depth_stamp_ns=stamp_ns)])
    with pytest.raises(EncodingError, match='seconds'):
        written(tmp_path / 'bag', source)


def test_a_staged_folder_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / 'there'
    with pytest.raises(StagingError, match='there: cannot be written'), staged_folder(target) as f:
        f.mkdir()
        (f / 'half').write_text('')
        raise OSError(28, 'No space left on device')
    assert list(tmp_path.iterdir()) == []
    with staged_folder(target) as f:
        f.mkdir()
        (f / 'all').write_text('')
        assert not target.exists()
    assert [path.name for path in tmp_path.rglob('*')] == ['there', 'all']
