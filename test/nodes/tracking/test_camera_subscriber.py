# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Images of a camera by any transport and in any encoding are what the raw ones would be."""

from __future__ import annotations

import time
from typing import Any, get_args, get_type_hints

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip('rclpy')

import rclpy
from packing import pack, rvl, zstd  # type: ignore[import-not-found]
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.nodes import TrackerNodeSettings
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.io.images import rvl as rvl_module
from dcgs_ros.io.images.encodings import COLOR_ENCODINGS
from dcgs_ros.io.images.transports import COLOR_TRANSPORTS, DEPTH_TRANSPORTS
from dcgs_ros.io.ros_images import UnknownEncodingError
from dcgs_ros.nodes.messages.images import (
    array_of,
    header,
    write_camera,
    write_color,
    write_depth_mm,
)
from dcgs_ros.nodes.tracking.camera_subscriber import CameraSubscriber
from dcgs_ros.nodes.tracking.frame_reader import FrameReader
from dcgs_ros.nodes.tracking.pairing import ImagePair

WIDTH, HEIGHT = 64, 48
STAMP_NS, INTERVAL_NS = 1_700_000_000_000_000_000, 33_333_333
HANGS_S = 60.0  # only a failure takes so long
BASES = {
    'color': '/camera/camera/color/image_raw',
    'depth': '/camera/camera/aligned_depth_to_color/image_raw',
}


def rgb() -> NDArray[np.uint8]:
    return np.random.default_rng(3).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)


def millimetres() -> NDArray[np.uint16]:
    depth = np.random.default_rng(4).integers(300, 9000, (HEIGHT, WIDTH)).astype(np.uint16)
    depth[:5] = 0
    return depth


def png(pixels: NDArray[Any]) -> bytes:
    return bytes(cv2.imencode('.png', pixels[..., ::-1] if pixels.ndim == 3 else pixels)[1])


def packed(kind: str, transport: str, stamp_ns: int) -> Any:
    """Return the message of a transport."""
    head = header(stamp_ns, 'camera_color_optical_frame')
    if transport == 'raw':
        depth_m = (millimetres() / np.float32(1000)).astype(np.float32)
        return write_color(rgb(), head) if kind == 'color' else write_depth_mm(depth_m, head)
    pixels, encoding = (rgb(), 'rgb8') if kind == 'color' else (millimetres(), '16UC1')
    format_, data = {
        'zstd': ('zstd', zstd(pixels, HEIGHT, encoding, really=False)),
        'compressed': (f'{encoding}; png compressed bgr8', png(pixels)),
        'compressedDepth': ('16UC1; compressedDepth rvl', bytes(12) + rvl(millimetres())),
    }[transport]
    return CompressedImage(header=head, format=format_, data=array_of(data))


def ignored(*_: object) -> None:
    """Take lines for the log, or questions to TF."""


def received(settings: TrackerNodeSettings, *arguments: str) -> ImagePair[Any, Any]:
    """Send images until a subscriber has a pair of them; topics are remapped by arguments."""
    base = dict(BASES)
    for argument in arguments:
        before, _, after = argument.partition(':=')
        base[next(kind for kind in base if base[kind] == before)] = after
    ros = ['--ros-args', *(part for text in arguments for part in ('-r', text))]
    node, camera = Node('images', cli_args=ros), Node('camera')
    try:
        subscriber = CameraSubscriber(node, settings, ignored, ignored, ignored)
        subscriber.begin()
        transports = {'color': settings.color_transport, 'depth': settings.depth_transport}
        suffixes = COLOR_TRANSPORTS | DEPTH_TRANSPORTS
        outputs = {
            kind: camera.create_publisher(
                Image if name == 'raw' else CompressedImage, base[kind] + suffixes[name], 5
            )
            for kind, name in transports.items()
        }
        end = time.monotonic() + HANGS_S
        for k in range(10_000):
            for kind, output in outputs.items():
                output.publish(packed(kind, transports[kind], STAMP_NS + k * INTERVAL_NS))
            rclpy.spin_once(node, timeout_sec=0.02)
            pair = subscriber.queue.take(0.001)
            if pair is not None:
                return pair
            assert time.monotonic() < end, f'nothing came: {subscriber.counts}'
        raise AssertionError('nothing came')
    finally:
        camera.destroy_node()
        node.destroy_node()


def read_frame(pair: ImagePair[Any, Any]) -> RgbdFrame:
    reader = FrameReader('auto', ('color', 'depth'), lambda *frames: None, lambda text: None)
    camera = PinholeCamera(WIDTH, HEIGHT, 50.0, 50.0, 31.5, 23.5)
    reader.on_info('color', write_camera(camera, header(STAMP_NS, 'optical')))
    return reader.read(pair)[0]


def check(pair: ImagePair[Any, Any]) -> None:
    frame = read_frame(pair)
    np.testing.assert_array_equal(frame.color, rgb())
    np.testing.assert_array_equal(frame.depth_m, millimetres() / np.float32(1000))


@pytest.mark.parametrize(
    ('color', 'depth'),
    [('raw', 'raw'), ('compressed', 'compressedDepth'), ('zstd', 'zstd'), ('raw', 'compressed')],
)
def test_a_camera_is_heard_by_any_transport(ros: None, color: Any, depth: Any) -> None:
    check(received(TrackerNodeSettings(color_transport=color, depth_transport=depth)))


def test_a_remapped_topic_takes_its_transports_along(ros: None) -> None:
    settings = TrackerNodeSettings(color_transport='compressed', depth_transport='compressedDepth')
    oak = [f'{BASES["color"]}:=/oak/rgb/image_raw', f'{BASES["depth"]}:=/oak/stereo/image_raw']
    check(received(settings, *oak))


def test_the_camera_info_of_depth_is_beside_its_images(ros: None) -> None:
    for arguments, beside in (
        ([], '/camera/camera/aligned_depth_to_color'),
        (['-r', f'{BASES["depth"]}:=/oak/stereo/image_raw'], '/oak/stereo'),
    ):
        node = Node('images', cli_args=['--ros-args', *arguments] if arguments else None)
        CameraSubscriber(node, TrackerNodeSettings(), ignored, ignored, ignored)
        infos = node.get_subscriptions_info_by_topic(f'{beside}/camera_info')
        node.destroy_node()
        assert len(infos) == 1


def test_the_settings_name_every_transport() -> None:
    hints = get_type_hints(TrackerNodeSettings)
    assert get_args(hints['color_transport']) == tuple(COLOR_TRANSPORTS)
    assert get_args(hints['depth_transport']) == tuple(DEPTH_TRANSPORTS)


def raw_pair(encoding: str, pixels: NDArray[Any]) -> ImagePair[Any, Any]:
    head = header(STAMP_NS, 'camera_color_optical_frame')
    color = Image(header=head, height=HEIGHT, width=WIDTH, encoding=encoding)
    color.step, color.data = pixels.nbytes // len(pixels), array_of(pixels)
    return ImagePair(STAMP_NS, color, STAMP_NS, packed('depth', 'raw', STAMP_NS))


@pytest.mark.parametrize('encoding', COLOR_ENCODINGS)
def test_colour_comes_in_any_encoding(encoding: str) -> None:
    frame = read_frame(raw_pair(encoding, pack(rgb(), encoding)))
    assert frame.color.shape[:2] == (HEIGHT, WIDTH)
    if encoding in ('bgra8', 'rgba8', 'rgb16', '8UC4'):
        np.testing.assert_array_equal(frame.color, rgb())


def test_an_encoding_that_nobody_reads_is_named_with_those_that_are() -> None:
    with pytest.raises(UnknownEncodingError, match="'yuv411', not one of rgb8, bgr8, mono8, rgba"):
        read_frame(raw_pair('yuv411', rgb()))


def test_rvl_is_compiled_before_the_first_image(
    ros: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[int] = []

    def decode(words: NDArray[np.uint32], out: NDArray[np.uint16]) -> bool:
        ran.append(len(out))
        return True

    monkeypatch.setattr(rvl_module, '_decode', decode)
    node = Node('images')
    for transport in ('raw', 'compressedDepth'):
        settings = TrackerNodeSettings(depth_transport=transport)  # type: ignore[arg-type]
        CameraSubscriber(node, settings, ignored, ignored, ignored).warm_up()
    node.destroy_node()
    assert ran == [1]


@pytest.mark.parametrize('paused_first', [False, True])
def test_paused_it_subscribes_to_no_images_until_it_goes_on(ros: None, paused_first: bool) -> None:
    """Also where it is paused before it begins."""
    node = Node('images')
    subscriber = CameraSubscriber(node, TrackerNodeSettings(), ignored, ignored, ignored)

    def topics() -> set[str]:
        return {subscription.topic_name for subscription in node.subscriptions}

    try:
        if paused_first:
            subscriber.pause()
        else:
            subscriber.resume()
        assert not topics() & set(BASES.values())  # it has not begun
        subscriber.begin()
        if not paused_first:
            assert topics() >= set(BASES.values())
            subscriber.pause()
        assert not topics() & set(BASES.values()) and subscriber.news().has_camera is False
        for _ in range(2):
            subscriber.resume()
            assert topics() >= set(BASES.values())
        assert len(list(node.subscriptions)) == 4  # with both camera_infos: each once
    finally:
        node.destroy_node()
