# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""ScanNet's frames are those of the depth camera, with colour resampled."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scannets import (  # type: ignore[import-not-found]
    COLOR_SIZE,
    INTERVAL_US,
    JPEG,
    K_COLOR,
    K_DEPTH,
    START_US,
    frames_of,
    sens_bytes,
    small_camera,
    write_folder,
)

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.datasets.camera_presets import PRESETS
from dcgs_ros.datasets.images.color_resampling import color_resampling
from dcgs_ros.datasets.images.depth_registration import register_depth
from dcgs_ros.datasets.images.sequence import ImageSequence
from dcgs_ros.datasets.options import SourceOptions
from dcgs_ros.datasets.scannet.source import LAYOUT, is_scannet, open_scannet
from dcgs_ros.datasets.source import BadFrame, Source, SourceError

FLOAT32_TURN = 1e-6  # of a pose's numbers
TEXT_TURN = 1e-6  # with six decimals
GREY_STEP = 1.0
JPEG_LOSS = 30.0  # of noise, on average


def frames_in(source: Source) -> list[RgbdFrame]:
    frames = list(source)
    assert all(isinstance(frame, RgbdFrame) for frame in frames), frames
    assert len(frames) == len(source)
    return [frame for frame in frames if isinstance(frame, RgbdFrame)]


def test_a_sens_file_gives_its_frames(tmp_path: Path) -> None:
    path = tmp_path / 'scene0000_00.sens'
    written = frames_of(4)
    path.write_bytes(sens_bytes(written))
    assert is_scannet(path)
    source = open_scannet(path)
    assert source.name == 'scene0000_00'
    assert source.sensor == PRESETS['scannet'].sensor
    resample = color_resampling(
        small_camera(COLOR_SIZE, K_COLOR.astype(np.float32)), source.camera, np.eye(4)
    )
    for _ in range(2):  # a source begins anew each time
        for k, (frame, was) in enumerate(zip(frames_in(source), written, strict=True)):
            assert frame.stamp_ns == 1000 * (START_US + k * INTERVAL_US)
            color, depth_m = resample(was.color, was.depth / np.float32(1000))
            np.testing.assert_array_equal(frame.color, color)
            np.testing.assert_array_equal(frame.depth_m, depth_m)
    truth = source.groundtruth
    assert truth is not None
    poses = np.array([frame.pose for frame in written])
    np.testing.assert_allclose(truth.T_world_cam, poses, atol=FLOAT32_TURN)


@pytest.mark.parametrize('below', ['.', 'frames'])
def test_an_exported_folder_gives_the_same(tmp_path: Path, below: str) -> None:
    written = frames_of(12)
    scene = tmp_path / 'scene0000_00'
    write_folder(scene / below, written)
    assert is_scannet(scene)
    source = open_scannet(scene)
    assert isinstance(source, ImageSequence)
    assert source.name == 'scene0000_00'
    sens = tmp_path / 'scene.sens'
    sens.write_bytes(sens_bytes(written, JPEG))
    original = open_scannet(sens)
    assert source.camera.parameters == pytest.approx(original.camera.parameters)
    for k, (frame, was) in enumerate(zip(frames_in(source), frames_in(original), strict=True)):
        assert frame.stamp_ns == round(k * 1e9 / 30)  # 10 comes after 9, not after 1
        np.testing.assert_array_equal(frame.depth_m, was.depth_m)
        assert np.abs(frame.color.astype(int) - was.color).max() <= GREY_STEP  # six decimals
    truth = source.groundtruth
    assert truth is not None
    poses = np.array([frame.pose for frame in written])
    np.testing.assert_allclose(truth.T_world_cam, poses, atol=TEXT_TURN)


@pytest.mark.parametrize('beside', [False, True])
def test_color_may_be_png_and_intrinsics_three_by_three(tmp_path: Path, beside: bool) -> None:
    """Also in the places where other tools put them."""
    written = frames_of(3)
    folder = write_folder(tmp_path / 'scene', written)
    expected = frames_in(open_scannet(folder))
    for k, frame in enumerate(written):
        cv2.imwrite(str(folder / f'color/{k}.png'), frame.color[..., ::-1])
        (folder / f'color/{k}.jpg').unlink()
    for kind, K in (('color', K_COLOR), ('depth', K_DEPTH)):
        path = folder / f'intrinsic/intrinsic_{kind}.txt'
        path.unlink()
        path = folder / f'intrinsics_{kind}.txt' if beside else path
        np.savetxt(path, K[:3, :3], fmt='%f')
    if beside:
        (folder / 'intrinsic').rmdir()
    assert is_scannet(folder)
    source = open_scannet(folder, options=SourceOptions(depth_per_metre=500))
    for frame, was in zip(frames_in(source), expected, strict=True):
        np.testing.assert_allclose(frame.depth_m, 2 * was.depth_m)
        assert np.abs(frame.color.astype(int) - was.color).mean() < JPEG_LOSS


def test_the_options_hold_for_a_sens_file_too(tmp_path: Path) -> None:
    path = tmp_path / 'scene.sens'
    path.write_bytes(sens_bytes(frames_of(3)))
    options = SourceOptions(depth_per_metre=500, rate_hz=10)
    source = open_scannet(path, options=options)
    assert source.depth_per_metre == 500
    for frame, was in zip(frames_in(source), frames_in(open_scannet(path)), strict=True):
        np.testing.assert_allclose(frame.depth_m, 2 * was.depth_m)
    assert [frame.stamp_ns for frame in frames_in(source)] == [0, 10**8, 2 * 10**8]


def test_lost_poses_leave_the_frames(tmp_path: Path) -> None:
    bad = [
        np.full((4, 4), -np.inf),
        np.full((4, 4), np.nan),
        np.diag([2.0, 2, 2, 1]),
        np.diag([1.0, 1, -1, 1]),
        np.diag([1.0, 1, 1, 0]),
        np.full((4, 4), 3e38),
        np.zeros((4, 4)),
    ]
    written = frames_of(len(bad) + 2)
    frames = [frame._replace(pose=pose) for frame, pose in zip(written[1:], bad, strict=False)]
    path = tmp_path / 'scene.sens'
    path.write_bytes(sens_bytes([written[0], *frames, written[-1]]))
    folder = write_folder(tmp_path / 'scene', [written[0], *frames, written[-1]])
    (folder / 'pose' / '3.txt').write_text('garbage')
    (folder / 'pose' / '4.txt').unlink()
    for source in (open_scannet(path), open_scannet(folder)):
        stamps = [frame.stamp_ns for frame in frames_in(source)]
        assert source.groundtruth is not None
        assert source.groundtruth.stamps_ns.tolist() == [stamps[0], stamps[-1]]


def test_depth_of_another_place_is_registered(tmp_path: Path) -> None:
    T_rig_depth = se3.exp(np.array([0.05, 0, 0, 0, 0, 0]))
    written = frames_of(2)
    path = tmp_path / 'scene.sens'
    path.write_bytes(sens_bytes(written, extrinsic_depth=T_rig_depth))
    folder = write_folder(tmp_path / 'scene', written, extrinsic_depth=T_rig_depth)
    for source in (open_scannet(path), open_scannet(folder)):
        for frame, was in zip(frames_in(source), written, strict=True):
            depth_m = was.depth / np.float32(1000)
            moved = register_depth(depth_m, source.camera, T_rig_depth, source.camera)
            colored = frame.depth_m > 0
            assert colored.mean() > 0.5
            np.testing.assert_allclose(frame.depth_m[colored], moved[colored], rtol=1e-6)
            assert not np.array_equal(frame.depth_m, depth_m)


def test_the_users_camera_is_the_depth_cameras(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / 'scene', frames_of(1))
    (folder / 'intrinsic/intrinsic_depth.txt').unlink()
    source = open_scannet(folder, camera='57,58,32,24')
    assert source.camera == PinholeCamera(64, 48, 57, 58, 32, 24)
    frames_in(source)
    with pytest.raises(SourceError, match='camera fr3 has 640x480 pixels, the depth images 64x48'):
        open_scannet(folder, camera='fr3')
    with pytest.raises(SourceError, match=r'intrinsic_depth\.txt: cannot be read: No such file'):
        open_scannet(folder)


def test_the_users_truth_is_taken(tmp_path: Path) -> None:
    path, truth = tmp_path / 'scene.sens', tmp_path / 'truth.txt'
    path.write_bytes(sens_bytes(frames_of(1)))
    truth.write_text('8.5 0 0 0 0 0 0 1\n')
    groundtruth = open_scannet(path, groundtruth=truth).groundtruth
    assert groundtruth is not None
    assert groundtruth.stamps_ns.tolist() == [8_500_000_000]


def test_numbers_that_are_missing_keep_the_time_of_the_others(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / 'scene', frames_of(5))
    (folder / 'color/1.jpg').unlink()
    (folder / 'depth/3.png').unlink()
    (folder / 'color/cover.jpg').write_bytes(b'')
    stamps = [frame.stamp_ns for frame in frames_in(open_scannet(folder))]
    assert stamps == [0, 66_666_667, 133_333_333]


def test_color_of_another_size_is_one_bad_frame(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / 'scene', frames_of(3))
    cv2.imwrite(str(folder / 'color/1.jpg'), np.ones((48, 64, 3), np.uint8))
    frames = list(open_scannet(folder))
    assert [isinstance(frame, BadFrame) for frame in frames] == [False, True, False]
    assert isinstance(frames[1], BadFrame)
    assert frames[1].reason == 'colour is 64x48 pixels, the other images are 130x97'


BAD_FILES = {
    'other size': ('intrinsic_color.txt', '1170 0 647 0 0 1170 483 0 0 0 1 0 0 0 0 1', 'outside'),
    'too few': ('intrinsic_color.txt', '1 2 3', '3 numbers, not the 16'),
    'no number': ('intrinsic_depth.txt', 'a ' * 16, 'could not convert'),
    'binary': ('intrinsic_depth.txt', '\0\xff' * 9, '1 numbers, not the 16'),
    'endless': ('intrinsic_depth.txt', '1 ' * 100_000, '200000 bytes, more than'),
    'not finite': ('intrinsic_depth.txt', 'nan ' * 16, 'not usable'),
    'moved': ('extrinsic_depth.txt', '3 ' * 16, 'not a rigid motion'),
    'another scale': (
        'intrinsic_depth.txt',
        '0.5 0 32 0 0 0.5 24 0 0 0 1 0 0 0 0 1',
        'does not show what depth',
    ),
}


@pytest.mark.parametrize('fault', BAD_FILES)
def test_a_bad_calibration_is_named(tmp_path: Path, fault: str) -> None:
    name, text, reason = BAD_FILES[fault]
    folder = write_folder(tmp_path / 'scene', frames_of(1))
    (folder / 'intrinsic' / name).write_text(text)
    with pytest.raises(SourceError, match=reason) as caught:
        open_scannet(folder)
    assert 'scene/intrinsic' in str(caught.value)


def test_a_folder_without_pairs_is_told(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / 'scene', [])
    with pytest.raises(SourceError, match=r'none of 0 colour images .* one of 0 depth'):
        open_scannet(folder)


def test_other_things_are_not_scannet(tmp_path: Path) -> None:
    assert not is_scannet(tmp_path)
    assert not is_scannet(tmp_path / 'none.sens')
    with pytest.raises(SourceError, match='has color/, depth/ and intrinsic/'):
        open_scannet(tmp_path)
    assert 'ScanNet' in LAYOUT
