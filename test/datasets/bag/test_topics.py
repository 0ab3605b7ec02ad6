# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The topics of recordings by each camera driver, with all that `ros2 bag record -a` adds."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rosbags')

from bags import (  # type: ignore[import-not-found]
    CAMERA,
    START_NS,
    Entry,
    color_of,
    depth_of,
    image_entry,
    info_entry,
    write_bag,
)
from packing import rvl  # type: ignore[import-not-found]
from realsense_bags import compressed_entry, encoded  # type: ignore[import-not-found]

from dcgs_ros.cli.main import main
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.datasets.bag import topics as bag_topics
from dcgs_ros.datasets.bag.source import BagSource
from dcgs_ros.datasets.bag.topics import camera_topics
from dcgs_ros.datasets.source import SourceError

Bag = Callable[..., Path]


@pytest.fixture
def bag(tmp_path: Path) -> Bag:
    def write(entries: Iterable[Entry], name: str = 'bag') -> Path:
        return write_bag(tmp_path / name, entries)

    return write


def color(topic: str, encoding: str = 'rgb8') -> Entry:
    channels = {'mono8': 1, 'bgra8': 4}.get(encoding, 3)
    pixels = np.resize(color_of(0), (48, 64, channels))
    return image_entry(topic, START_NS, encoding, pixels[..., 0] if channels == 1 else pixels)


def depth(topic: str, encoding: str = '16UC1') -> Entry:
    pixels = depth_of(0)
    wide = (pixels / 1000).astype(np.float32) if encoding == '32FC1' else pixels
    return image_entry(topic, START_NS, encoding, wide)


def info(topic: str, fx: float = CAMERA.fx) -> Entry:
    return info_entry(START_NS, replace(CAMERA, fx=fx), topic)


def jpeg(topic: str) -> Entry:
    return compressed_entry(
        topic, START_NS, 'rgb8; jpeg compressed bgr8', encoded('.jpg', color_of(0))
    )


def depth_png(topic: str) -> Entry:
    data = bytes(12) + encoded('.png', depth_of(0))
    return compressed_entry(topic, START_NS, '16UC1; compressedDepth png', data)


def depth_rvl(topic: str) -> Entry:
    data = bytes(12) + rvl(depth_of(0))
    return compressed_entry(topic, START_NS, '16UC1; compressedDepth rvl', data)


def chosen(path: Path, **given: Any) -> tuple[str, str, str | None, str | None]:
    found = camera_topics(path, **given)
    return found.color, found.depth, found.camera_info, found.depth_info


def check_depth(path: Path) -> None:
    (frame,) = BagSource(path)
    assert isinstance(frame, RgbdFrame)
    np.testing.assert_array_equal(frame.depth_m, depth_of(0) / np.float32(1000))


def test_an_oak_calls_its_depth_stereo(bag: Bag, capsys: pytest.CaptureFixture[str]) -> None:
    names = ('rgb', 'stereo', 'left', 'right')
    entries = [
        color('/oak/rgb/image_raw', 'bgr8'),
        color('/oak/left/image_raw', 'mono8'),
        color('/oak/right/image_raw', 'mono8'),
        depth('/oak/stereo/image_raw'),
        *(info(f'/oak/{name}/camera_info') for name in names),
    ]
    path = bag(entries)
    infos = ('/oak/rgb/camera_info', '/oak/stereo/camera_info')
    pair = ('/oak/rgb/image_raw', '/oak/stereo/image_raw')
    assert chosen(path) == (*pair, *infos)
    assert chosen(path, color=pair[0]) == chosen(path, depth=pair[1]) == (*pair, *infos)
    check_depth(path)
    assert main(['info', str(path)]) == 0
    assert ', '.join(pair) in capsys.readouterr().out


@pytest.mark.parametrize('packed', [depth_png, depth_rvl])
def test_an_oak_over_the_network_is_compressed(bag: Bag, packed: Callable[[str], Entry]) -> None:
    entries = [
        jpeg('/oak/rgb/image_raw/compressed'),
        packed('/oak/stereo/image_raw/compressedDepth'),
        info('/oak/rgb/camera_info'),
        info('/oak/stereo/camera_info'),
    ]
    path = bag(entries)
    assert chosen(path)[:2] == (
        '/oak/rgb/image_raw/compressed', '/oak/stereo/image_raw/compressedDepth',
    )  # fmt: skip
    check_depth(path)


ZED = '/zed/zed_node'


def zed() -> list[Entry]:
    """All images of a ZED, raw and compressed."""
    eyes = ('rgb', 'left', 'right')
    rectified = [f'{ZED}/{eye}/image_rect_color' for eye in eyes]
    raw = [f'{ZED}/{eye}_raw/image_raw_color' for eye in eyes]
    return [
        *(color(topic, 'bgra8') for topic in raw + rectified),
        *(color(f'{ZED}/{eye}/image_rect_gray', 'mono8') for eye in eyes),
        color(f'{ZED}/stereo/image_rect_color', 'bgra8'),
        depth(f'{ZED}/confidence/confidence_map', '32FC1'),
        depth(f'{ZED}/depth/depth_registered', '32FC1'),
        *(jpeg(f'{topic}/compressed') for topic in raw + rectified),
        depth_png(f'{ZED}/depth/depth_registered/compressedDepth'),
        *(info(f'{ZED}/{eye}/camera_info') for eye in (*eyes, 'depth')),
        *(info(f'{ZED}/{eye}_raw/camera_info', fx=40.0) for eye in eyes),
    ]


def test_all_that_a_zed_sends_gives_its_rectified_left_image_and_its_depth(bag: Bag) -> None:
    path = bag(zed())
    pair = (f'{ZED}/rgb/image_rect_color', f'{ZED}/depth/depth_registered')
    assert chosen(path) == (*pair, f'{ZED}/rgb/camera_info', f'{ZED}/depth/camera_info')
    check_depth(path)
    left = f'{ZED}/left/image_rect_color'
    assert chosen(path, color=left)[:2] == (left, pair[1])
    small = f'{ZED}/rgb/image_rect_color/compressed'
    assert chosen(path, color=small)[:2] == (small, pair[1])


def test_without_raw_images_the_compressed_ones_of_a_zed_are_read(bag: Bag) -> None:
    raw = ('image_raw_color', 'image_rect_color', 'depth_registered', 'gray')
    path = bag([entry for entry in zed() if not entry.topic.endswith(raw)])
    assert chosen(path)[:2] == (
        f'{ZED}/rgb/image_rect_color/compressed',
        f'{ZED}/depth/depth_registered/compressedDepth',
    )
    check_depth(path)


def test_an_oak_beside_a_zed_is_another_camera(bag: Bag) -> None:
    oak = [color('/oak/rgb/image_raw'), depth('/oak/stereo/image_raw')]
    path = bag([*oak, *zed()])
    with pytest.raises(SourceError, match=r'among .*/oak/rgb.*/zed/zed_node/rgb'):
        camera_topics(path)
    assert camera_topics(path, color='/oak/rgb/image_raw').depth == '/oak/stereo/image_raw'
    zeds = camera_topics(path, depth=f'{ZED}/depth/depth_registered')
    assert zeds.color == f'{ZED}/rgb/image_rect_color'


def test_of_a_named_camera_depth_and_intrinsics_follow(bag: Bag) -> None:
    entries = [
        entry
        for k, side in enumerate(('front', 'rear', 'left'))
        for entry in (
            color(f'/{side}/color/image_raw'),
            depth(f'/{side}/depth/image_raw'),
            depth(f'/{side}/aligned_depth_to_color/image_raw'),
            info(f'/{side}/color/camera_info', fx=50.0 + k),
            info(f'/{side}/aligned_depth_to_color/camera_info', fx=50.0 + k),
        )
    ]
    path = bag(entries)
    with pytest.raises(SourceError, match=r'not one topic is the colour image among .*front'):
        BagSource(path)
    for k, side in enumerate(('front', 'rear', 'left')):
        source = BagSource(path, color_topic=f'/{side}/color/image_raw')
        assert source.recorded.topics.depth == f'/{side}/aligned_depth_to_color/image_raw'
        assert source.camera.fx == 50.0 + k


@pytest.mark.parametrize('size', ['hd', 'qhd', 'sd'])
def test_a_kinect2_is_read_in_the_resolution_that_was_recorded(bag: Bag, size: str) -> None:
    names = ('image_color_rect', 'image_depth_rect')
    entries = [
        color(f'/kinect2/{size}/{names[0]}', 'bgr8'),
        color(f'/kinect2/{size}/image_mono', 'mono8'),
        depth(f'/kinect2/{size}/{names[1]}'),
        info(f'/kinect2/{size}/camera_info'),
    ]
    path = bag(entries)
    topics = [f'/kinect2/{size}/{name}' for name in names]
    assert chosen(path) == (*topics, *[f'/kinect2/{size}/camera_info'] * 2)
    check_depth(path)


@pytest.mark.parametrize('transport', ['', '/compressed'])
def test_no_distortion_is_left_in_images_that_are_called_rectified(
    bag: Bag, transport: str
) -> None:
    """Their CameraInfo is that of the raw images: the lens in K and D, the images in P."""
    name = '/kinect2/qhd/image_color_rect'
    image = jpeg(name + transport) if transport else color(name)
    plain = PinholeCamera(64, 48, 44.0, 45.0, 30.5, 23.0)
    lens = info_entry(START_NS, CAMERA, '/kinect2/qhd/camera_info', projection=plain)
    path = bag([image, depth('/kinect2/qhd/image_depth_rect'), lens])
    assert BagSource(path).camera == plain
    check_depth(path)
    images = [color('/kinect2/qhd/image_color'), depth('/kinect2/qhd/image_depth')]
    assert BagSource(bag([*images, lens], 'raw')).camera == CAMERA


@pytest.mark.parametrize(
    ('topics', 'infos'),
    [
        (  # the transport beside camera_info, as image_transport's republish makes it
            ['/camera/color/compressed', '/camera/depth/compressedDepth'],
            ['/camera/color/camera_info', '/camera/depth/camera_info'],
        ),
        (
            ['/robot/camera/color/image_raw/compressed', '/robot/camera/depth/zstd/image_raw'],
            ['/robot/camera/color/camera_info', '/robot/camera/depth/camera_info'],
        ),
        (
            ['/compressed/camera/color/image_raw', '/compressed/camera/depth/image_raw'],
            ['/camera/color/camera_info', '/camera/depth/camera_info'],
        ),
        (
            ['/cam/color_image/compressed', '/cam/depth_image/compressedDepth'],
            ['/cam/color_info', '/cam/depth_info'],
        ),
    ],
)
def test_transports_may_stand_anywhere_in_the_name(
    bag: Bag, topics: list[str], infos: list[str]
) -> None:
    of_another = [info('/camera/camera_info', fx=40.0), info('/cam/info', fx=40.0)]
    path = bag([jpeg(topics[0]), depth_png(topics[1]), *map(info, infos), *of_another])
    assert chosen(path) == (*topics, *infos)
    check_depth(path)


def test_a_raw_image_is_preferred_to_a_compressed_one_of_another_name(bag: Bag) -> None:
    raw = ['/a/color/image', '/a/depth/image']
    small = [jpeg('/a/color/compressed'), depth_png('/a/depth/compressedDepth')]
    path = bag([color(raw[0]), depth(raw[1]), *small, info('/a/color/camera_info')])
    assert chosen(path)[:2] == (*raw,)


def test_intrinsics_of_another_camera_are_none(bag: Bag) -> None:
    images = [color('/front/rgb/image'), depth('/front/depth/image')]
    for other in ('/rear/rgb/camera_info', '/front/ir/camera_info', '/front_wide/rgb_info'):
        path = bag([*images, info(other)], other.replace('/', '_'))
        assert chosen(path)[2:] == (None, None)


def test_video_is_listed_as_not_read(bag: Bag, monkeypatch: pytest.MonkeyPatch) -> None:
    types = {
        '/cam/rgb/image_raw/theora': 'theora_image_transport/msg/Packet',
        '/cam/depth/image_raw': 'sensor_msgs/msg/Image',
    }
    monkeypatch.setattr(bag_topics, 'topic_types', lambda _: types)
    listed = r'colour image among .*/theora \(theora_image_transport/msg/Packet: not read\)'
    with pytest.raises(SourceError, match=listed):
        camera_topics('bag')
