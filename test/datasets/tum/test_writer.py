# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Written TUM folders: what is read from them is what was given."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sources import (  # type: ignore[import-not-found]
    CAMERA,
    SENSOR,
    START_NS,
    MemorySource,
    frames_of,
    same_frames,
    truth_of,
)

from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.datasets.custom import open_custom
from dcgs_ros.datasets.tum.source import open_tum
from dcgs_ros.datasets.tum.writer import write_tum_folder

HALF_STEP = 0.5 / 5000 + 1e-6  # metres
PRINTED = 1e-8  # of poses with nine decimals


def written(folder: Path, source: MemorySource) -> list[str]:
    return write_tum_folder(folder, source, iter(source.frames))


@pytest.mark.parametrize('per_metre', [1000.0, 5000.0])
def test_frames_camera_and_noise_come_back(tmp_path: Path, per_metre: float) -> None:
    frames = frames_of(4, per_metre)
    if per_metre == 1000.0:  # within 13 m
        frames = [replace(f, depth_m=np.where(f.depth_m > 13, 0, f.depth_m)) for f in frames]
    assert written(tmp_path / 'folder', MemorySource(frames)) == []
    back = open_custom(tmp_path / 'folder')
    assert same_frames(list(back), frames)  # type: ignore[arg-type]
    assert (back.camera, back.sensor) == (CAMERA, SENSOR)


def test_what_16_bits_do_not_tell_is_counted(tmp_path: Path) -> None:
    (frame,) = frames_of(1, 5000.0)
    depth_m = frame.depth_m.copy()
    depth_m[10, :3] = 1.00007, 13.107, 13.2
    depth_m[11, :2] = 20.0, 1.0
    lost = written(tmp_path / 'folder', MemorySource([replace(frame, depth_m=depth_m)]))
    assert lost == [
        'depth of 1 pixels was rounded to 0.2 mm',
        'depth of 2 pixels was beyond 13.11 m left out',
    ]
    (back,) = open_custom(tmp_path / 'folder')
    assert isinstance(back, RgbdFrame)
    assert back.depth_m[10, 2] == back.depth_m[11, 0] == 0
    error = np.abs(back.depth_m - depth_m)
    assert error[depth_m < 13.11].max() <= HALF_STEP


def test_poses_are_those_of_the_source_for_us_and_for_evo(tmp_path: Path) -> None:
    truth = truth_of(START_NS - 1_000_000_000, 3.0)
    written(tmp_path / 'fr1_folder', MemorySource(frames_of(2, 5000.0), groundtruth=truth))
    back = open_tum(tmp_path / 'fr1_folder').groundtruth
    assert back is not None
    np.testing.assert_array_equal(back.stamps_ns, truth.stamps_ns)
    np.testing.assert_allclose(back.T_world_cam, truth.T_world_cam, atol=PRINTED)
    file_interface = pytest.importorskip('evo.tools.file_interface')
    read = file_interface.read_tum_trajectory_file(tmp_path / 'fr1_folder' / 'groundtruth.txt')
    np.testing.assert_allclose(read.positions_xyz, truth.T_world_cam[:, :3, 3], atol=PRINTED)
    np.testing.assert_allclose(read.timestamps, 1e-9 * truth.stamps_ns, rtol=1e-15)
