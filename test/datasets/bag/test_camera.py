# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The camera of a recording: its topics, registration of depth, noise, IMU."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

pytest.importorskip('rosbags')

from bags import (  # type: ignore[import-not-found]
    CAMERA,
    COLOR,
    DEPTH,
    INFO,
    INTERVAL_NS,
    START_NS,
    Entry,
    color_of,
    depth_entry,
    depth_of,
    image_entry,
    info_entry,
    recording,
    write_bag,
    write_ros1,
)
from realsense_bags import (  # type: ignore[import-not-found]
    DEPTH_CAMERA,
    DEPTH_INFO,
    DEPTH_OPTICAL,
    T_COLORCAM_DEPTHCAM,
    VIEWER_COLOR,
    VIEWER_DEPTH,
    compressed,
    extrinsics_entry,
    imu_entry,
    pose_entry,
    static_entry,
    unaligned,
    viewer,
)

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.sensor import SensorNoise
from dcgs_ros.datasets.bag import camera as bag_camera
from dcgs_ros.datasets.bag.source import BagSource
from dcgs_ros.datasets.bag.topics import camera_topics
from dcgs_ros.datasets.camera_presets import PRESETS
from dcgs_ros.datasets.images.depth_registration import register_depth
from dcgs_ros.datasets.source import ImuSample, SourceError

EXACT = 1e-12  # of transforms, metres
MOVED_M = 1e-5  # depth by float32's rounding of a transform
EDGE = 0.01  # of the pixels, which the same rounding moves across an edge
T_ROOT = se3.exp(np.array([0.1, 0.2, -0.3, 0.5, -0.7, 1.1]))  # any frame above the cameras

Bag = Callable[..., Path]


@pytest.fixture
def bag(tmp_path: Path) -> Bag:
    def write(entries: Iterable[Entry], name: str = 'bag') -> Path:
        return write_bag(tmp_path / name, entries)

    return write


def depths_of(source: BagSource) -> list[NDArray[np.float32]]:
    frames = [item for item in source if isinstance(item, RgbdFrame)]
    assert len(frames) == len(source) > 0
    return [frame.depth_m for frame in frames]


def registered(k: int, per_metre: float = 1000.0) -> NDArray[np.float32]:
    depth_m = depth_of(k).astype(np.float32) / np.float32(per_metre)
    return register_depth(depth_m, DEPTH_CAMERA, T_COLORCAM_DEPTHCAM, CAMERA)


def without(entries: Iterable[Entry], *topics: str) -> list[Entry]:
    return [entry for entry in entries if entry.topic not in topics]


def test_topics_of_another_camera_are_found_by_type_and_name(bag: Bag) -> None:
    color, depth = '/front/rgb/image', '/front/depth_registered/image'
    entries = list(recording(2, color, depth))
    infrared = image_entry('/front/infra1/image', START_NS, 'mono8', color_of(0)[..., 0])
    raw = depth_entry(START_NS, depth_of(0), '/front/depth/image')
    path = bag([infrared, raw, *entries])
    assert camera_topics(path).color == color
    assert camera_topics(path).depth == depth
    assert camera_topics(path).camera_info == '/front/rgb/camera_info'
    assert camera_topics(path).depth_info is None
    assert len(BagSource(path)) == 2


def test_the_realsense_is_preferred_to_other_cameras(bag: Bag) -> None:
    other = recording(2, '/other/color/image_raw', '/other/aligned_depth_to_color/image_raw')
    topics = camera_topics(bag([*other, *recording(2)]))
    assert (topics.color, topics.depth, topics.camera_info) == (COLOR, DEPTH, INFO)


def test_aligned_depth_is_preferred_to_the_sensors(bag: Bag) -> None:
    source = BagSource(bag([*recording(2), *unaligned(2)]))
    for k, depth_m in enumerate(depths_of(source)):
        np.testing.assert_array_equal(depth_m, depth_of(k) / np.float32(1000))


def test_raw_images_are_preferred_to_compressed_ones(bag: Bag) -> None:
    both = camera_topics(bag([*compressed(1), *recording(1)]))
    assert (both.color, both.depth) == (COLOR, DEPTH)
    entries = [*compressed(1), info_entry(START_NS, CAMERA)]
    small = camera_topics(bag(entries, 'compressed'))
    assert (small.color, small.depth) == (f'{COLOR}/compressed', f'{DEPTH}/compressedDepth')
    assert small.camera_info == INFO
    both = camera_topics(bag([*compressed(1), *recording(1)], 'given'), f'{COLOR}/compressed')
    assert (both.color, both.depth) == (f'{COLOR}/compressed', DEPTH)


def test_where_topics_are_missing_or_many_they_are_listed(bag: Bag) -> None:
    no_depth = without(recording(1), DEPTH)
    with pytest.raises(SourceError, match=rf'the depth image among {COLOR} \(sensor_msgs/'):
        BagSource(bag(no_depth, 'no_depth'))
    cameras = [
        entry
        for side in ('left', 'right')
        for entry in recording(1, f'/{side}/color/image', f'/{side}/depth/image')
    ]
    two = bag(cameras, 'two')
    listed = r'colour image among .*/left/color.*/right/color.*; name it: .*\?color=TOPIC'
    with pytest.raises(SourceError, match=listed):
        BagSource(two)
    for side in ('left', 'right'):  # the other topic follows
        named = camera_topics(two, f'/{side}/color/image')
        assert named == camera_topics(two, depth=f'/{side}/depth/image')
        assert named.depth == f'/{side}/depth/image'
    with pytest.raises(SourceError, match=r'depth is not there.*the depth image .*\?depth=TOPIC'):
        BagSource(two, color_topic='/left/color/image', depth_topic='/up/depth')
    with pytest.raises(SourceError, match='/up/color is not there, so no topic is the colour'):
        BagSource(two, color_topic='/up/color', depth_topic='/left/depth/image')
    given = BagSource(two, color_topic='/right/color/image', depth_topic='/right/depth/image')
    assert len(depths_of(given)) == 1


def test_unaligned_depth_is_registered_with_the_extrinsics(bag: Bag) -> None:
    entries = [*without(recording(3), DEPTH), *unaligned(3), extrinsics_entry(T_COLORCAM_DEPTHCAM)]
    source = BagSource(bag(entries))
    assert source.camera == CAMERA
    assert source.sensor == SensorNoise.realsense(DEPTH_CAMERA.focal)
    for k, depth_m in enumerate(depths_of(source)):
        difference = np.abs(depth_m - registered(k)) > MOVED_M
        assert difference.mean() < EDGE


def test_unaligned_depth_is_registered_through_the_tree_of_frames(bag: Bag) -> None:
    T_link_color = se3.exp(np.array([0.0, 0.05, 0.0, 1.0, -1.0, 1.0]))
    T_link_depth = T_link_color @ T_COLORCAM_DEPTHCAM
    T_color_optical = se3.exp(np.array([0, 0, 0, -0.5, 0.5, -0.5]))
    tree = [
        ('base', 'camera_link', T_ROOT),
        ('camera_link', DEPTH_OPTICAL, T_link_depth),
        ('camera_link', 'color_frame', T_link_color @ se3.inverse(T_color_optical)),
        ('/color_frame', '/camera_color_optical_frame', T_color_optical),
    ]
    images = [*without(recording(2), DEPTH), *unaligned(2)]
    source = BagSource(bag([static_entry(tree[:1]), static_entry(tree[1:]), *images]))
    for k, depth_m in enumerate(depths_of(source)):
        assert (np.abs(depth_m - registered(k)) > MOVED_M).mean() < EDGE


def test_unaligned_depth_without_what_registers_it_is_refused(bag: Bag) -> None:
    images = [*without(recording(1), DEPTH), *unaligned(1)]
    flag = r"'camera_depth_optical_frame'.*not registered.*no extrinsics.*align_depth.enable:=true"
    with pytest.raises(SourceError, match=flag):
        BagSource(bag(images))
    apart = static_entry([('base', DEPTH_OPTICAL, T_ROOT)])
    with pytest.raises(SourceError, match=flag):
        BagSource(bag([*images, apart], 'apart'))
    no_info = without([*images, extrinsics_entry(T_COLORCAM_DEPTHCAM)], DEPTH_INFO)
    with pytest.raises(SourceError, match='no CameraInfo to do it is known'):
        BagSource(bag(no_info, 'no_info'))


@pytest.mark.parametrize('scale', [0.0, np.nan, 1.1, -1.0])
def test_extrinsics_that_are_no_transform_are_refused(bag: Bag, scale: float) -> None:
    T = T_COLORCAM_DEPTHCAM.copy()
    T[:3, :3] *= scale
    images = [*without(recording(1), DEPTH), *unaligned(1)]
    with pytest.raises(SourceError, match=r'extrinsics .* are no transform'):
        BagSource(bag([*images, extrinsics_entry(T)]))


def test_depth_of_another_size_in_colors_frame_is_registered(bag: Bag) -> None:
    half = PinholeCamera(32, 24, CAMERA.fx / 2, CAMERA.fy / 2, 15.5, 11.5)
    depth, info = '/phone/depth/image', '/phone/depth/camera_info'
    entries = without(recording(1, '/phone/color/image', depth), depth)
    coarse = np.full((24, 32), 2000, np.uint16)
    entries += [depth_entry(START_NS, coarse, depth), info_entry(START_NS, half, info)]
    (depth_m,) = depths_of(BagSource(bag(entries)))
    assert depth_m.shape == (48, 64)
    np.testing.assert_allclose(depth_m[4:-4, 4:-4], 2.0, atol=MOVED_M)


@pytest.mark.parametrize('ros1', [False, True])
def test_what_realsense_viewer_recorded_is_read(bag: Bag, tmp_path: Path, ros1: bool) -> None:
    entries = list(viewer(3, CAMERA, T_ROOT))
    path = write_ros1(tmp_path / 'viewer.bag', entries) if ros1 else bag(entries)
    topics = camera_topics(path)
    assert topics.color == f'{VIEWER_COLOR}/image/data'
    assert topics.depth_info == f'{VIEWER_DEPTH}/info/camera_info'
    source = BagSource(path)
    assert source.camera == CAMERA
    for k, depth_m in enumerate(depths_of(source)):
        assert (np.abs(depth_m - registered(k)) > MOVED_M).mean() < EDGE


def test_the_viewers_depth_unit_is_taken(bag: Bag) -> None:
    source = BagSource(bag(viewer(1, CAMERA, T_ROOT, units_m=0.0001)))
    (depth_m,) = depths_of(source)
    assert (np.abs(depth_m - registered(0, 10000.0)) > MOVED_M).mean() < EDGE
    with pytest.raises(SourceError, match=r'Depth_Units/value is 0\.0 metres'):
        BagSource(bag(viewer(1, CAMERA, T_ROOT, units_m=0.0), 'zero'))
    no_extrinsics = without(viewer(1, CAMERA, T_ROOT), f'{VIEWER_DEPTH}/tf/0')
    with pytest.raises(SourceError, match='no extrinsics'):
        BagSource(bag(no_extrinsics, 'no_extrinsics'))


def test_only_registered_raw_images_are_as_published(bag: Bag) -> None:
    assert bag_camera.find_camera(bag(recording(1))).as_published
    entries = [*compressed(1), info_entry(START_NS, CAMERA)]
    assert not bag_camera.find_camera(bag(entries, 'compressed')).as_published
    assert not bag_camera.find_camera(bag(viewer(1, CAMERA, T_ROOT), 'viewer')).as_published


def test_the_noise_is_the_presets_or_the_modes(bag: Bag) -> None:
    path = bag(recording(1))
    assert BagSource(path).sensor == PRESETS['d435i'].sensor
    assert BagSource(path, 'fr1').sensor == PRESETS['fr1'].sensor
    for width, height in ((848, 480), (1280, 720)):
        pixels = np.zeros((height, width, 3), np.uint8)
        wide = [
            info_entry(START_NS, PinholeCamera(width, height, 600.0, 600.0, 400.0, 240.0)),
            image_entry(COLOR, START_NS, 'rgb8', pixels),
            depth_entry(START_NS, np.ones((height, width), np.uint16)),
        ]
        assert BagSource(bag(wide, str(width))).sensor == PRESETS[f'd435i_{width}'].sensor


def test_the_noise_noted_in_the_metadata_comes_first(tmp_path: Path) -> None:
    noise = SensorNoise(0.1 + 0.2, 1 / 3, 0.4, 7.7)
    path = write_bag(tmp_path / 'bag', recording(1))
    metadata = path / 'metadata.yaml'
    content = yaml.safe_load(metadata.read_text())
    custom = {bag_camera.SENSOR_KEY: json.dumps(asdict(noise))}
    content['rosbag2_bagfile_information']['custom_data'] = custom
    metadata.write_text(yaml.safe_dump(content))
    assert BagSource(path).sensor == BagSource(path, 'fr1').sensor == noise


@pytest.mark.parametrize(
    'text',
    [
        '',
        '[]',
        '{"a_m": 1}',
        '[' * 100_000,
        '{"a_m": 1, "b_per_m": 0, "depth_min_m": 3, "depth_max_m": 2}',
        '{"a_m": null, "b_per_m": 0, "depth_min_m": 1, "depth_max_m": 2}',
        '{"a_m": 1, "b_per_m": NaN, "depth_min_m": 1, "depth_max_m": 2}',
        '{"a_m": 1, "b_per_m": 0, "depth_min_m": 1, "depth_max_m": 1e999}',
    ],
)
def test_recorded_noise_that_is_none_is_refused(
    bag: Bag, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    monkeypatch.setattr(bag_camera, 'custom_data', lambda _: {bag_camera.SENSOR_KEY: text})
    with pytest.raises(SourceError, match=r'dcgs_ros\.sensor'):
        BagSource(bag(recording(1)))


def test_inertial_samples_come_in_order_of_their_stamps(bag: Bag) -> None:
    accel, gyro = '/camera/camera/accel/sample', '/camera/camera/gyro/sample'
    up, turn, none = (0.1, 9.8, 0.2), (0.01, 0.02, 0.03), (0.0, 0.0, 0.0)
    entries = [imu_entry(accel, START_NS + k * 4_000_000, up, none) for k in range(5)]
    entries += [imu_entry(gyro, START_NS + k * 2_500_000, none, turn) for k in range(8)]
    samples = list(BagSource(bag([*recording(1), *entries])).imu())
    stamps = [sample.stamp_ns for sample in samples]
    assert len(samples) == 13 and stamps == sorted(stamps)
    assert {(s.acceleration, s.angular_velocity) for s in samples} == {(up, None), (None, turn)}
    assert {sample.frame for sample in samples} == {'camera_imu_optical_frame'}


def test_an_inertial_quantity_declared_missing_is(bag: Bag) -> None:
    up, turn = (0.1, 9.8, 0.2), (0.01, 0.02, 0.03)
    cases = {'': (up, turn), 'acceleration': (None, turn), 'rate': (up, None)}
    entries = [
        imu_entry('/imu', START_NS + k, up, turn, missing) for k, missing in enumerate(cases)
    ]
    source = BagSource(bag([*recording(1), *entries]))
    frame = 'camera_imu_optical_frame'
    expected = [ImuSample(START_NS + k, frame, *both) for k, both in enumerate(cases.values())]
    assert list(source.imu()) == list(source.imu()) == expected
    assert not list(BagSource(bag(recording(1), 'without')).imu())


def test_recorded_poses_are_the_ground_truth(bag: Bag) -> None:
    T = [se3.exp(0.1 * k * np.arange(1, 7)) for k in range(4)]
    poses = [pose_entry(START_NS + k * INTERVAL_NS, T[k]) for k in (0, 2, 1, 1, 3)]
    early = pose_entry(START_NS + 7, np.eye(4))
    source = BagSource(bag([*recording(2), *poses, early]))
    truth = source.groundtruth
    assert truth is not None
    expected = [T[0], np.eye(4), T[1], T[2], T[3]]
    assert len(truth) == len(expected)
    np.testing.assert_allclose(truth.T_world_cam, expected, atol=EXACT)


def test_a_pose_that_is_none_is_lost_and_told(bag: Bag) -> None:
    far = np.eye(4)
    far[0, 3] = np.inf
    poses = [pose_entry(START_NS, np.eye(4)), pose_entry(START_NS + 1, far)]
    source = BagSource(bag([*recording(2), *poses]))
    assert source.groundtruth is not None and len(source.groundtruth) == 1
    *frames, lost = source
    assert len(frames) == 2 and len(source) == 3
    assert '/groundtruth' in lost.name and 'is no transform' in lost.reason  # type: ignore[union-attr]


def test_extrinsics_stand_beside_the_depth_they_are_of(bag: Bag) -> None:
    images = [*without(recording(1), DEPTH), *unaligned(1)]
    other = extrinsics_entry(T_COLORCAM_DEPTHCAM, '/other/extrinsics/depth_to_color')
    with pytest.raises(SourceError, match='no extrinsics'):
        BagSource(bag([*images, other]))


@pytest.mark.slow
def test_any_damaged_message_leaves_frames_or_one_error(bag: Bag) -> None:
    rng = np.random.default_rng(3)
    entries = [
        *without(recording(2), DEPTH),
        *unaligned(2),
        extrinsics_entry(T_COLORCAM_DEPTHCAM),
        pose_entry(START_NS, np.eye(4)),
        imu_entry('/imu', START_NS, (0.0, 0.0, 1.0), (0.0, 0.0, 1.0)),
    ]
    for k, entry in enumerate(entries):
        for attempt in range(2):
            hostile = bytearray(entry.cdr)
            hostile[rng.integers(4, min(200, len(hostile)))] = rng.integers(256)
            if attempt:
                hostile = hostile[: rng.integers(len(hostile))]
            mutated = [*entries[:k], entry._replace(cdr=bytes(hostile)), *entries[k + 1 :]]
            try:
                source = BagSource(bag(mutated, f'{k}_{attempt}'))
                assert len(list(source)) == len(source)
                assert len(list(source.imu())) <= 1
            except SourceError:
                pass
