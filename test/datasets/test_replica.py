# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Replica folders: numbers are times, rows are poses, and what is wrong is named."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import folders  # type: ignore[import-not-found]
import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.datasets.camera_presets import PRESETS
from dcgs_ros.datasets.images.indexed_frames import stamp_of_index
from dcgs_ros.datasets.open import open_source
from dcgs_ros.datasets.replica import is_replica, open_replica
from dcgs_ros.datasets.source import BadFrame, SourceError

HALF_A_STEP_M = 0.6 / 6553.5  # of a 16-bit depth, and float32's rounding
JPEG_ERROR = 4


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return folders.write_replica(
        tmp_path / 'room0', range(4), [folders.pose_of(k) for k in range(4)]
    )


def test_frames_are_what_was_written(scene: Path) -> None:
    assert is_replica(scene)
    source = open_replica(scene)
    assert source.name == 'room0'
    assert source.camera == folders.CAMERA
    assert source.sensor == PRESETS['replica'].sensor
    frames = folders.good_frames(source)
    assert [frame.stamp_ns for frame in frames] == [0, 33333333, 66666667, 100000000]
    for k, frame in enumerate(frames):
        assert frame.depth_stamp_ns == frame.stamp_ns
        assert np.abs(frame.color.astype(int) - folders.color_of(k)).max() <= JPEG_ERROR
        np.testing.assert_allclose(frame.depth_m, 1 + 0.1 * k, atol=HALF_A_STEP_M)


def test_color_may_be_png(scene: Path) -> None:
    for path in (scene / 'results').glob('*.jpg'):
        folders.write_image(path.with_suffix('.png'), folders.color_of(int(path.stem[-6:])))
        path.unlink()
    assert is_replica(scene)
    for k, frame in enumerate(folders.good_frames(open_replica(scene))):
        np.testing.assert_array_equal(frame.color, folders.color_of(k))


def test_the_layout_of_semantic_nerf(tmp_path: Path) -> None:
    """The camera sees 90 degrees across; 10 comes after 9."""
    folder = tmp_path / 'room_0' / 'Sequence_1'
    for k in range(11):
        folders.write_image(folder / f'rgb/rgb_{k}.png', folders.color_of(k))
        depth = np.full((48, 64), 1000 + 100 * k, np.uint16)
        folders.write_image(folder / f'depth/depth_{k}.png', depth)
    rows = ''.join(folders.matrix_row(folders.pose_of(k)) + '\n' for k in range(11))
    (folder / 'traj_w_c.txt').write_text(rows)
    assert not is_replica(folder)
    source = open_source(str(folder))
    assert source.camera == PinholeCamera(64, 48, 32.0, 32.0, 31.5, 23.5)
    assert source.depth_per_metre == 1000
    for k, frame in enumerate(folders.good_frames(source)):
        assert frame.stamp_ns == stamp_of_index(k)
        np.testing.assert_array_equal(frame.color, folders.color_of(k))
        np.testing.assert_allclose(frame.depth_m, 1 + 0.1 * k, rtol=1e-6)
    assert source.groundtruth is not None
    expected = [folders.pose_of(k) for k in range(11)]
    np.testing.assert_allclose(
        source.groundtruth.T_world_cam, expected, atol=folders.POSE_TOLERANCE
    )


def test_poses_are_what_was_written(scene: Path) -> None:
    truth = open_replica(scene).groundtruth
    assert truth is not None
    assert truth.stamps_ns.tolist() == [stamp_of_index(k) for k in range(4)]
    expected = [folders.pose_of(k) for k in range(4)]
    np.testing.assert_allclose(truth.T_world_cam, expected, atol=folders.POSE_TOLERANCE)


def test_absent_frames_leave_the_others_their_times(tmp_path: Path) -> None:
    poses = [folders.pose_of(k) for k in range(9)]
    scene = folders.write_replica(tmp_path / 'office1', (2, 5, 7), poses)
    (scene / 'results/depth000005.png').unlink()
    (scene / 'results/frame3.jpg').touch()
    source = open_replica(scene)
    stamps_ns = [frame.stamp_ns for frame in folders.good_frames(source)]
    assert stamps_ns == [stamp_of_index(2), stamp_of_index(7)]
    assert source.groundtruth is not None
    assert len(source.groundtruth) == 9


NO_POSES: dict[str, Callable[[NDArray[np.float64]], NDArray[np.float64]]] = {
    'transposed': lambda T: T.T,
    'mirrored': lambda T: T @ np.diag([1, -1, 1, 1]),
    'scaled': lambda T: T * [[1.1], [1.1], [1.1], [1]],
    'endless': lambda T: np.where(T > 0.5, np.inf, T),
    'unknown': lambda T: np.full_like(T, np.nan),
    'huge': lambda T: T + np.diag([1e300, 0, 0], 1),
}


@pytest.mark.parametrize('fault', NO_POSES)
def test_a_row_that_is_no_pose_is_left_out(scene: Path, fault: str) -> None:
    rows = [folders.matrix_row(folders.pose_of(k)) for k in range(4)]
    rows[2] = folders.matrix_row(NO_POSES[fault](folders.pose_of(2)))
    (scene / 'traj.txt').write_text('\n'.join(rows))
    truth = open_replica(scene).groundtruth
    assert truth is not None
    assert truth.stamps_ns.tolist() == [stamp_of_index(k) for k in (0, 1, 3)]
    (scene / 'traj.txt').write_text(rows[2])
    with pytest.raises(SourceError, match=r'traj\.txt: none of 1 poses'):
        open_replica(scene)


def test_the_camera_beside_the_scene_yields_to_the_one_in_it(scene: Path) -> None:
    numbers = {**folders.NUMBERS_JSON, 'fx': 55.0, 'scale': 1000.0}
    (scene / 'cam_params.json').write_text(json.dumps({'camera': numbers}))
    source = open_replica(scene)
    assert (source.camera.fx, source.depth_per_metre) == (55.0, 1000.0)


def test_without_a_camera_file_it_is_the_presets(scene: Path) -> None:
    (scene.parent / 'cam_params.json').unlink()
    source = open_replica(scene)
    assert source.camera == PRESETS['replica'].camera
    (bad, *_) = source
    assert isinstance(bad, BadFrame)
    assert '64x48' in bad.reason
    assert '1200x680' in bad.reason


def test_given_intrinsics_and_truth_replace_the_folders(scene: Path, tmp_path: Path) -> None:
    given_truth = tmp_path / 'other.txt'
    given_truth.write_text('0.5 1 2 3 0 0 0 1\n')
    source = open_replica(scene, '60,61,31,23', given_truth)
    assert (source.camera.fx, source.camera.width) == (60.0, 64)
    assert source.depth_per_metre == folders.NUMBERS_JSON['scale']
    assert source.groundtruth is not None
    assert source.groundtruth.stamps_ns.tolist() == [500_000_000]
    (scene / 'traj.txt').unlink()
    assert open_replica(scene).groundtruth is None


BAD_CAMERAS = {
    'no json': ('{"camera": {', 'line 1'),
    'a list': ('[1, 2]', 'holds no'),
    'a list of numbers': ('{"camera": [64, 48]}', 'holds no'),
    'deep': ('[' * 20000, 'nested too deeply|Expecting'),
    'empty': ('', 'Expecting value'),
}
BAD_NUMBERS: dict[str, tuple[dict[str, object], str]] = {
    'huge': ({'w': 10**6, 'h': 10**6}, r'w, h: 1e\+06 x 1e\+06 is not an image size'),
    'negative': ({'w': -64, 'h': -48}, 'smaller than'),
    'fraction': ({'w': 64.5}, 'w, h: 64.5 x 48 is not an image size'),
    'endless': ({'w': float('inf')}, 'w, h: inf x 48 is not an image size'),
    'beyond floats': ({'fx': 10**400}, 'fx is a int, not a number'),
    'text': ({'fx': 'wide'}, "fx is 'wide', not a number"),
    'yes': ({'cy': True}, 'cy is a bool, not a number'),
    'nan': ({'cx': float('nan')}, 'not usable'),
    'no unit': ({'scale': 0}, 'scale is 0'),
}


@pytest.mark.parametrize('fault', [*BAD_CAMERAS, *BAD_NUMBERS])
def test_a_camera_file_that_is_none_is_named(scene: Path, fault: str) -> None:
    if fault in BAD_CAMERAS:
        text, reason = BAD_CAMERAS[fault]
    else:
        change, reason = BAD_NUMBERS[fault]
        text = json.dumps({'camera': {**folders.NUMBERS_JSON, **change}})
    (scene / 'cam_params.json').write_text(text)
    with pytest.raises(SourceError, match=rf'cam_params\.json: .*({reason})'):
        open_replica(scene)


@pytest.mark.parametrize('key', folders.NUMBERS_JSON)
def test_a_missing_number_of_the_camera_is_named(scene: Path, key: str) -> None:
    numbers = {name: value for name, value in folders.NUMBERS_JSON.items() if name != key}
    (scene / 'cam_params.json').write_text(json.dumps({'camera': numbers}))
    with pytest.raises(SourceError, match=rf'cam_params\.json: {key} is missing'):
        open_replica(scene)


def test_a_camera_file_too_large_to_be_one_is_not_read(scene: Path) -> None:
    with (scene / 'cam_params.json').open('wb') as file:
        file.truncate(2**40)
    with pytest.raises(SourceError, match='1099511627776 bytes'):
        open_replica(scene)


@pytest.mark.parametrize(('line', 'reason'), [('1 2 3', '3 numbers'), ('x ' * 16, "'x'")])
def test_a_bad_row_is_named(scene: Path, line: str, reason: str) -> None:
    with (scene / 'traj.txt').open('a') as file:
        file.write(line + '\n')
    with pytest.raises(SourceError, match=rf'traj\.txt:5: .*{reason}'):
        open_replica(scene)


def test_no_pair_of_images_is_told_with_numbers(scene: Path) -> None:
    for path in scene.glob('results/depth*'):
        path.unlink()
    with pytest.raises(SourceError, match=r'none of 4 colour images .* of 0 depth images'):
        open_replica(scene)
    assert not is_replica(scene.parent)
    with pytest.raises(SourceError, match='No such file'):
        open_replica(scene.parent)


@pytest.mark.parametrize('name', ['../cam_params.json', 'traj.txt'])
def test_no_mutant_of_its_files_does_harm(scene: Path, name: str) -> None:
    path = scene / name
    damaged = folders.mutants(path.read_bytes(), 500, seed=1)
    assert folders.survives(path, damaged, lambda: open_replica(scene)) < 500
