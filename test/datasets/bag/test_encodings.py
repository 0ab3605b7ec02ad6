# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Recordings in every encoding and transport are read, or refused before the first frame."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rosbags')

from bags import (  # type: ignore[import-not-found]
    CAMERA,
    COLOR,
    DEPTH,
    INTERVAL_NS,
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
from packing import pack, rvl, zstd  # type: ignore[import-not-found]
from realsense_bags import (  # type: ignore[import-not-found]
    compressed_entry,
    encoded,
    quantised,
)

from dcgs_ros.cli.main import main
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.datasets.bag.source import BagSource
from dcgs_ros.datasets.source import SourceError
from dcgs_ros.io.images.encodings import COLOR_ENCODINGS

FRAMES = 2
LOSSY = 60.0  # mean levels of noise through shared chroma or a mosaic; unrelated noise has 85
EXACT = [name for name in COLOR_ENCODINGS if not name.startswith(('bayer', 'yu', 'uy', 'nv'))]


def with_color(path: Path, colors: Iterable[Entry]) -> Path:
    others = [entry for entry in recording(FRAMES) if entry.topic != COLOR]
    return write_bag(path, [*others, *colors])


def frames_of(path: Path) -> list[RgbdFrame]:
    frames = [item for item in BagSource(path) if isinstance(item, RgbdFrame)]
    assert len(frames) == FRAMES
    return frames


def test_a_recording_is_read_in_any_encoding(tmp_path: Path) -> None:
    """Each of its images is in another one."""
    entries = [info_entry(START_NS, CAMERA)]
    for k, encoding in enumerate(COLOR_ENCODINGS):
        stamp_ns = START_NS + k * INTERVAL_NS
        entries.append(image_entry(COLOR, stamp_ns, encoding, pack(color_of(0), encoding)))
        entries.append(depth_entry(stamp_ns, depth_of(0)))
    frames = list(BagSource(write_bag(tmp_path / 'bag', entries)))
    for frame, encoding in zip(frames, COLOR_ENCODINGS, strict=True):
        assert isinstance(frame, RgbdFrame), encoding
        rgb = color_of(0) if frame.color.ndim == 3 else color_of(0)[..., 1]
        error = np.abs(frame.color.astype(float) - rgb).mean()
        assert error == 0 if encoding in EXACT else error < LOSSY


@pytest.mark.parametrize('transport', ['compressedDepth', 'zstd', 'compressed'])
def test_depth_by_any_transport_is_that_of_the_raw_topic(tmp_path: Path, transport: str) -> None:
    def packed(k: int) -> tuple[str, bytes]:
        if transport == 'zstd':
            return 'zstd', zstd(depth_of(k), 48, '16UC1', really=bool(k))
        if transport == 'compressed':
            return '16UC1; png compressed ', encoded('.png', depth_of(k))
        return '16UC1; compressedDepth rvl', bytes(12) + rvl(depth_of(k))

    others = [entry for entry in recording(FRAMES) if entry.topic != DEPTH]
    depths = [
        compressed_entry(f'{DEPTH}/{transport}', START_NS + k * INTERVAL_NS, *packed(k))
        for k in range(FRAMES)
    ]
    path = write_bag(tmp_path / 'bag', [*others, *depths])
    for k, frame in enumerate(frames_of(path)):
        np.testing.assert_array_equal(frame.depth_m, depth_of(k) / np.float32(1000))


@pytest.mark.parametrize(
    ('format_', 'data'),
    [
        ('bgr8; jpeg compressed bgr8', encoded('.jpg', color_of(0))),
        ('rgb8; png compressed bgr8', encoded('.png', color_of(0))),
        ('zstd', zstd(pack(color_of(0), 'bgra8'), 48, 'bgra8', really=False)),
    ],
)
def test_compressed_colour_is_read_from_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], format_: str, data: bytes
) -> None:
    transport = 'zstd' if format_ == 'zstd' else 'compressed'
    colors = [
        compressed_entry(f'{COLOR}/{transport}', START_NS + k * INTERVAL_NS, format_, data)
        for k in range(FRAMES)
    ]
    path = with_color(tmp_path / 'bag', colors)
    assert main(['info', str(path)]) == 0
    out = capsys.readouterr().out
    assert f'{COLOR}/{transport}' in out and '0 in the sample' in out


def test_inverse_depth_may_come_in_rvl(tmp_path: Path) -> None:
    depth_m = (depth_of(0) / 1000).astype(np.float32)
    header = quantised(depth_m)[:12]
    a, b = np.frombuffer(header, '<f4')[1:]
    inverse = np.where(depth_m > 0, a / np.maximum(depth_m, 1e-3) + b, 0).astype(np.uint16)
    entry = compressed_entry(
        f'{DEPTH}/compressedDepth', START_NS, '32FC1; compressedDepth rvl', header + rvl(inverse)
    )
    path = write_bag(tmp_path / 'bag', [*(e for e in recording(1) if e.topic != DEPTH), entry])
    (frame,) = BagSource(path)
    assert isinstance(frame, RgbdFrame)
    np.testing.assert_array_equal(frame.depth_m == 0, depth_m == 0)
    near = depth_m > 0
    assert np.abs(a / frame.depth_m[near] - a / depth_m[near]).max() <= 1.0 + 1e-3


def test_zstd_keeps_metres(tmp_path: Path) -> None:
    depth_m = depth_of(0) / np.float32(1000)
    entry = compressed_entry(f'{DEPTH}/zstd', START_NS, 'zstd', zstd(depth_m, 48, '32FC1', True))
    path = write_bag(tmp_path / 'bag', [*(e for e in recording(1) if e.topic != DEPTH), entry])
    (frame,) = BagSource(path)
    assert isinstance(frame, RgbdFrame)
    np.testing.assert_array_equal(frame.depth_m, depth_m)


def test_an_unknown_encoding_is_told_before_any_frame(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    colors = [image_entry(COLOR, START_NS, 'yuv411', color_of(0))]
    path = with_color(tmp_path / 'color', colors)
    assert main(['run', str(path), '--out', str(tmp_path / 'run')]) == 2
    error = capsys.readouterr().err
    assert error.count('\n') == 1 and f"{COLOR}: colour is 'yuv411', not one of rgb8" in error
    assert not (tmp_path / 'run').exists()
    entries = [
        image_entry(COLOR, START_NS, 'rgb8', color_of(0)),
        image_entry(DEPTH, START_NS, '64FC2', depth_of(0)),
        info_entry(START_NS, CAMERA),
    ]
    with pytest.raises(SourceError, match=f"{DEPTH}: depth is '64FC2', not one of 16UC1"):
        BagSource(write_bag(tmp_path / 'depth', entries))
    video = compressed_entry(f'{COLOR}/compressed', START_NS, 'h264', b'\0\0\0\1\x67')
    entries = [video, depth_entry(START_NS, depth_of(0)), info_entry(START_NS, CAMERA)]
    with pytest.raises(SourceError, match="compressed as 'h264', not as one of png, jpeg, zstd"):
        BagSource(write_bag(tmp_path / 'video', entries))


def test_a_damaged_first_image_refuses_nothing(tmp_path: Path) -> None:
    entries = list(recording(3))
    at = next(k for k, entry in enumerate(entries) if entry.topic == COLOR)
    half = encoded('.png', color_of(0))[:-9]
    entries[at] = image_entry(COLOR, START_NS, 'rgba8', color_of(0))  # of too short rows
    items = list(BagSource(write_bag(tmp_path / 'bag', entries)))
    assert [type(item).__name__ for item in items] == ['BadFrame', 'RgbdFrame', 'RgbdFrame']
    colors = [
        compressed_entry(f'{COLOR}/compressed', START_NS + k * INTERVAL_NS, 'png', data)
        for k, data in enumerate([half, encoded('.png', color_of(1))])
    ]
    path = with_color(tmp_path / 'small', colors)
    for camera in (None, '60,61,32,24'):
        items = list(BagSource(path, camera))
        assert [type(item).__name__ for item in items] == ['BadFrame', 'RgbdFrame']
