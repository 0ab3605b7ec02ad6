# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""7-Scenes folders: depth and truth of the depth camera become the colour camera's."""

from __future__ import annotations

from pathlib import Path

import folders  # type: ignore[import-not-found]
import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.datasets.camera_presets import PRESETS
from dcgs_ros.datasets.images.indexed_frames import stamp_of_index
from dcgs_ros.datasets.options import SourceOptions
from dcgs_ros.datasets.seven_scenes import DEPTH_CAMERA, is_seven_scenes, open_seven_scenes
from dcgs_ros.datasets.source import BadFrame, SourceError

FLOAT32_STEP = 1e-6  # metres, at a few metres
BASELINE_M = 0.025
EDGE_PX = 1.0  # depth is drawn to whole pixels


def wall(depth_mm: int) -> NDArray[np.uint16]:
    return np.full((480, 640), depth_mm, np.uint16)


def test_a_wall_stays_as_far_away(tmp_path: Path) -> None:
    folder = folders.write_seven_scenes(tmp_path / 'seq-01', [wall(1000), wall(2500)])
    assert is_seven_scenes(folder)
    source = open_seven_scenes(folder)
    assert source.camera == PRESETS['7scenes'].camera
    assert source.sensor == PRESETS['7scenes'].sensor
    for k, frame in enumerate(folders.good_frames(source)):
        assert frame.stamp_ns == stamp_of_index(k)
        np.testing.assert_array_equal(frame.color, folders.color_of(k, (640, 480)))
        seen = frame.depth_m[frame.depth_m > 0]
        np.testing.assert_allclose(seen, (1.0, 2.5)[k], atol=FLOAT32_STEP)


def test_color_may_be_jpeg_and_the_unit_another(tmp_path: Path) -> None:
    folder = folders.write_seven_scenes(tmp_path / 'seq-01', [wall(1000), wall(65535)])
    for path in folder.glob('*.color.png'):
        folders.write_image(path.with_suffix('.jpg'), folders.color_of(3, (640, 480)))
        path.unlink()
    assert is_seven_scenes(folder)
    source = open_seven_scenes(folder, options=SourceOptions(depth_per_metre=500, rate_hz=10))
    frame, nothing = source
    assert isinstance(frame, RgbdFrame)
    np.testing.assert_allclose(frame.depth_m[frame.depth_m > 0], 2.0, atol=FLOAT32_STEP)
    assert isinstance(nothing, BadFrame)  # 65535 is no depth, whatever the unit
    assert source.groundtruth is not None
    assert source.groundtruth.stamps_ns.tolist() == [0, 100_000_000]


def test_an_edge_is_seen_by_the_color_camera_where_it_stands(tmp_path: Path) -> None:
    z, column = 1.5, 400  # left of the column, there is a board; right of it nothing
    depth_mm = wall(1500)
    depth_mm[:, column:] = 65535
    (frame,) = folders.good_frames(
        open_seven_scenes(folders.write_seven_scenes(tmp_path / 'seq-01', [depth_mm]))
    )
    x_m = (column - 0.5 - DEPTH_CAMERA.cx) / DEPTH_CAMERA.fx * z
    camera = PRESETS['7scenes'].camera
    expected = camera.fx * (x_m - BASELINE_M) / z + camera.cx
    last = np.flatnonzero(frame.depth_m[240] > 0)[-1]
    assert abs(last + 0.5 - expected) <= EDGE_PX
    assert frame.depth_m.max() < z + FLOAT32_STEP


def test_a_point_has_one_place_in_the_world_for_both_cameras(tmp_path: Path) -> None:
    folder = folders.write_seven_scenes(tmp_path / 'seq-01', [wall(1000)] * 3)
    truth = open_seven_scenes(folder).groundtruth
    assert truth is not None
    p_depth = np.array([0.3, -0.2, 1.7, 1])
    p_color = p_depth - [BASELINE_M, 0, 0, 0]
    for k, T_world_color in enumerate(truth.T_world_cam):
        np.testing.assert_allclose(
            T_world_color @ p_color, folders.pose_of(k) @ p_depth, atol=folders.POSE_TOLERANCE
        )


@pytest.mark.parametrize(
    'text', [None, '', 'nan ' * 16, '-inf ' * 16, '1 2 3', '\0\xff', '2 ' * 16]
)
def test_a_missing_or_invalid_pose_is_left_out(tmp_path: Path, text: str | None) -> None:
    folder = folders.write_seven_scenes(tmp_path / 'seq-01', [wall(1000)] * 3)
    pose = folder / 'frame-000001.pose.txt'
    if text is None:
        pose.unlink()
    else:
        pose.write_text(text)
    source = open_seven_scenes(folder)
    assert source.groundtruth is not None
    assert source.groundtruth.stamps_ns.tolist() == [stamp_of_index(0), stamp_of_index(2)]
    assert len(source) == 3


def test_poses_are_optional_but_not_all_of_them_wrong(tmp_path: Path) -> None:
    folder = folders.write_seven_scenes(tmp_path / 'seq-01', [wall(1000)] * 2)
    for path in folder.glob('*.pose.txt'):
        path.write_text('nan ' * 16)
    with pytest.raises(SourceError, match='none of 2 poses'):
        open_seven_scenes(folder)
    for path in folder.glob('*.pose.txt'):
        path.unlink()
    assert open_seven_scenes(folder).groundtruth is None


def test_nothing_but_missing_depth_is_a_bad_frame(tmp_path: Path) -> None:
    small = np.full((48, 64), 1000, np.uint16)
    folder = folders.write_seven_scenes(tmp_path / 'seq-01', [wall(65535), small])
    empty, wrong = open_seven_scenes(folder)
    assert isinstance(empty, BadFrame)
    assert 'zero everywhere' in empty.reason
    assert isinstance(wrong, BadFrame)
    assert '64x48' in wrong.reason


def test_intrinsics_are_those_of_color(tmp_path: Path) -> None:
    folder = folders.write_seven_scenes(tmp_path / 'seq-01', [wall(1000)])
    source = open_seven_scenes(folder, '600,600,320,240')
    (frame,) = folders.good_frames(source)
    assert source.camera.fx == 600.0
    assert frame.depth_m.shape == (480, 640)


def test_other_folders_are_none_of_it(tmp_path: Path) -> None:
    assert not is_seven_scenes(tmp_path)
    assert not is_seven_scenes(tmp_path / 'nowhere')
    with pytest.raises(SourceError, match='none of 0 colour images'):
        open_seven_scenes(tmp_path)
