# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A .sens file is read as it was written, and its sizes are not trusted."""

from __future__ import annotations

import resource
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scannets import (  # type: ignore[import-not-found]
    DEPTH_LAG_US,
    INTERVAL_US,
    JPEG,
    OCCI,
    PNG,
    RAW,
    START_US,
    ZLIB,
    Frame,
    frames_of,
    sens_bytes,
)

from dcgs_ros.core.errors import DcgsError
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.datasets.scannet.sens import SensFile, read_sens
from dcgs_ros.datasets.scannet.source import open_scannet
from dcgs_ros.datasets.source import BadFrame, SourceError

FRAMES = 4
HEADER_BYTES = 12 + 15 + 256 + 36  # with the sensor's name of 15 letters
FRAME_BYTES = 96
SIZES_AT = 80  # within a frame
GROWTH_KB = 50_000
BOMB_BYTES = 2_000_000  # a fiftieth of what the bomb unfolds to

Sens = Callable[..., Path]


@pytest.fixture
def sens(tmp_path: Path) -> Sens:
    """Return a function that writes a .sens file, by default of four frames."""

    def write(data: bytes | None = None, name: str = 'scene0000_00.sens') -> Path:
        path = tmp_path / name
        path.write_bytes(sens_bytes(frames_of(FRAMES)) if data is None else data)
        return path

    return write


def images_of(file: SensFile) -> list[tuple[NDArray[np.uint8], NDArray[np.uint16]]]:
    with file.path.open('rb') as stream:
        return [file.read_images(stream, k) for k in range(len(file.frames))]


def with_bytes(data: bytes, at: int, value: bytes) -> bytes:
    return data[:at] + value + data[at + len(value) :]


@pytest.mark.parametrize('color_type', [RAW, PNG, JPEG])
@pytest.mark.parametrize('depth_type', [RAW, ZLIB])
def test_images_and_poses_are_what_was_written(
    sens: Sens, color_type: int, depth_type: int
) -> None:
    written = frames_of(FRAMES)
    file = read_sens(sens(sens_bytes(written, color_type, depth_type)))
    assert file.loss is None
    assert file.depth_per_metre == 1000
    for frame, (color, depth), read in zip(written, images_of(file), file.frames, strict=True):
        assert color.shape == frame.color.shape
        if color_type != JPEG:
            np.testing.assert_array_equal(color, frame.color)
        np.testing.assert_array_equal(depth, frame.depth)
        np.testing.assert_array_equal(read['T_world_cam'], frame.pose.astype(np.float32))


def test_stamps_are_the_files_where_they_increase(sens: Sens) -> None:
    color_ns, depth_ns = read_sens(sens()).stamps_ns()
    expected = 1000 * (START_US + INTERVAL_US * np.arange(FRAMES))
    np.testing.assert_array_equal(color_ns, expected)
    np.testing.assert_array_equal(depth_ns, expected + 1000 * DEPTH_LAG_US)


@pytest.mark.parametrize('stamps', [(0, 0, 0), (5, 5, 6), (9, 8, 7), (1, 2, 2**64 - 1)])
def test_stamps_that_are_none_become_30_hz(sens: Sens, stamps: tuple[int, ...]) -> None:
    frames = [
        frame._replace(color_us=stamp) for frame, stamp in zip(frames_of(3), stamps, strict=True)
    ]
    color_ns, depth_ns = read_sens(sens(sens_bytes(frames))).stamps_ns()
    np.testing.assert_array_equal(color_ns, [0, 33_333_333, 66_666_667])
    np.testing.assert_array_equal(depth_ns, color_ns)


def test_depth_stamps_of_another_clock_are_not_used(sens: Sens) -> None:
    frames = [frame._replace(depth_us=k + 1) for k, frame in enumerate(frames_of(3))]
    color_ns, depth_ns = read_sens(sens(sens_bytes(frames))).stamps_ns()
    np.testing.assert_array_equal(depth_ns, color_ns)


def test_rotation_rates_come_in_order(sens: Sens) -> None:
    imu = [(0.1, 100), (0.2, 300), (9.0, 200), (float('nan'), 400), (0.3, 500)]
    samples = list(read_sens(sens(sens_bytes(frames_of(2), imu=imu))).imu())
    assert [sample.stamp_ns for sample in samples] == [100_000, 300_000, 500_000]
    assert [sample.angular_velocity for sample in samples] == [
        (0.0, 0.0, rate) for rate in (0.1, 0.2, 0.3)
    ]
    assert list(read_sens(sens()).imu()) == []


def test_a_lying_number_of_rotation_rates_ends_with_the_file(sens: Sens) -> None:
    data = sens_bytes(frames_of(2), imu=[(0.1, 100)])
    lying = with_bytes(data, len(data) - 136, struct.pack('<Q', 2**64 - 1))
    assert len(list(read_sens(sens(lying)).imu())) == 1


def test_a_file_cut_anywhere_gives_its_whole_frames_and_tells(sens: Sens) -> None:
    data = sens_bytes(frames_of(3))
    file = read_sens(sens(data))
    sizes = [int(frame['color_bytes'] + frame['depth_bytes']) for frame in file.frames]
    ends = [int(offset) + size for offset, size in zip(file.offsets, sizes, strict=True)]
    for cut in [*range(0, len(data), 4999), *ends, *(end - 1 for end in ends)]:
        path = sens(data[:cut])
        whole = sum(end <= cut for end in ends)
        if whole == 0:
            with pytest.raises(SourceError, match=r'ends after|holds no frame'):
                read_sens(path)
            continue
        source = open_scannet(path)
        items = list(source)
        assert len(items) == len(source)
        assert sum(isinstance(item, RgbdFrame) for item in items) == whole
        last = items[-1]
        assert isinstance(last, BadFrame) == (whole < 3)
        if isinstance(last, BadFrame):
            assert last.name == f'what follows frame {whole}'
            assert f'{cut} bytes, within frame {whole + 1} of 3' in last.reason


def test_a_lying_number_of_frames_is_told(sens: Sens) -> None:
    source = open_scannet(sens(sens_bytes(frames_of(2), count=2**64 - 1)))
    *frames, last = list(source)
    assert len(frames) == 2
    assert isinstance(last, BadFrame)
    assert f'within frame 3 of {2**64 - 1}' in last.reason


@pytest.mark.parametrize('size', [2**64 - 1, 2**63, 2**62, 2**40])
@pytest.mark.parametrize('at', [SIZES_AT, SIZES_AT + 8])
def test_lying_image_sizes_end_the_file(sens: Sens, size: int, at: int) -> None:
    data = sens_bytes(frames_of(2))
    second = int(read_sens(sens(data)).offsets[1]) - FRAME_BYTES
    *frames, last = list(
        open_scannet(sens(with_bytes(data, second + at, struct.pack('<Q', size))))
    )
    assert len(frames) == 1
    assert isinstance(last, BadFrame)
    assert 'within frame 2 of 2' in last.reason


def one_frame(depth: bytes, color: bytes | None = None) -> bytes:
    """Return a file of one frame with these images."""
    data = sens_bytes(frames_of(1))
    header, frame = data[:HEADER_BYTES], data[HEADER_BYTES:]
    own = struct.unpack_from('<QQ', frame, SIZES_AT)
    color = frame[FRAME_BYTES : FRAME_BYTES + own[0]] if color is None else color
    sizes = struct.pack('<QQ', len(color), len(depth))
    return header + frame[:SIZES_AT] + sizes + color + depth + bytes(8)


BAD_DEPTH = {
    'bomb': (zlib.compress(bytes(100_000_000), 9), 'more bytes, not the 6144'),
    'short': (zlib.compress(bytes(100)), '100 bytes, not the 6144 of 64x48'),
    'no zlib': (b'no zlib', 'incorrect header check'),
    'empty': (b'', '0 bytes, not the 6144'),
    'zero': (zlib.compress(bytes(6144)), 'zero everywhere'),
}


@pytest.mark.parametrize('fault', BAD_DEPTH)
def test_bad_depth_is_one_bad_frame(sens: Sens, fault: str) -> None:
    depth, reason = BAD_DEPTH[fault]
    source = open_scannet(sens(one_frame(depth)))
    tracemalloc.start()
    (bad,) = list(source)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < BOMB_BYTES
    assert isinstance(bad, BadFrame)
    assert bad.name == 'frame 1 of 1'
    assert reason in bad.reason


def huge_jpeg() -> bytes:
    """Return a JPEG header of 65535 x 65535 pixels."""
    return b'\xff\xd8\xff\xc0\x00\x11\x08' + b'\xff' * 4 + bytes(200) + b'\xff\xd9'


@pytest.mark.parametrize(
    ('color', 'reason'),
    [
        (huge_jpeg(), '65535x65535, not 130x97 pixels'),
        (b'', 'neither PNG nor JPEG'),
        (b'II*\0' + bytes(100), 'neither PNG nor JPEG'),
        (b'\xff\xd8' + b'\xff\xe0\0\0' * 50, 'or damaged'),
    ],
)
def test_color_is_decoded_only_at_its_size(sens: Sens, color: bytes, reason: str) -> None:
    data = one_frame(zlib.compress(frames_of(1)[0].depth.tobytes()), color)
    (bad,) = list(open_scannet(sens(data)))
    assert isinstance(bad, BadFrame)
    assert reason in bad.reason


BAD_HEADERS = {
    'version': (0, struct.pack('<I', 3), 'version 3'),
    'name': (4, struct.pack('<Q', 2**64 - 1), 'a name of 18446744073709551615 bytes'),
    'intrinsics': (27, struct.pack('<f', np.nan), 'colour: intrinsics'),
    'extrinsics': (27 + 64, struct.pack('<f', 2.0), 'extrinsics of colour .* not a rigid motion'),
    'colour type': (HEADER_BYTES - 36, struct.pack('<i', 3), 'compressions 3, 1'),
    'occi': (HEADER_BYTES - 32, struct.pack('<i', OCCI), 'OCCI'),
    'colour width': (HEADER_BYTES - 28, struct.pack('<I', 2**32 - 1), '4294967295x97 and 64x48'),
    'unit': (HEADER_BYTES - 12, struct.pack('<f', -1.0), r'-1\.0 units .* 1 to 1000000'),
    'no frames': (HEADER_BYTES - 8, struct.pack('<Q', 0), 'holds no frame'),
}


@pytest.mark.parametrize('fault', BAD_HEADERS)
def test_a_bad_header_is_one_error(sens: Sens, fault: str) -> None:
    at, value, reason = BAD_HEADERS[fault]
    with pytest.raises(SourceError, match=reason) as caught:
        open_scannet(sens(with_bytes(sens_bytes(frames_of(1)), at, value)))
    assert 'scene0000_00.sens' in str(caught.value)


def test_what_is_no_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r'no\.sens: cannot be read: No such file'):
        open_scannet(tmp_path / 'no.sens')


def small_frames() -> list[Frame]:
    """Return frames that compress well, so that most of a file is headers."""
    return [
        frame._replace(color=frame.color // 64 * 64, depth=frame.depth // 500 * 500)
        for frame in frames_of(2)
    ]


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Flip bits, cut the file off, or replace a size."""
    out = bytearray(data)
    choice = rng.integers(4)
    if choice == 0:
        return data[: rng.integers(len(data))]
    if choice == 1:
        for at in rng.integers(0, len(data), rng.integers(1, 20)):
            out[at] ^= 1 << int(rng.integers(8))
        return bytes(out)
    second = HEADER_BYTES + FRAME_BYTES + sum(struct.unpack_from('<QQ', data, HEADER_BYTES + 80))
    ends = (HEADER_BYTES, HEADER_BYTES + FRAME_BYTES, second + FRAME_BYTES)
    at = int(rng.choice(ends)) - 4 * int(rng.integers(1, 10))
    if choice == 2:
        at = int(rng.integers(HEADER_BYTES))
    value = rng.choice(np.array([0, 1, 2**16, 2**31, 2**32 - 1, 2**63, 2**64 - 1], np.uint64))
    return with_bytes(data, at, int(value).to_bytes(8, 'little'))


def read_mutations(sens: Sens, count: int, seed: int) -> dict[str, int]:
    """Read `count` damaged files; return how many ended in which way."""
    rng = np.random.default_rng(seed)
    originals = [sens_bytes(small_frames(), color) for color in (PNG, JPEG)]
    ends = {'error': 0, 'bad': 0, 'good': 0}
    for k in range(count):
        path = sens(mutated(originals[k % 2], rng))
        try:
            source = open_scannet(path)
            items = list(source)
            assert len(items) == len(source)
            list(source.imu())
            ends['bad' if any(isinstance(item, BadFrame) for item in items) else 'good'] += 1
        except DcgsError:
            ends['error'] += 1
    return ends


def test_some_damaged_files_end_well(sens: Sens) -> None:
    assert min(read_mutations(sens, 120, 1).values()) > 0


@pytest.mark.slow
def test_all_damaged_files_end_well_and_small(sens: Sens) -> None:
    read_mutations(sens, 50, 2)  # what is loaded once does not count
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert min(read_mutations(sens, 5000, 3).values()) > 0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < GROWTH_KB
