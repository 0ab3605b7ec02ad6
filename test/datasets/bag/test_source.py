# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Recordings are read as they were recorded, or the error names what does not fit."""

from __future__ import annotations

import gc
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rosbags')

from bags import (  # type: ignore[import-not-found]
    CAMERA,
    COLOR,
    DEPTH,
    DEPTH_LAG_NS,
    INFO,
    INTERVAL_NS,
    MCAP,
    SQLITE,
    START_NS,
    Entry,
    color_of,
    depth_entry,
    depth_of,
    image_entry,
    info_entry,
    recording,
    write_bag,
)

from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.trajectory import Trajectory
from dcgs_ros.datasets.bag.source import BagSource
from dcgs_ros.datasets.camera_presets import PRESETS
from dcgs_ros.datasets.open import open_source
from dcgs_ros.datasets.source import BadFrame, SourceError
from dcgs_ros.io.trajectory import write_tum

FRAMES = 5
CUT_FRAMES = 180  # of 16 KB: chunks of an mcap have a megabyte
SQLITE_PAGE = 4096
FLAT_FRAMES = 40  # of the 300 more; stamps and places of all are kept

Bag = Callable[..., Path]


@pytest.fixture
def bag(tmp_path: Path) -> Bag:
    """Return a function that writes a recording: `recording(FRAMES)`, or given entries."""

    def write(entries: list[Entry] | None = None, name: str = 'bag', plugin: int = MCAP) -> Path:
        entries = list(recording(FRAMES)) if entries is None else entries
        return write_bag(tmp_path / name, entries, plugin)

    return write


def frames_of(source: BagSource) -> list[RgbdFrame]:
    frames = [item for item in source if isinstance(item, RgbdFrame)]
    assert len(frames) == len(source)
    return frames


def stamps_of(source: BagSource) -> list[int]:
    return [frame.stamp_ns for frame in frames_of(source)]


@pytest.mark.parametrize('plugin', [MCAP, SQLITE])
@pytest.mark.parametrize('alone', [False, True])
def test_what_was_recorded_is_read(bag: Bag, plugin: int, alone: bool) -> None:
    path = bag(plugin=plugin)
    if alone:
        (path,) = [file for file in path.iterdir() if file.suffix in ('.mcap', '.db3')]
    source = open_source(str(path))
    assert isinstance(source, BagSource)
    assert source.name == path.name
    assert source.camera == CAMERA
    assert source.groundtruth is None
    for _ in range(2):  # a source begins anew each time
        for k, frame in enumerate(frames_of(source)):
            assert frame.stamp_ns == START_NS + k * INTERVAL_NS
            assert frame.depth_stamp_ns == frame.stamp_ns + DEPTH_LAG_NS
            np.testing.assert_array_equal(frame.color, color_of(k))
            np.testing.assert_array_equal(frame.depth_m, depth_of(k) / np.float32(1000))


def test_images_without_a_partner_are_left_out(bag: Bag) -> None:
    entries = list(recording(6))
    without_depth = [e for e in entries if e not in (entries[3], entries[8])]
    source = BagSource(bag(without_depth))
    assert stamps_of(source) == [START_NS + k * INTERVAL_NS for k in (0, 3, 4, 5)]


def test_pairs_do_not_depend_on_when_messages_were_recorded(bag: Bag) -> None:
    rng = np.random.default_rng(1)
    expected = stamps_of(BagSource(bag()))
    late = [
        e._replace(recorded_ns=e.recorded_ns + int(rng.integers(50_000_000))) for e in recording(5)
    ]
    shuffled = sorted(late, key=lambda entry: entry.recorded_ns)
    assert stamps_of(BagSource(bag(shuffled, 'late'))) == expected
    apart = sorted(recording(5), key=lambda entry: entry.topic)
    assert stamps_of(BagSource(bag(apart, 'apart', SQLITE))) == expected


def test_a_message_recorded_twice_is_one(bag: Bag) -> None:
    entries = [entry for entry in recording(3) for _ in range(2)]
    assert stamps_of(BagSource(bag(entries))) == [START_NS + k * INTERVAL_NS for k in range(3)]


def test_a_broken_image_is_a_bad_frame_among_good_ones(bag: Bag) -> None:
    entries = list(recording(5))
    stamp = START_NS + INTERVAL_NS
    entries[5] = image_entry(COLOR, stamp, 'yuv411', color_of(1))
    entries[8] = entries[8]._replace(cdr=entries[8].cdr[:500])
    entries[9] = depth_entry(START_NS + 3 * INTERVAL_NS, np.zeros((48, 64), np.uint16))
    entries[12] = depth_entry(START_NS + 4 * INTERVAL_NS, np.ones((24, 32), np.uint16))
    source = BagSource(bag(entries))
    items = list(source)
    assert [type(item) for item in items] == [RgbdFrame] + 4 * [BadFrame]
    bad = [item for item in items if isinstance(item, BadFrame)]
    assert bad[0].name == 'frame 2 of 5 (colour at 1700000000.033333333 s)'
    reasons = ['yuv411', 'sequence length', 'zero everywhere', '32x24']
    for item, reason in zip(bad, reasons, strict=True):
        assert reason in item.reason


def test_without_camera_info_the_camera_has_to_be_given(bag: Bag) -> None:
    path = bag([entry for entry in recording(2) if entry.topic != INFO])
    with pytest.raises(SourceError, match=f'no CameraInfo beside {COLOR}; give --camera'):
        BagSource(path)
    source = open_source(str(path), camera='60,61,32,24')
    assert (source.camera.width, source.camera.height, source.camera.fy) == (64, 48, 61)
    assert source.sensor == PRESETS['d435i'].sensor
    assert BagSource(path, 'fr1').sensor == PRESETS['fr1'].sensor
    assert BagSource(path, 'fr1').camera == PRESETS['fr1'].camera


def test_a_camera_that_is_none_is_refused(bag: Bag) -> None:
    entries = [entry for entry in recording(1) if entry.topic != INFO]
    broken = info_entry(START_NS, CAMERA)
    nan = np.array([np.nan]).tobytes()
    at = broken.cdr.index(np.array([CAMERA.fx]).tobytes())
    broken = broken._replace(cdr=broken.cdr[:at] + nan + broken.cdr[at + 8 :])
    with pytest.raises(SourceError, match=r'camera_info can be used: intrinsics.*give --camera'):
        BagSource(bag([*entries, broken]))


def test_ground_truth_is_a_file_beside_it(bag: Bag, tmp_path: Path) -> None:
    truth = Trajectory(np.array([START_NS]), np.eye(4)[None])
    write_tum(tmp_path / 'truth.txt', truth)
    source = BagSource(bag(), groundtruth=tmp_path / 'truth.txt')
    assert source.groundtruth is not None
    assert list(source.groundtruth.stamps_ns) == [START_NS]


def test_stamps_that_do_not_fit_are_told(bag: Bag) -> None:
    apart = [entry for entry in recording(2) if entry.topic != DEPTH]
    apart.append(depth_entry(START_NS + 5_000_000_000, depth_of(0)))
    with pytest.raises(SourceError, match=r'none of 2 colour.*20 ms: colour 1700000000\.0+ to'):
        BagSource(bag(apart, 'apart'))


@pytest.mark.parametrize('plugin', [MCAP, SQLITE])
def test_of_a_damaged_recording_the_good_part_is_read(bag: Bag, plugin: int) -> None:
    folder = bag(list(recording(CUT_FRAMES)), plugin=plugin)
    (file,) = [file for file in folder.iterdir() if file.suffix != '.yaml']
    whole = file.read_bytes()
    file.write_bytes(whole[: int(0.8 * len(whole)) // SQLITE_PAGE * SQLITE_PAGE])
    source = BagSource(folder)
    *frames, end = source
    assert len(frames) + 1 == len(source)
    assert CUT_FRAMES // 3 < len(frames) < CUT_FRAMES
    for k, frame in enumerate(frames):
        assert isinstance(frame, RgbdFrame)
        np.testing.assert_array_equal(frame.color, color_of(k))
        np.testing.assert_array_equal(frame.depth_m, depth_of(k) / np.float32(1000))
    assert isinstance(end, BadFrame)
    assert end.name == 'end of the recording' and str(folder) in end.reason


@pytest.mark.parametrize('plugin', [MCAP, SQLITE])
@pytest.mark.parametrize('size', [0, 7, 100])
def test_where_nothing_is_left_one_error_says_so(bag: Bag, plugin: int, size: int) -> None:
    folder = bag(plugin=plugin)
    (file,) = [file for file in folder.iterdir() if file.suffix != '.yaml']
    file.write_bytes(file.read_bytes()[:size])
    with pytest.raises(SourceError, match=str(folder)):
        BagSource(folder)


def test_a_message_without_a_header_is_lost_and_told(bag: Bag) -> None:
    entries = list(recording(3))
    entries[5] = entries[5]._replace(cdr=entries[5].cdr[:10])
    *frames, lost = BagSource(bag(entries))
    assert [frame.stamp_ns for frame in frames if isinstance(frame, RgbdFrame)] == [
        START_NS,
        START_NS + 2 * INTERVAL_NS,
    ]
    assert isinstance(lost, BadFrame) and lost.name.endswith(f'({COLOR})')
    assert '10 bytes do not begin with a header' in lost.reason


def test_an_image_that_comes_too_late_is_left_out_and_nothing_else(
    bag: Bag, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr('dcgs_ros.datasets.bag.source._MAX_WAITING', 4)
    entries = list(recording(12))
    late = [entries[2]._replace(recorded_ns=entries[-1].recorded_ns + 1)]
    items = list(BagSource(bag([*entries[:2], *entries[3:], *late])))
    assert [type(item) for item in items] == [BadFrame, *11 * [RgbdFrame]]
    assert 'more than 4 images late' in items[0].reason  # type: ignore[union-attr]


@pytest.mark.slow
@pytest.mark.parametrize('apart', [False, True])
def test_memory_does_not_grow_with_the_recording(bag: Bag, apart: bool) -> None:
    def peak(path: Path) -> float:
        source = BagSource(path)
        gc.collect()
        tracemalloc.start()
        for _ in source:
            pass
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    def entries(frames: int) -> list[Entry]:
        whole = list(recording(frames))
        return sorted(whole, key=lambda entry: entry.topic) if apart else whole

    short, long = (bag(entries(n), f'of{n}', SQLITE) for n in (100, 400))
    peak(short)  # what is imported and cached at the first time
    assert peak(long) - peak(short) < FLAT_FRAMES * (color_of(0).nbytes + depth_of(0).nbytes)


@pytest.mark.slow
def test_without_rosbags_it_is_said_what_to_install(bag: Bag) -> None:
    code = (
        'import sys; sys.modules["rosbags"] = None\n'
        'from dcgs_ros.datasets.bag.source import BagSource\n'
        f'BagSource({str(bag())!r})'
    )
    run = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
    assert 'SourceError: ' in run.stderr
    assert "pip install 'dcgs_ros[bags]'" in run.stderr
