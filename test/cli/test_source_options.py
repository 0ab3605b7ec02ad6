# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Depth unit, pairing and stamps through the CLI: what is wrong is said, or repaired too."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bags import (  # type: ignore[import-not-found]
    CAMERA,
    COLOR,
    DEPTH,
    Entry,
    color_of,
    depth_of,
    image_entry,
    info_entry,
    recording,
    write_bag,
)
from numpy.typing import NDArray
from running import WALL, Run, held_still, lines_of, run_into  # type: ignore[import-not-found]

from dcgs_ros.cli.main import main
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.datasets.bag.writing.frame_encoder import encode_image
from dcgs_ros.datasets.open import open_source

Writer = Callable[..., Path]
SMALL = ('--camera', '60,61,31.5,23.5')  # of the 64x48 images of `tum_folder`
FRAMES = 24
START_NS = 10**18
STEP_NS = 33_000_000
HOUR_NS = 3_600_000_000_000


def info_of(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, str]:
    capsys.readouterr()
    assert main(['info', *words]) == 0
    found: dict[str, str] = lines_of(capsys.readouterr().out)
    return found


def wall_bag(path: Path, stamps_ns: list[int], depth: NDArray[np.generic], encoding: str) -> Path:
    """Record a camera before a wall."""
    entries: list[Entry] = []
    for k, stamp_ns in enumerate(stamps_ns):
        entries += [
            info_entry(stamp_ns, CAMERA),
            image_entry(COLOR, stamp_ns, 'rgb8', color_of(k)),
            image_entry(DEPTH, stamp_ns, encoding, depth),
        ]
    entries = [e._replace(recorded_ns=START_NS + k) for k, e in enumerate(entries)]
    return write_bag(path, entries)


def track(folder: Path, *words: str) -> Run:
    done: Run = run_into(folder, *words, '--no-mapping', *WALL)
    return done


UNITS = {
    'millimetres': (1550, '16UC1', 1000.0),
    'an L515': (6200, '16UC1', 4000.0),
    'floats in millimetres': (1550.0, '32FC1', 1000.0),
    'floats in metres': (1.55, '32FC1', 1.0),
}


@pytest.mark.parametrize('kind', UNITS)
def test_the_unit_of_a_recording_is_shown_and_can_be_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    value, encoding, unit = UNITS[kind]
    pixels = np.full((48, 64), value, np.uint16 if encoding == '16UC1' else np.float32)
    bag = str(wall_bag(tmp_path / 'bag', STAMPS_NS[:3], pixels, encoding))
    stored = 1.0 if encoding == '32FC1' else 1000.0
    lines = info_of(capsys, bag)
    assert lines['depth unit'].startswith(f'{stored:g} per metre')
    assert ('warning' in lines) == (unit != stored)
    if unit != stored:
        assert lines['warning'].startswith("0% of the depth lies in the sensor's range")
        assert 'With --depth-per-metre' in lines['warning']
    for words in ((bag, '--depth-per-metre', f'{unit:g}'), (f'{bag}?depth_per_metre={unit:g}',)):
        lines = info_of(capsys, *words)
        assert lines['depth unit'].startswith(f'{unit:g} per metre')
        assert 'warning' not in lines
        assert lines['depth range'].endswith('median 1.55')


@pytest.mark.parametrize(('near', 'warned'), [(0.1, False), (0.5, True)])
def test_depth_nearer_than_the_sensor_measures_is_warned_of(
    tum_folder: Writer, capsys: pytest.CaptureFixture[str], near: float, warned: bool
) -> None:
    """Millimetres read as TUM's unit: the far half of a room is still in the range."""
    folder = tum_folder(frames=1)
    depth_mm = np.full((48, 64), 2000, np.uint16)
    depth_mm.flat[: int(near * depth_mm.size)] = 1000
    (folder / 'depth' / '0.png').write_bytes(encode_image('.png', depth_mm))
    lines = info_of(capsys, str(folder), *SMALL)
    assert ('warning' in lines) == warned
    if warned:
        assert '50% is nearer; the median is' in lines['warning']
        assert lines['warning'].endswith('With --depth-per-metre 1000 it would be 100%')


@pytest.mark.slow
def test_the_unit_of_a_folder_is_shown_warned_of_and_in_the_report(
    tum_folder: Writer, tmp_path: Path
) -> None:
    folder = str(held_still(tum_folder(frames=6)))
    right = track(tmp_path / 'right', folder, *SMALL)
    assert (right.report()['depth_per_metre'], right.report()['depth_in_range']) == (5000, 1)
    assert right.report()['warnings'] == []
    unit = ('--depth-per-metre', '25000')
    wrong = track(tmp_path / 'wrong', f'{folder}?depth_per_metre=5000', *SMALL, *unit)
    report = wrong.report()
    assert (report['depth_per_metre'], report['depth_in_range']) == (25000, 0)
    (warning,) = report['warnings']
    assert '100% is nearer; the median is 0.2 m at 25000 per metre' in warning
    assert f'dcgs: warning: {warning}' in wrong.err.splitlines()
    assert warning in wrong.out


@pytest.mark.slow
def test_a_report_names_the_options_for_those_who_read_the_source_again(
    tum_folder: Writer, tmp_path: Path
) -> None:
    folder = str(held_still(tum_folder(frames=6)))
    done = track(tmp_path / 'run', folder, *SMALL, '--depth-per-metre', '4000', '--rate-hz', '20')
    again = open_source(done.report()['address'], done.report()['camera'])
    assert again.depth_per_metre == 4000
    stamps_ns = [frame.stamp_ns for frame in again]  # type: ignore[union-attr]
    assert stamps_ns == [50_000_000 * k for k in range(6)]


@pytest.mark.slow
def test_motion_that_contradicts_the_unit_is_told(tum_folder: Writer, tmp_path: Path) -> None:
    """Depth of a camera that nears a wall, at a quarter of its true scale."""
    folder = approach(tum_folder(frames=10))
    done = track(
        tmp_path / 'run',
        str(folder),
        *SMALL,
        '--depth-per-metre',
        '20000',
        '--set',
        'sensor.depth_min_m=0.1',
    )
    (warning,) = done.report()['warnings']
    assert re.search('the true motion is (3.9|4.0).* times as large', warning)
    assert warning.endswith('Try --depth-per-metre 5000')
    right = track(tmp_path / 'right', str(folder), *SMALL)
    assert right.report()['warnings'] == []


def approach(folder: Path) -> Path:
    """Let `tum_folder`'s walls, which recede by 10 cm a frame, be seen from as far behind."""
    rows = [f'{100 + 0.03 * k:.3f} 0 0 {-0.1 * k:.3f} 0 0 0 1' for k in range(10)]
    (folder / 'groundtruth.txt').write_text('\n'.join(rows))
    return folder


def damaged(stamps_ns: list[int], fault: str) -> list[int]:
    if fault == 'an hour ahead':
        return [*stamps_ns[:9], stamps_ns[9] + HOUR_NS, *stamps_ns[10:]]
    return [*stamps_ns[:12], *(stamp_ns - 10 * 10**9 for stamp_ns in stamps_ns[12:])]


def rewrite(folder: Path, stamps_ns: list[int]) -> Path:
    """Write the index files of `tum_folder` again."""
    for kind in ('rgb', 'depth'):
        rows = (f'{stamp_ns / 1e9:.9f} {kind}/{k}.png' for k, stamp_ns in enumerate(stamps_ns))
        (folder / f'{kind}.txt').write_text('\n'.join(rows))
    return folder


WALL_MM = np.full((48, 64), 1000, np.uint16)
STAMPS_NS = [100 * 10**9 + k * STEP_NS for k in range(FRAMES)]


def still(tum_folder: Writer, tmp_path: Path, kind: str, stamps_ns: list[int]) -> list[str]:
    """Write a camera before a wall, with these stamps; return the words for its source."""
    if kind == 'folder':
        folder = held_still(tum_folder(frames=len(stamps_ns)))
        return [str(rewrite(folder, stamps_ns)), *SMALL]
    return [str(wall_bag(tmp_path / 'bag', stamps_ns, WALL_MM, '16UC1'))]


@pytest.mark.parametrize('fault', ['an hour ahead', 'set back'])
@pytest.mark.parametrize('kind', ['folder', 'bag'])
def test_stamps_are_repaired_and_it_is_said(
    tum_folder: Writer,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    kind: str,
    fault: str,
) -> None:
    words = still(tum_folder, tmp_path, kind, damaged(STAMPS_NS, fault))
    left_out = fault == 'an hour ahead'
    lines = info_of(capsys, *words)
    assert lines['frames'].startswith(f'{FRAMES - left_out};')
    assert lines['rate'] == f'30.3 Hz; longest gap {66 if left_out else 33} ms'
    expected = f'1 of {FRAMES} images are left out' if left_out else 'set back by 9.967 s at'
    assert expected in lines['note']
    frames = [
        item
        for item in open_source(words[0], words[2] if words[1:] else None)
        if isinstance(item, RgbdFrame)
    ]
    assert [frame.depth_stamp_ns - frame.stamp_ns for frame in frames] == [0] * len(frames)
    assert [frame.color[0, 0, 0] for frame in frames] == [
        color[0, 0, 0]
        for k in range(FRAMES)
        if not (left_out and k == 9)
        for color in [color_of(k) if kind == 'bag' else np.full((1, 1, 3), 10 * k)]
    ]


@pytest.mark.slow
@pytest.mark.parametrize('fault', ['an hour ahead', 'set back'])
def test_a_run_with_repaired_stamps_tracks_all(
    tum_folder: Writer, tmp_path: Path, fault: str
) -> None:
    done = track(tmp_path / 'run', *still(tum_folder, tmp_path, 'bag', damaged(STAMPS_NS, fault)))
    assert done.status == 0, done.err
    report = done.report()
    assert report['frames'] == report['tracked'] >= FRAMES - 1
    assert len(report['warnings']) == 2  # of colour, of depth
    assert all(f'dcgs: warning: {note}' in done.err for note in report['warnings'])


@pytest.mark.slow
@pytest.mark.parametrize('kind', ['folder', 'bag'])
def test_missing_stamps_need_a_rate(tum_folder: Writer, tmp_path: Path, kind: str) -> None:
    words = still(tum_folder, tmp_path, kind, [0] * 9)
    refused = track(tmp_path / 'refused', *words)
    assert refused.status == 2
    assert '9 images have 1 different stamps, 9 of them 0.000000000 s' in refused.err
    assert '--rate-hz 30' in refused.err
    done = track(tmp_path / 'run', *words, '--rate-hz', '30')
    assert done.status == 0, done.err
    assert done.report()['tracked'] == 9
    assert done.frames()[8]['stamp'] == '0.266666667'


def test_images_with_one_stamp_are_told_apart_by_their_order(tmp_path: Path) -> None:
    bag = wall_bag(tmp_path / 'bag', [0] * 4, WALL_MM, '16UC1')
    frames = [item for item in open_source(f'{bag}?rate_hz=10') if isinstance(item, RgbdFrame)]
    assert [frame.stamp_ns for frame in frames] == [k * 10**8 for k in range(4)]
    for k, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.color, color_of(k))


def test_the_rate_pairs_images_by_order_and_says_where_some_are_missing(tmp_path: Path) -> None:
    entries = list(recording(4))
    bag = str(write_bag(tmp_path / 'bag', [e for k, e in enumerate(entries) if k != 9]))
    source = open_source(f'{bag}?rate_hz=10')
    frames = list(source)
    assert [frame.stamp_ns for frame in frames] == [0, 10**8, 2 * 10**8]  # type: ignore[union-attr]
    np.testing.assert_array_equal(frames[2].depth_m, depth_of(2) / np.float32(1000))  # type: ignore[union-attr]
    assert '4 colour and 3 depth images, paired by order' in source.notes[0]


@pytest.mark.parametrize('lag_ms', [35, 45])
def test_the_slop_follows_the_rate_and_can_be_told(
    tum_folder: Writer, lag_ms: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """At 10 Hz the nearest image is up to 50 ms away, at 33 Hz it is another's."""
    folder = tum_folder(frames=4, interval_s=0.1)
    depth = (folder / 'depth.txt').read_text().replace('05000 ', f'{lag_ms:02d}000 ')
    (folder / 'depth.txt').write_text(depth)
    lines = info_of(capsys, str(folder), *SMALL)
    assert lines['depth stamp'].startswith(f'+{lag_ms}.0 ms')
    assert main(['info', str(folder), *SMALL, '--sync-slop-s', '0.02']) == 2
    error = capsys.readouterr().err
    assert 'none of 4 colour images has a depth image within 20 ms' in error
    assert f'--sync-slop-s {(lag_ms + 1) / 1e3:g} or more pairs some' in error


def test_images_without_a_partner_are_counted(
    tum_folder: Writer, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tum_folder(frames=6)
    rows = (folder / 'depth.txt').read_text().splitlines()
    (folder / 'depth.txt').write_text('\n'.join(rows[:4]))
    lines = info_of(capsys, str(folder), *SMALL)
    assert lines['note'].startswith('2 of 6 colour images have no depth image of their own')


def test_a_synthetic_source_takes_no_options(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['info', 'synthetic:room', '--rate-hz', '10']) == 2
    assert 'its own camera, depth, stamps' in capsys.readouterr().err
