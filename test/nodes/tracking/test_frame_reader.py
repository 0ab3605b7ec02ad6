# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Frames are of one camera, whatever its driver makes of CameraInfo, sizes and frames."""

from __future__ import annotations

import array
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip('sensor_msgs')

from lens_views import plane_m, texture  # type: ignore[import-not-found]
from sensor_msgs.msg import CameraInfo

from dcgs_ros.core import se3
from dcgs_ros.core.camera import CameraError, PinholeCamera
from dcgs_ros.core.config.presets import RegistrationChoice
from dcgs_ros.core.errors import DcgsError, FrameError
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.lens_camera import Camera, LensCamera
from dcgs_ros.datasets.images.registration import RegistrationError
from dcgs_ros.datasets.images.resampling import scaled
from dcgs_ros.io.ros_images import MessageError
from dcgs_ros.nodes.messages.images import header, write_color, write_depth, write_depth_mm
from dcgs_ros.nodes.tracking.frame_reader import FrameReader
from dcgs_ros.nodes.tracking.pairing import ImagePair

SECOND = 1_000_000_000
PLAIN = PinholeCamera(160, 120, 131.0, 131.0, 79.0, 60.0)
DEPTH = PinholeCamera(140, 110, 100.0, 101.0, 70.0, 55.0)
FISHEYE = LensCamera(160, 120, 90.0, 90.0, 79.0, 60.0, (-0.006, 0.043, -0.041, 0.008), True)
ALIGNED, RAW = '/camera/aligned_depth_to_color/image_raw', '/camera/depth/image_rect_raw'
T_COLORCAM_DEPTHCAM = se3.exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
NEAR_M, GREY = 1e-3, 4.0


def info(camera: Camera, at_ns: int = 0, focal: float | None = None) -> CameraInfo:
    fx = camera.fx if focal is None else focal
    message = CameraInfo(header=header(at_ns, 'optical'), width=camera.width, height=camera.height)
    message.k = np.array([fx, 0, camera.cx, 0, fx and camera.fy, camera.cy, 0, 0, 1])
    message.d = array.array('d', camera.distortion)
    message.distortion_model = 'equidistant' if isinstance(camera, LensCamera) else 'plumb_bob'
    return message


class Node:
    """A `FrameReader`, what TF knows, and what was told."""

    def __init__(self, topic: str = ALIGNED, choice: RegistrationChoice = 'auto') -> None:
        self.T: NDArray[np.float64] | None = None
        self.told: list[str] = []
        self.asked: list[tuple[str, str]] = []
        self.reader = FrameReader(choice, ('/color', topic), self._lookup, self.told.append)

    def _lookup(self, parent: str, child: str) -> NDArray[np.float64] | None:
        self.asked.append((parent, child))
        return self.T

    def read(
        self, color: Camera, depth: Camera | None = None, at_ns: int = 0, frame: str = 'optical'
    ) -> tuple[RgbdFrame, PinholeCamera]:
        """Read what two cameras see of the plane."""
        return self.reader.read(
            ImagePair(
                at_ns, write_color(texture(color), header(at_ns, 'optical')),
                at_ns, write_depth(plane_m(depth or color), header(at_ns, frame)),
            )
        )  # fmt: skip


def assert_true(frame: RgbdFrame, camera: PinholeCamera) -> None:
    inside = (slice(6, -6), slice(6, -6))
    seen = frame.depth_m[inside] > 0
    assert seen.mean() > 0.9
    assert np.abs(frame.depth_m - plane_m(camera))[inside][seen].max() < NEAR_M
    assert np.abs(frame.color.astype(float) - texture(camera))[inside].mean() < GREY


def test_intrinsics_that_change_are_followed_and_the_camera_stays() -> None:
    node = Node()
    for k, zoom in enumerate([1.0, 1.0 + 1e-9, 1.01, 1.03, 0.97]):
        now = replace(PLAIN, fx=zoom * PLAIN.fx, fy=zoom * PLAIN.fy)
        node.reader.on_info('color', info(now, k * SECOND))
        frame, camera = node.read(now, at_ns=k * SECOND)
        assert camera == PLAIN
        assert_true(frame, PLAIN)
        if k < 2:
            np.testing.assert_array_equal(frame.color, texture(now))
    assert node.told == ['registration of depth: as recorded']


def test_each_image_has_the_intrinsics_of_its_stamp() -> None:
    """CameraInfo comes ahead of the images that are still decoded."""
    node = Node()
    zooms = [replace(PLAIN, fx=z * PLAIN.fx, fy=z * PLAIN.fy) for z in (1.0, 1.02, 1.04)]
    for k, now in enumerate(zooms):
        node.reader.on_info('color', info(now, k * SECOND // 30))
    for k, now in enumerate(zooms):
        assert_true(node.read(now, at_ns=k * SECOND // 30)[0], PLAIN)


def test_when_the_clock_is_set_back_the_newest_intrinsics_hold() -> None:
    node = Node()
    node.reader.on_info('color', info(PLAIN, 100 * SECOND))
    node.read(PLAIN, at_ns=100 * SECOND)
    zoomed = replace(PLAIN, fx=1.03 * PLAIN.fx, fy=1.03 * PLAIN.fy)
    node.reader.on_info('color', info(zoomed, 5 * SECOND))
    assert_true(node.read(zoomed, at_ns=6 * SECOND)[0], PLAIN)
    assert_true(node.read(zoomed, at_ns=101 * SECOND)[0], PLAIN)


def test_another_camera_is_another() -> None:
    node = Node()
    half = scaled(PLAIN, 80, 60)
    tele = replace(PLAIN, fx=2 * PLAIN.fx, fy=2 * PLAIN.fy)
    for k, now in enumerate([PLAIN, half, tele]):
        node.reader.on_info('color', info(now, k * SECOND))
        frame, camera = node.read(now, at_ns=k * SECOND)
        assert camera == now
        np.testing.assert_array_equal(frame.color, texture(now))


def test_unusable_intrinsics_leave_the_last_good_ones() -> None:
    node = Node()
    for _ in range(2):
        with pytest.raises(CameraError, match='not usable'):
            node.reader.on_info('color', info(PLAIN, focal=0.0))
    assert not node.reader.has_camera
    with pytest.raises(MessageError, match='no usable camera_info'):
        node.read(PLAIN)
    node.reader.on_info('color', info(PLAIN))
    with pytest.raises(DcgsError):
        node.reader.on_info('color', info(PLAIN, focal=0.0))
    assert node.read(PLAIN)[1] == PLAIN


def test_a_fisheye_is_rectified() -> None:
    node = Node()
    node.reader.on_info('color', info(FISHEYE))
    frame, camera = node.read(FISHEYE)
    assert camera == FISHEYE.pinhole
    assert_true(frame, camera)


def test_depth_of_another_size_is_registered_by_it() -> None:
    node = Node(RAW)
    node.reader.on_info('color', info(PLAIN))
    assert_true(node.read(PLAIN, scaled(PLAIN, 64, 48))[0], PLAIN)
    assert node.told == ['registration of depth: as recorded, by its size of 64x48']


def test_depth_is_registered_by_tf_once_that_is_known() -> None:
    node = Node(RAW)
    node.reader.on_info('color', info(PLAIN))
    for missing in ('extrinsics', 'CameraInfo'):
        with pytest.raises(RegistrationError, match=f'no {missing}'):
            node.read(PLAIN, DEPTH, frame='infrared')
        node.T = T_COLORCAM_DEPTHCAM
    node.reader.on_info('depth', info(DEPTH))
    frame, camera = node.read(PLAIN, DEPTH, frame='infrared')
    assert camera == PLAIN and set(node.asked) == {('optical', 'infrared')}
    assert np.abs(frame.depth_m - plane_m(PLAIN))[40:-40, 40:-40].max() > 10 * NEAR_M
    assert node.told == ['registration of depth: here, by the recorded extrinsics: 100.0 mm apart']
    asked = len(node.asked)
    node.read(PLAIN, DEPTH, frame='infrared')
    assert len(node.asked) == asked


@pytest.mark.parametrize('topic', [ALIGNED, RAW])
def test_registered_depth_in_depths_frame_is_not_registered_again(topic: str) -> None:
    node = Node(topic)
    node.T = T_COLORCAM_DEPTHCAM
    node.reader.on_info('color', info(PLAIN))
    if topic == RAW:
        node.reader.on_info('depth', info(PLAIN))
    assert_true(node.read(PLAIN, frame='infrared')[0], PLAIN)
    assert len(node.told) == 1 and 'though in frame infrared' in node.told[0]


def test_the_user_decides() -> None:
    node = Node(ALIGNED, 'extrinsics')
    node.reader.on_info('color', info(PLAIN))
    with pytest.raises(RegistrationError, match='no extrinsics'):
        node.read(PLAIN, frame='infrared')
    node = Node(RAW, 'none')
    node.reader.on_info('color', info(PLAIN))
    assert_true(node.read(PLAIN, frame='infrared')[0], PLAIN)
    assert node.told == ['registration of depth: as recorded, as you say']


def test_the_camera_of_a_map_stays_when_depths_intrinsics_come() -> None:
    """The shrunk size would differ by a pixel or two, and begin another map."""
    node, color = Node(RAW), scaled(PLAIN, 1280, 960)
    node.reader.on_info('color', info(color))
    other = replace(scaled(PLAIN, 700, 525), fx=0.6 * color.fx, fy=0.6 * color.fx)
    _, before = node.read(color, other)
    node.reader.on_info('depth', info(other))
    frame, after = node.read(color, other)
    assert before == after and frame.depth_m.shape == (before.height, before.width)


UNITS = {
    'millimetres': (write_depth_mm, 1.0, None),
    'metres': (write_depth, 1.0, None),
    'quarters of a millimetre': (write_depth_mm, 4.0, 4000.0),
    'floats in millimetres': (write_depth, 1000.0, 1000.0),
}


@pytest.mark.parametrize('unit', UNITS)
def test_depth_is_read_in_ros_units_or_the_one_that_is_told(unit: str) -> None:
    node, depth_m = Node(), np.full((120, 160), 1.5, np.float32)
    node.reader.on_info('color', info(PLAIN))
    write, factor, per_metre = UNITS[unit]
    head = header(0, 'optical')
    pair = ImagePair(0, write_color(texture(PLAIN), head), 0, write(factor * depth_m, head))
    np.testing.assert_array_equal(node.reader.read(pair, per_metre)[0].depth_m, depth_m)


def test_an_image_of_another_size_than_its_camera_is_refused() -> None:
    node = Node()
    node.reader.on_info('color', info(PLAIN))
    with pytest.raises(FrameError, match='colour is 80x60 pixels'):
        node.read(scaled(PLAIN, 80, 60))


def test_no_distortion_is_left_in_images_that_are_called_rectified() -> None:
    lens = replace(PLAIN, distortion=(0.1, -0.2, 0.001, 0.002, 0.05))
    for topic, expected in (('/rgb/image_rect_color', PLAIN), ('/rgb/image_color', lens)):
        reader = FrameReader('auto', (topic, ALIGNED), lambda *_: None, lambda _: None)
        message = info(lens)
        message.p = np.array([PLAIN.fx, 0, PLAIN.cx, 0, 0, PLAIN.fy, PLAIN.cy, 0, 0, 0, 1, 0.0])
        reader.on_info('color', message)
        head = header(0, 'optical')
        pair = ImagePair(
            0, write_color(texture(PLAIN), head), 0, write_depth(plane_m(PLAIN), head)
        )
        assert reader.read(pair)[1] == expected
