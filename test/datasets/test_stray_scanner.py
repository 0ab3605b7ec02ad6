# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Stray Scanner's exports: colour from a video, at the pixels of the LiDAR's depth."""

from __future__ import annotations

from pathlib import Path

import cv2
import folders  # type: ignore[import-not-found]
import numpy as np
import pytest

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.datasets.open import open_source
from dcgs_ros.datasets.options import SourceOptions
from dcgs_ros.datasets.source import BadFrame, SourceError
from dcgs_ros.datasets.stray_scanner import open_stray_scanner

COLOR_SIZE, DEPTH_SIZE = (320, 240), (64, 48)
VIDEO_LOSS = 6  # of a plain image, coded
FRAMES = 4


@pytest.fixture
def export(tmp_path: Path) -> Path:
    """Write frames k = 0 ... 3 of grey 40 k, at 1 + k / 10 m, of which the left half is sure."""
    folder = tmp_path / 'scan'
    (folder / 'depth').mkdir(parents=True)
    writer = cv2.VideoWriter(
        str(folder / 'rgb.mp4'), cv2.VideoWriter.fourcc(*'mp4v'), 60, COLOR_SIZE
    )
    rows = ['timestamp, frame, x, y, z, qx, qy, qz, qw']
    sure = np.full((48, 64), 2, np.uint8)
    sure[:, 32:] = 0
    for k in range(FRAMES):
        writer.write(np.full((240, 320, 3), 40 * k, np.uint8))
        depth = np.full((48, 64), 1000 + 100 * k, np.uint16)
        folders.write_image(folder / f'depth/{k:06d}.png', depth)
        folders.write_image(folder / f'confidence/{k:06d}.png', sure)
        T = folders.pose_of(k)
        w, x, y, z = se3.to_quaternion(T)
        numbers = ', '.join(repr(float(value)) for value in (*T[:3, 3], x, y, z, w))
        rows.append(f'{7.5 + k / 60:.6f}, {k:06d}, {numbers}')
    writer.release()
    (folder / 'odometry.csv').write_text('\n'.join(rows))
    (folder / 'camera_matrix.csv').write_text('250.0, 0.0, 159.5\n0.0, 255.0, 119.5\n0, 0, 1')
    return folder


def test_frames_are_the_depth_cameras(export: Path) -> None:
    source = open_source(str(export))
    assert source.name == 'scan'
    assert source.depth_per_metre == 1000
    expected = PinholeCamera(*DEPTH_SIZE, 50.0, 51.0, 31.5, 23.5)
    np.testing.assert_allclose(source.camera.parameters, expected.parameters)
    for _ in range(2):
        frames = folders.good_frames(source)
        assert len(frames) == len(source) == FRAMES
        for k, frame in enumerate(frames):
            assert frame.stamp_ns == 7_500_000_000 + int(f'{k / 60:.6f}'[2:]) * 1000
            assert np.abs(frame.color.astype(int) - 40 * k).max() <= VIDEO_LOSS
            np.testing.assert_allclose(frame.depth_m[:, :32], 1 + 0.1 * k, rtol=1e-6)
            assert not frame.depth_m[:, 32:].any()
    assert source.groundtruth is not None
    np.testing.assert_allclose(
        source.groundtruth.T_world_cam,
        [folders.pose_of(k) for k in range(FRAMES)],
        atol=folders.POSE_TOLERANCE,
    )


def test_frames_without_depth_or_pose_are_told(export: Path) -> None:
    (export / 'depth/000001.png').unlink()
    rows = (export / 'odometry.csv').read_text().splitlines()
    stamp, number, *_ = rows[3].split(', ')
    rows[3] = ', '.join([stamp, number, *['nan'] * 7])
    rows.append(f'9.0, {FRAMES:06d}, 0, 0, 0, 0, 0, 0, 1')
    (export / 'odometry.csv').write_text('\n'.join(rows))
    source = open_stray_scanner(export, options=SourceOptions(depth_per_metre=500, rate_hz=10))
    assert 'odometry.csv:4: pose is not finite' in source.notes[0]
    first, missing, third, last, late = source
    assert isinstance(first, RgbdFrame) and isinstance(third, RgbdFrame)
    np.testing.assert_allclose(first.depth_m[:, :32], 2.0, rtol=1e-6)
    assert third.stamp_ns == 200_000_000
    assert isinstance(missing, BadFrame) and 'depth/000001.png' in missing.reason
    assert isinstance(last, RgbdFrame)
    assert isinstance(late, BadFrame) and f'rgb.mp4 ends after {FRAMES} images' in late.reason
    assert source.groundtruth is not None
    assert source.groundtruth.stamps_ns.tolist() == [0, 100_000_000, 300_000_000, 400_000_000]


@pytest.mark.slow
@pytest.mark.parametrize('name', ['odometry.csv', 'camera_matrix.csv', 'rgb.mp4'])
def test_no_mutant_of_its_files_does_harm(export: Path, name: str) -> None:
    damaged = folders.mutants((export / name).read_bytes(), 100, seed=5)
    folders.survives(export / name, damaged, lambda: open_stray_scanner(export))


@pytest.mark.parametrize(
    ('name', 'text', 'reason'),
    [
        ('rgb.mp4', 'no video', 'cannot be read as a video'),
        ('odometry.csv', 'timestamp, frame\n', 'holds no frame'),
        ('odometry.csv', '1.0, x, 0\n', r'odometry\.csv:1'),
        ('camera_matrix.csv', '1, 2', '2 numbers, not the 16'),
        ('camera_matrix.csv', '250, 0, 900, 0, 255, 119, 0, 0, 1', 'outside of its 64x48'),
    ],
)
def test_what_is_wrong_is_named(export: Path, name: str, text: str, reason: str) -> None:
    (export / name).write_text(text)
    with pytest.raises(SourceError, match=reason):
        open_source(str(export))
