# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""`dcgs info` describes the files that were written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from running import lines_of  # type: ignore[import-not-found]

from dcgs_ros.cli.main import main

Writer = Callable[..., Path]


def test_a_dataset_is_described(tum_folder: Writer, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tum_folder(frames=5)
    (folder / 'depth' / '2.png').write_bytes(b'no image')
    assert main(['info', str(folder), '--camera', '60,61,31.5,23.5']) == 0
    lines = lines_of(capsys.readouterr().out)
    assert lines['frames'].startswith('5;')
    assert lines['rate'] == '33.3 Hz; longest gap 60 ms'
    assert lines['duration'].startswith('about 0.1 s')
    assert lines['depth stamp'].startswith('+5.0 ms')
    assert lines['camera'].startswith('64x48; fx 60 fy 61 cx 31.5 cy 23.5; no distortion')
    assert lines['depth unit'].startswith('5000 per metre')
    assert 'warning' not in lines and 'note' not in lines
    assert lines['depth'].startswith('100 % of the pixels, 100 %')
    assert lines['depth range'].startswith('1.00 to 1.40 m')
    assert lines['ground truth'] == '5 poses, 0.1 s, 0.00 m'
    assert lines['bad frames'] == '1 in the sample'
    assert any(label.startswith('frame 3 of 5') for label in lines)


@pytest.mark.slow
def test_a_synthetic_sequence_and_one_without_anything_usable(
    tum_folder: Writer, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(['info', 'synthetic:plane?frames=1&sensor=ideal']) == 0
    lines = lines_of(capsys.readouterr().out)
    assert 'rate' not in lines
    assert lines['ground truth'].startswith('1 poses, 0.0 s')
    folder = tum_folder(frames=2)
    for path in (folder / 'depth').iterdir():
        path.unlink()
    assert main(['info', str(folder), '--camera', '60,61,31.5,23.5']) == 0
    lines = lines_of(capsys.readouterr().out)
    assert lines['bad frames'] == '2 in the sample'
    assert 'depth' not in lines


def test_a_recording_is_described_with_its_chosen_topics(
    tum_folder: Writer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip('rosbags')
    bag = str(tmp_path / 'bag')
    assert main(['convert', str(tum_folder(frames=5)), bag, '--camera', '60,61,31.5,23.5']) == 0
    capsys.readouterr()
    assert main(['info', bag]) == 0
    lines = lines_of(capsys.readouterr().out)
    color, depth = lines['topics'].split(', ')
    assert color == '/camera/camera/color/image_raw'
    assert depth == '/camera/camera/aligned_depth_to_color/image_raw'
    assert lines['registered'] == 'as recorded'
    assert lines['imu'] == 'none'


def test_sensors_beside_the_camera_are_shown(capsys: pytest.CaptureFixture[str]) -> None:
    """Those of which it is known where they are: a camera in a hand is on no base."""
    assert main(['info', 'synthetic:plane?frames=2']) == 0
    lines = lines_of(capsys.readouterr().out)
    assert lines['imu'] == 'for --set priors.gyro=true'
    assert 'not known where' in lines['odometry']
