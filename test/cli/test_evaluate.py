# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""`dcgs evaluate` gives the scores that the run reported."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from running import (  # type: ignore[import-not-found]
    SMALL_ADDRESS,
    SMALL_FRAMES,
    SMALL_ROOM,
    WALL,
    Run,
    held_still,
    run_into,
)

from dcgs_ros.cli.main import main
from dcgs_ros.core.kernels.workers import Workers
from dcgs_ros.core.render import make_renderer
from dcgs_ros.core.trajectory import Trajectory
from dcgs_ros.datasets.open import open_source
from dcgs_ros.evaluation import scoring
from dcgs_ros.evaluation.contact_sheet import MAX_ROWS
from dcgs_ros.io.map_archive import read_map
from dcgs_ros.io.trajectory import read_tum, write_tum

PRINTED = 1e-4  # dB and shares: effect of rounding poses to nine decimals
SMALL = '60,61,31.5,23.5'  # intrinsics of the 64x48 images of `tum_folder`

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures('small_images')]


@pytest.fixture
def copy(mapped: Run, tmp_path: Path) -> Path:
    """Copy the run's folder, for tests that damage it."""
    shutil.copytree(mapped.folder, tmp_path / 'copy')
    return tmp_path / 'copy'


def found_in(folder: Path, capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    assert main(['evaluate', str(folder), '--json', *words]) == 0
    found = json.loads(capsys.readouterr().out)
    assert isinstance(found, dict)
    return found


def assert_same(found: Any, expected: Any) -> None:
    if isinstance(expected, dict):
        assert list(found) == list(expected)
        for key in expected:
            assert_same(found[key], expected[key])
    elif isinstance(expected, float):
        assert found == pytest.approx(expected, abs=PRINTED)
    else:
        assert found == expected


def test_it_finds_what_the_run_found(mapped: Run, capsys: pytest.CaptureFixture[str]) -> None:
    found, report = found_in(mapped.folder, capsys, '--render-every', '2'), mapped.report()
    assert (found['poses'], found['matched']) == (SMALL_FRAMES, SMALL_FRAMES)
    for part in ('ate', 'rpe_1s', 'rendering'):
        assert_same(found[part], report[part])


def test_every_frame_counts_by_default(mapped: Run, capsys: pytest.CaptureFixture[str]) -> None:
    rendering = found_in(mapped.folder, capsys)['rendering']
    assert rendering['views'] == SMALL_FRAMES
    keyframes = len(read_map(mapped.folder / 'map.dcgs').keyframes)
    assert rendering['keyframes']['views'] == keyframes


def test_the_table_shows_both(mapped: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['evaluate', str(mapped.folder), '--render-every', '2']) == 0
    out, report = capsys.readouterr().out, mapped.report()
    assert out.startswith(f'{mapped.folder} against {SMALL_ADDRESS}\n')
    assert f'{report["ate"]["rmse_cm"]:.2f} cm RMSE' in out
    assert f'PSNR {report["rendering"]["psnr_db"]:.2f} dB' in out


def test_rendering_can_be_left_out(mapped: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert found_in(mapped.folder, capsys, '--render-every', '0')['rendering'] is None


def test_a_run_that_only_tracked_has_an_ate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    done = run_into(tmp_path / 'run', *SMALL_ROOM, '--no-mapping', '--max-frames', '5')
    found = found_in(done.folder, capsys)
    assert found['rendering'] is None
    assert found['poses'] == 5


def test_coverage_and_silent_frames_come_from_the_frames(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ('synthetic:room?frames=40', '--no-mapping', '--set', 'cloud.stride_px=4')
    done = run_into(tmp_path / 'run', *words)
    found, path = found_in(done.folder, capsys), done.folder / 'frames.csv'
    assert found['silent_frames'] == done.report()['silent_frames'] == 0
    assert found['ate']['coverage'] == 1.0
    assert found['nees'] is None
    lines = path.read_text().splitlines()
    k = lines[0].split(',').index('sigma_translation_m')
    cells = [line.split(',') for line in lines]
    sure = [','.join([*row[:k], '1e-9', *row[k + 1 :]]) for row in cells[1:]]
    path.write_text('\n'.join([lines[0], *sure, f'40,1.9,skipped{"," * len(cells[0])}']))
    found = found_in(done.folder, capsys)
    assert found['silent_frames'] == 10  # those that end a second
    assert main(['evaluate', str(done.folder)]) == 0
    assert '10 of 10 (0 more than 10 cm off' in capsys.readouterr().out
    path.write_text(f'{lines[0]}\n0,0.1,asleep\n')
    assert main(['evaluate', str(done.folder)]) == 2
    assert f"{path}:2: 'asleep' is not a valid" in capsys.readouterr().err


def test_source_and_ground_truth_may_be_given(
    copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (copy / 'report.json').unlink()
    assert main(['evaluate', str(copy)]) == 2
    assert 'give --source' in capsys.readouterr().err
    told = found_in(copy, capsys, '--source', SMALL_ADDRESS, '--render-every', '0')
    assert told['ate']['rmse_cm'] > PRINTED
    own = str(copy / 'trajectory.tum')
    found = found_in(copy, capsys, own, '--source', SMALL_ADDRESS, '--render-every', '0')
    assert found['ate']['rmse_cm'] < PRINTED


def test_the_camera_of_the_run_is_remembered(
    tum_folder: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = str(held_still(tum_folder(name='nameless', frames=5)))
    done = run_into(tmp_path / 'run', folder, '--camera', SMALL, '--no-mapping', *WALL)
    assert (done.report()['address'], done.report()['camera']) == (folder, SMALL)
    assert found_in(done.folder, capsys)['poses'] == 5


@pytest.mark.parametrize(
    ('name', 'content', 'reason'),
    [
        ('report.json', b'{"address": ', 'report.json is not a report'),
        ('report.json', b'[1, 2]', 'report.json is not a report'),
        ('report.json', b'{"address": 7}', 'give --source'),
        ('map.dcgs', b'', 'no archive'),
        ('map.dcgs', b'PK\x03\x04' + bytes(100), 'map.dcgs'),
        ('trajectory.tum', b'# nothing\n', 'holds no pose'),
    ],
)
def test_damaged_files_are_named_in_one_line(
    copy: Path, capsys: pytest.CaptureFixture[str], name: str, content: bytes, reason: str
) -> None:
    (copy / name).write_bytes(content)
    assert main(['evaluate', str(copy)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ''
    assert reason in captured.err
    assert len(captured.err.splitlines()) == 1


def test_a_truncated_map_is_refused_wherever_it_ends(
    copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = (copy / 'map.dcgs').read_bytes()
    for share in (0.01, 0.5, 0.999):
        (copy / 'map.dcgs').write_bytes(data[: int(share * len(data))])
        assert main(['evaluate', str(copy)]) == 2
        assert str(copy / 'map.dcgs') in capsys.readouterr().err


def test_files_that_do_not_fit_together_are_refused(
    mapped: Run,
    copy: Path,
    tum_folder: Callable[..., Path],
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ['evaluate', str(copy)]
    assert main([*words, '--render-every', '-1']) == 2
    assert '--render-every -1' in capsys.readouterr().err
    assert main([*words, '--source', str(tum_folder()), '--camera', SMALL]) == 2
    assert 'images of 64x48 pixels, the map of 160x120' in capsys.readouterr().err
    late = read_tum(copy / 'trajectory.tum')
    write_tum(copy / 'trajectory.tum', Trajectory(late.stamps_ns + 1, late.T_world_cam))
    assert main(words) == 2
    assert 'none of its frames has one of 10 poses' in capsys.readouterr().err
    assert main(['evaluate', str(copy / 'trajectory.tum')]) == 2
    assert 'give GROUNDTRUTH' in capsys.readouterr().err


def test_lpips_is_of_a_few_views_evenly_spread(
    mapped: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scoring, '_LPIPS_VIEWS', 3)
    monkeypatch.setattr(scoring.Lpips, 'load', lambda: lambda image, truth: 0.5)
    saved, estimate = (
        read_map(mapped.folder / 'map.dcgs'),
        read_tum(mapped.folder / 'trajectory.tum'),
    )
    source = open_source(SMALL_ADDRESS)
    found = scoring.score_map(saved, estimate, source, 1, make_renderer(Workers(1)))
    assert [score.index for score in found.scores if score.lpips == 0.5] == [0, 4, 8]


def test_the_sheet_shows_held_out_frames_evenly_over_the_sequence() -> None:
    stamps_ns = np.arange(100, dtype=np.int64)
    trajectory = Trajectory(stamps_ns, np.tile(np.eye(4), (100, 1, 1)))
    keyframes = set(range(0, 100, 6))
    chosen = sorted(scoring._for_contact_sheet(trajectory, keyframes))
    assert len(chosen) == MAX_ROWS
    assert not keyframes & set(chosen)
    evenly = (np.arange(MAX_ROWS) + 0.5) * 100 / MAX_ROWS
    assert np.abs(np.array(chosen) - evenly).max() <= 2
    assert (
        len(scoring._for_contact_sheet(trajectory, set(range(100)))) == MAX_ROWS
    )  # there are no others
