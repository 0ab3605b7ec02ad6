# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""`dcgs grid`: the occupancy grid of a map file."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from running import Run  # type: ignore[import-not-found]

from dcgs_ros.cli.main import main

HELD = ['--camera-height', '1.28', '--camera-pitch', '-17']  # the synthetic room's first view
FREE, UNKNOWN, OCCUPIED = 254, 205, 0


def test_grid_of_a_run_has_the_room_before_the_camera(
    mapped: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Free floor, and desks and walls; settings are those of the mapper's `grid`."""
    dest = tmp_path / 'room.yaml'
    assert main(['grid', str(mapped.folder / 'map.dcgs'), str(dest), *HELD]) == 0
    assert str(dest) in capsys.readouterr().out
    shades = cv2.imread(str(tmp_path / 'room.pgm'), cv2.IMREAD_UNCHANGED)
    assert set(np.unique(shades)) == {OCCUPIED, UNKNOWN, FREE}
    coarse = tmp_path / 'coarse.yaml'
    words = [str(mapped.folder / 'map.dcgs'), str(coarse), *HELD, '--set', 'resolution_m=0.1']
    assert main(['grid', *words]) == 0
    assert 'resolution: 0.1\n' in coarse.read_text()


@pytest.mark.parametrize(
    ('dest', 'words', 'reason'),
    [
        ('room.png', HELD, 'a .yaml file'),
        ('used.yaml', HELD, 'exists'),
        ('room.yaml', ['--set', 'min_height_m=50', 'max_height_m=51'], '--camera-height'),
        ('room.yaml', [*HELD, '--set', 'resolution_m'], 'not FIELD=VALUE'),
        ('room.yaml', [*HELD, '--set', 'cells=1'], 'unknown setting'),
    ],
)
def test_what_cannot_be_done_is_said_and_nothing_written(
    mapped: Run,
    tmp_path: Path,
    dest: str,
    words: list[str],
    reason: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """In one line, with status 2."""
    (tmp_path / 'used.pgm').write_text('mine')
    assert main(['grid', str(mapped.folder / 'map.dcgs'), str(tmp_path / dest), *words]) == 2
    assert reason in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ['used.pgm']
