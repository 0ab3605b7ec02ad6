# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A converted sequence equals its original, and is written completely or not at all."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from running import run_into  # type: ignore[import-not-found]

from dcgs_ros.cli.arguments import OutputFormat
from dcgs_ros.cli.main import main
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.datasets.bag.source import BagSource
from dcgs_ros.datasets.bag.writing.storage import STORAGES
from dcgs_ros.datasets.custom import open_custom
from dcgs_ros.datasets.open import open_source
from dcgs_ros.datasets.options import SourceOptions
from dcgs_ros.datasets.source import Source
from dcgs_ros.datasets.synthetic.source import SyntheticSource
from dcgs_ros.datasets.tum.source import open_tum

pytest.importorskip('rosbags')

Writer = Callable[..., Path]

ROOT = Path(__file__).resolve().parents[2]
SMALL = '60,61,31.5,23.5'  # intrinsics of the 64x48 images of `tum_folder`
TIMEOUT_S = 600.0  # of a subprocess that may have to compile
FILE_LIMIT = 20_000_000  # bytes
ROOM = 'synthetic:room?frames={}&sensor=ideal'


def convert(source: object, dest: Path, *words: str) -> int:
    return main(['convert', str(source), str(dest), *words])


def same(first: Source, second: Source) -> bool:
    assert len(first) == len(second)
    for a, b in zip(first, second, strict=True):
        assert isinstance(a, RgbdFrame) and isinstance(b, RgbdFrame)
        assert (a.stamp_ns, a.depth_stamp_ns) == (b.stamp_ns, b.depth_stamp_ns)
        np.testing.assert_array_equal(a.color, b.color)
        np.testing.assert_array_equal(a.depth_m, b.depth_m)
    return (first.camera, first.sensor) == (second.camera, second.sensor)


def test_tum_to_bags_to_tum_gives_the_original(tum_folder: Writer, tmp_path: Path) -> None:
    folder = tum_folder(frames=5)
    original = open_tum(folder, SMALL)
    assert convert(folder, tmp_path / 'a', '--camera', SMALL) == 0
    assert same(original, BagSource(tmp_path / 'a'))
    assert convert(tmp_path / 'a', tmp_path / 'b.db3', '--zstd') == 0
    assert (tmp_path / 'b.db3' / 'b.db3.db3').exists()
    assert same(original, BagSource(tmp_path / 'b.db3'))
    assert convert(tmp_path / 'b.db3', tmp_path / 'c', '--format', 'tum') == 0
    assert same(original, open_custom(tmp_path / 'c'))
    assert original.groundtruth is not None
    back = open_tum(tmp_path / 'c', SMALL).groundtruth
    assert back is not None
    np.testing.assert_array_equal(back.stamps_ns, original.groundtruth.stamps_ns)


@pytest.mark.slow
def test_real_depth_survives_bit_for_bit(data_dir: Path, tmp_path: Path) -> None:
    folder, few = data_dir / 'tum_fr3_teddy_200', ('--max-frames', '4')
    assert convert(folder, tmp_path / 'a', '--camera', 'fr3', *few) == 0
    assert convert(tmp_path / 'a', tmp_path / 'b', '--format', 'tum') == 0
    original = list(zip(range(4), open_tum(folder, 'fr3'), strict=False))
    back = open_custom(tmp_path / 'b')
    for (_, a), b in zip(original, back, strict=True):
        assert isinstance(a, RgbdFrame) and isinstance(b, RgbdFrame)
        assert (a.stamp_ns, a.depth_stamp_ns) == (b.stamp_ns, b.depth_stamp_ns)
        np.testing.assert_array_equal(a.color, b.color)
        np.testing.assert_array_equal(a.depth_m, b.depth_m)


@pytest.mark.parametrize('dest', ['bag', 'out.tum'])
def test_depth_that_serves_two_colours_still_does(
    tum_folder: Writer, tmp_path: Path, dest: str
) -> None:
    folder = tum_folder(frames=4)
    rows = [f'{100 + 0.03 * k:.3f} rgb/{k}.png 100.01 depth/0.png' for k in range(3)]
    (folder / 'associations.txt').write_text('\n'.join(rows))
    assert convert(folder, tmp_path / dest, '--camera', SMALL, '--depth-per-metre', '5000') == 0
    source = open_source(str(tmp_path / dest), options=SourceOptions(sync_slop_s=0.06))
    frames = [frame for frame in source if isinstance(frame, RgbdFrame)]
    assert len(frames) == 3
    assert {frame.depth_stamp_ns // 1000 for frame in frames} == {100_010_000}


def test_the_summary_names_what_was_skipped_and_lost(
    tum_folder: Writer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tum_folder(frames=4)
    (folder / 'rgb' / '2.png').write_bytes(b'no image')
    assert convert(folder, tmp_path / 'a', '--camera', SMALL, '--compress') == 0
    out = capsys.readouterr().out
    assert re.search(r'frames +3, 0\.1 s', out)
    assert re.search(r'skipped +1\n +frame 3 of 4 \(rgb/2.png\): .*neither PNG nor JPEG', out)
    assert re.search(r'lost +nothing', out)
    assert len(BagSource(tmp_path / 'a')) == 3


def test_the_formats_are_those_of_the_writers() -> None:
    assert get_args(OutputFormat) == (*STORAGES, 'tum')


def test_wrong_arguments_are_refused_before_anything_is_read(
    tum_folder: Writer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, dest = tum_folder(), tmp_path / 'dest'
    for words, reason in (
        (('--format', 'tum', '--zstd'), 'are for a rosbag2'),
        (('--max-frames', '0'), 'at least one'),
    ):
        assert convert(folder, dest, '--camera', SMALL, *words) == 2
        assert reason in capsys.readouterr().err
    assert convert('nowhere', folder) == 2
    assert 'not empty' in capsys.readouterr().err
    assert not dest.exists()


def test_without_a_usable_frame_nothing_is_left(
    tum_folder: Writer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tum_folder(frames=3)
    for path in (folder / 'depth').iterdir():
        path.write_bytes(b'')
    for kind in ('mcap', 'sqlite3', 'tum'):
        assert convert(folder, tmp_path / 'a', '--camera', SMALL, '--format', kind) == 2
        err = capsys.readouterr().err
        assert err.startswith('dcgs: no usable frame: 3 skipped; the first: frame 1 of 3')
    assert list(tmp_path.iterdir()) == [folder]


def start(source: str, dest: Path, *words: str, limit: int | None = None) -> subprocess.Popen[str]:
    """Convert in a subprocess whose files may have at most `limit` bytes."""
    code = 'import sys, resource; from dcgs_ros.cli.main import main\n'
    if limit is not None:
        code += f'resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))\n'
    code += f'sys.exit(main({["convert", source, str(dest), *words]!r}))'
    return subprocess.Popen(
        [sys.executable, '-c', code],
        env={**os.environ, 'PYTHONPATH': str(ROOT)},
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


@pytest.mark.slow
@pytest.mark.parametrize('kind', ['mcap', 'sqlite3'])
def test_a_full_disk_leaves_nothing(tmp_path: Path, kind: str) -> None:
    dest = tmp_path / 'out' / 'a'
    process = start(ROOM.format(60), dest, '--format', kind, limit=FILE_LIMIT)
    out, err = process.communicate(timeout=TIMEOUT_S)
    assert (process.returncode, out) == (2, ''), err
    assert re.fullmatch(r'dcgs: .*a: cannot be written: .*\n', err), err
    assert list(dest.parent.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize('kind', ['mcap', 'tum'])
def test_a_signal_midway_leaves_nothing(tmp_path: Path, kind: str, number: signal.Signals) -> None:
    dest = tmp_path / 'out' / 'a'
    process = start(ROOM.format(100_000), dest, '--format', kind)
    end_s = time.monotonic() + TIMEOUT_S
    while not list(tmp_path.rglob('*.png' if kind == 'tum' else '*.mcap')):
        assert process.poll() is None and time.monotonic() < end_s
        time.sleep(0.05)
    process.send_signal(number)
    out, err = process.communicate(timeout=TIMEOUT_S)
    assert (process.returncode, out) == (128 + number, '')
    assert err == f'dcgs: stopped; {dest} is not written\n'
    assert list(dest.parent.iterdir()) == []


def test_a_synthetic_sequence_is_converted_with_its_imu(tmp_path: Path) -> None:
    address = 'synthetic:corridor?frames=5'
    assert convert(address, tmp_path / 'a') == 0
    back = BagSource(tmp_path / 'a')
    assert back.T_cam_imu is not None
    converted = list(back.imu())
    original = list(SyntheticSource.from_address(address).imu())
    assert len(converted) > 25 and set(converted) <= set(original)
    assert converted == original[original.index(converted[0]) :]


@pytest.mark.slow
def test_a_converted_sequence_gives_the_trajectory_of_its_original(tmp_path: Path) -> None:
    address = 'synthetic:room?frames=20'
    assert convert(address, tmp_path / 'a') == 0
    assert convert(tmp_path / 'a', tmp_path / 'b', '--format', 'sqlite3', '--zstd') == 0
    runs = [
        run_into(tmp_path / f'run_{k}', str(source), '--no-mapping')
        for k, source in enumerate((address, tmp_path / 'a', tmp_path / 'b'))
    ]
    assert [run.status for run in runs] == [0, 0, 0], [run.err for run in runs]
    original, *converted = [(run.folder / 'trajectory.tum').read_bytes() for run in runs]
    assert converted == [original, original]
    ates = [run.report()['ate']['rmse_cm'] for run in runs]
    np.testing.assert_allclose(ates, ates[0], rtol=1e-6)
