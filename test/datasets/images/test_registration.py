# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Whether depth is registered to colour is decided as drivers have it, and said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.presets import RegistrationChoice
from dcgs_ros.core.lens_camera import LensCamera
from dcgs_ros.datasets.images.depth_registration import register_depth
from dcgs_ros.datasets.images.registration import (
    Registration,
    RegistrationError,
    Stream,
    find_registration,
)
from dcgs_ros.datasets.images.resampling import scaled

COLOR = PinholeCamera(640, 480, 615.0, 616.0, 321.0, 242.0, (0.1, -0.2, 0.0, 0.0, 0.0))
DEPTH = PinholeCamera(640, 480, 385.0, 385.0, 319.5, 239.5)
T_COLORCAM_DEPTHCAM = se3.exp(np.array([0.015, 0.0, 0.0, 0.01, 0.0, 0.0]))
RGB, INFRARED = 'camera_color_optical_frame', 'camera_depth_optical_frame'
RAW, ALIGNED = '/camera/depth/image_rect_raw', '/camera/aligned_depth_to_color/image_raw'


def found(
    topic: str = RAW,
    frame: str = INFRARED,
    camera: PinholeCamera | None = DEPTH,
    size: tuple[int, int] = (640, 480),
    T: NDArray[np.float64] | None = T_COLORCAM_DEPTHCAM,
    asked: RegistrationChoice = 'auto',
    color: PinholeCamera | LensCamera = COLOR,
) -> Registration:
    colors = Stream('/camera/color/image_raw', RGB, (color.width, color.height), color)
    depths = Stream(topic, frame, size, camera)
    return find_registration(asked, colors, color, depths, lambda: T)


def is_moved(registration: Registration) -> bool:
    return registration.T_colorcam_depthcam is not None


@pytest.mark.parametrize(
    'topic',
    [
        ALIGNED,
        '/camera/depth_registered/image_raw',
        '/zed/zed_node/depth/depth_registered',
        '/depth_to_rgb/image_raw',
        '/Camera/Depth2Color/image',
    ],
)
@pytest.mark.parametrize('camera', [COLOR, None])
@pytest.mark.parametrize('T', [T_COLORCAM_DEPTHCAM, None])
def test_a_topic_that_says_registered_is_not_registered_twice(
    topic: str, camera: PinholeCamera | None, T: NDArray[np.float64] | None
) -> None:
    registration = found(topic, INFRARED, camera, T=T)
    assert not is_moved(registration) and registration.as_recorded
    assert registration.reason == f'as recorded, as its name says, though in frame {INFRARED}'


@pytest.mark.parametrize('T', [T_COLORCAM_DEPTHCAM, None])
def test_colours_size_and_intrinsics_are_registered_depths(T: NDArray[np.float64] | None) -> None:
    for topic in (RAW, '/some/image'):
        registration = found(topic, INFRARED, COLOR, T=T)
        assert not is_moved(registration) and registration.as_recorded
        assert 'it has the intrinsics of colour' in registration.reason


@pytest.mark.parametrize('topic', [RAW, '/unaligned_depth/image', '/depth_unregistered/image'])
def test_another_camera_in_another_frame_is_registered(topic: str) -> None:
    registration = found(topic)
    assert registration.T_colorcam_depthcam is T_COLORCAM_DEPTHCAM
    assert registration.reason == 'here, by the recorded extrinsics: 15.0 mm apart'


@pytest.mark.parametrize('topic', ['/unaligned_depth/image', '/depth_unregistered/image'])
def test_a_name_may_say_that_it_is_not(topic: str) -> None:
    with pytest.raises(RegistrationError, match='no extrinsics'):
        found(topic, camera=None, T=None)


def test_intrinsics_contradict_a_name_where_extrinsics_are_known() -> None:
    assert is_moved(found(ALIGNED))
    kept = found(ALIGNED, T=None)
    assert not is_moved(kept) and 'by its own intrinsics' in kept.reason


@pytest.mark.parametrize('frame', [RGB, f'/{RGB}', ''])
def test_depth_in_colours_frame_is_registered_already(frame: str) -> None:
    for camera in (DEPTH, COLOR, None):
        registration = found(RAW, frame, camera)
        assert not is_moved(registration)
        assert registration.as_recorded == (camera is not DEPTH)


def test_what_the_user_says_holds() -> None:
    kept = found(asked='none', T=None)
    assert not is_moved(kept) and kept.reason == 'as recorded, as you say'
    assert is_moved(found(ALIGNED, RGB, DEPTH, asked='extrinsics'))
    with pytest.raises(RegistrationError, match=r'no extrinsics.*registration=none'):
        found(ALIGNED, RGB, DEPTH, T=None, asked='extrinsics')


def test_what_registers_it_may_be_missing() -> None:
    with pytest.raises(RegistrationError, match=rf'{INFRARED}.*no extrinsics.*align_depth'):
        found(T=None)
    with pytest.raises(RegistrationError, match='no CameraInfo to do it is known'):
        found(camera=None)


def test_cameras_at_one_place_are_not_drawn_but_resampled() -> None:
    assert not is_moved(found(T=np.eye(4), asked='extrinsics'))


@pytest.mark.parametrize('frame', [RGB, 'phone_depth'])
@pytest.mark.parametrize('known', [True, False])
def test_depth_of_another_size_is_registered_by_its_size(frame: str, known: bool) -> None:
    """A phone: 256x192 under 1920x1440, both of the same view."""
    color = scaled(PinholeCamera(640, 480, 480.0, 480.0, 320.0, 241.0), 1920, 1440)
    small = scaled(color, 256, 192)
    if frame == RGB or known:
        registration = found('/phone/depth', frame, small if known else None, (256, 192),
                             None, color=color)  # fmt: skip
        assert registration.as_recorded
        assert (registration.camera.width, registration.camera.height) == (640, 480)
        assert 'by its size of 256x192' in registration.reason
    else:
        with pytest.raises(RegistrationError, match='no extrinsics'):
            found('/phone/depth', frame, None, (256, 192), None, color=color)


def test_another_shape_needs_intrinsics() -> None:
    with pytest.raises(RegistrationError, match=r'256x192 pixels, colour 640x360.*no CameraInfo'):
        found(ALIGNED, RGB, None, (256, 192), color=replace(COLOR, height=360))
    part = PinholeCamera(256, 192, 246.0, 246.4, 127.5, 95.5)
    registration = found(ALIGNED, RGB, part, (256, 192), color=replace(COLOR, height=360))
    assert not registration.by_size


@pytest.mark.parametrize(
    ('color', 'depth', 'width'),
    [
        ((1280, 720, 920.0), (848, 480, 424.0), 640),
        ((1920, 1080, 920.0), (640, 576, 504.0), 1052),
        ((640, 480, 615.0), (848, 480, 424.0), 640),
        ((848, 480, 615.0), (1280, 720, 640.0), 848),
        ((640, 480, 600.0), (160, 120, 150.0), 640),
        ((320, 240, 300.0), (160, 120, 150.0), 320),
    ],
)
def test_colour_is_shrunk_to_what_depth_resolves_but_not_below_640(
    color: tuple[int, int, float], depth: tuple[int, int, float], width: int
) -> None:
    def camera(width: int, height: int, f: float) -> PinholeCamera:
        return PinholeCamera(width, height, f, f, width / 2, height / 2)

    registration = found(color=camera(*color), camera=camera(*depth), size=depth[:2])
    assert registration.camera.width == width
    assert registration.camera.focal == pytest.approx(color[2] * width / color[0], 1e-3)


def test_coarse_depth_beside_colour_is_drawn_without_blocks() -> None:
    color = PinholeCamera(640, 480, 525.0, 525.0, 319.5, 239.5)
    coarse = replace(scaled(color, 128, 96), cx=60.0)
    normal = np.array([0.4, -0.2, 1.0])

    def plane(
        camera: PinholeCamera, normal: NDArray[np.float64], off: float
    ) -> NDArray[np.float32]:
        rays = camera.undistortion_map.astype(np.float64)
        return (off / (rays @ normal[:2] + normal[2])).astype(np.float32)

    T = T_COLORCAM_DEPTHCAM
    turned = T[:3, :3] @ normal
    expected = plane(color, turned, 2.0 + turned @ T[:3, 3])
    depth_m, inside = plane(coarse, normal, 2.0), (slice(20, -20), slice(40, -40))
    registration = found(camera=coarse, size=(128, 96), color=color)
    _, drawn = registration(np.zeros((480, 640, 3), np.uint8), depth_m, color, coarse)
    blocks = register_depth(depth_m, coarse, T, color)
    off, before = (np.abs(image - expected)[inside] for image in (drawn, blocks))
    assert (drawn[inside] > 0).all()
    assert off.max() < 0.3 * before.max()


def test_intrinsics_that_change_leave_the_camera_of_the_frames() -> None:
    registration = found(RAW, RGB, None, (320, 240))
    now = replace(COLOR, fx=1.03 * COLOR.fx, fy=1.03 * COLOR.fy)
    distance_m = np.full((240, 320), 2.0, np.float32)
    distance_m[:, 160:] = 4.0  # the edge is 0.5 px left of the centre of the image
    color = np.repeat(np.where(np.arange(640) < 320, 0, 200).astype(np.uint8)[None], 480, 0)
    seen, depth_m = registration(color, distance_m, now, None)
    edge = (319.5 - COLOR.cx) / 1.03 + COLOR.cx
    row = depth_m[240, 20:-20]
    assert np.abs(np.flatnonzero(row == 4.0)[0] + 20 - edge) <= 1.0
    assert (np.diff(row) != 0.0).sum() == 1
    assert abs(np.interp(100, seen[240].astype(float), np.arange(640.0)) - edge) < 1.0
