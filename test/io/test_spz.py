# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""SPZ files hold what was written to the precision of their bits; hostile ones are refused."""

from __future__ import annotations

import builtins
import gzip
import math
import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core.mapping.splats import Splats
from dcgs_ros.io.spz import SpzError, read_spz, write_spz

HEADER = struct.Struct('<4sII4B')
# One Gaussian: 1.5, -1, 2 m with 12 bits of fraction; opacity 3/5; grey and two more colours;
# log-scales -10, -6, 0; x the largest of the rotation.
POSITION = b'\x00\x18\x00' + b'\x00\xf0\xff' + b'\x00\x20\x00'
REST = bytes([153, 127, 0, 255, 0, 64, 160])
ROTATION = struct.pack('<I', 0 << 30 | 100 << 20 | (512 | 200) << 10 | 300)
MILLION = 1_000_000


def header(version: int, count: int, bits: int = 12, streams: int = 0) -> bytes:
    return HEADER.pack(b'NGSP', version, count, 0, bits, 0, streams)


def version_4(count: int, streams: list[bytes]) -> bytes:
    zstandard = pytest.importorskip('zstandard')
    packed = [zstandard.ZstdCompressor().compress(stream) for stream in streams]
    table = b''.join(
        struct.pack('<QQ', len(p), len(s)) for p, s in zip(packed, streams, strict=True)
    )
    head = header(4, count, streams=len(streams)) + struct.pack('<I12x', 40) + b'an addon'
    return head + table + b''.join(packed)


def read(path: Path, content: bytes) -> Splats:
    path.write_bytes(content)
    return read_spz(path)


def random_splats(count: int, seed: int) -> Splats:
    """Return what the format can hold."""
    rng = np.random.default_rng(seed)
    planes = rng.normal(size=(14, count)).astype(np.float32)
    planes[3:6] = rng.uniform(-9.9, 5.8, (3, count))
    return Splats(planes)


def cosines(splats: Splats, other: Splats) -> NDArray[Any]:
    """Return those of half the angles between the rotations."""
    a, b = splats.quats_wxyz, other.quats_wxyz
    return np.abs((a * b).sum(axis=0)) / np.linalg.norm(a, axis=0) / np.linalg.norm(b, axis=0)


def test_one_gaussian_is_these_bits(tmp_path: Path) -> None:
    streams = [POSITION, REST[:1], REST[1:4], REST[4:], ROTATION]
    data = b''.join(streams)
    for content in (gzip.compress(header(3, 1) + data), version_4(1, [*streams, b'harmonics'])):
        planes = read(tmp_path / 'a.spz', content).planes[:, 0]
        assert planes[:6] == pytest.approx([1.5, -1, 2, -10, -6, 0])
        others = np.array([100, -200, 300]) * math.sqrt(0.5) / 511  # y, z, w
        x = math.sqrt(1 - (others**2).sum())
        assert planes[6:10] == pytest.approx([others[2], x, others[0], others[1]])
        assert planes[10] == pytest.approx(math.log(3 / 2))
        assert planes[11:] * 0.15 + 0.5 == pytest.approx([127 / 255, 0, 1])


def test_version_2_has_three_bytes_of_rotation(tmp_path: Path) -> None:
    content = gzip.compress(header(2, 1) + POSITION + REST + bytes([255, 0, 127]))
    w, x, y, z = read(tmp_path / 'a.spz', content).quats_wxyz[:, 0]
    assert (w, x, y) == (0, 1, -1)
    assert z == pytest.approx(127 / 127.5 - 1)


def test_what_is_written_comes_back_as_precisely_as_the_bits_allow(tmp_path: Path) -> None:
    splats = random_splats(5000, seed=0)
    write_spz(tmp_path / 'a.spz', splats)
    found = read_spz(tmp_path / 'a.spz')
    assert np.abs(found.means - splats.means).max() <= 0.5001 / 4096
    assert np.abs(found.log_scales - splats.log_scales).max() <= 0.5001 / 16
    assert cosines(found, splats).min() > np.cos(0.003)
    opacities = [1 / (1 + np.exp(-x.opacity_logits.astype(float))) for x in (found, splats)]
    assert np.abs(opacities[0] - opacities[1]).max() <= 0.5001 / 255
    inside = np.abs(splats.sh_dc) < 0.5 / 0.15
    assert np.abs(found.sh_dc - splats.sh_dc)[inside].max() <= 0.5001 / 255 / 0.15
    write_spz(tmp_path / 'b.spz', found)  # already rounded
    again = read_spz(tmp_path / 'b.spz')
    assert np.array_equal(
        np.delete(again.planes, range(6, 10), 0), np.delete(found.planes, range(6, 10), 0)
    )
    assert cosines(again, found).min() > np.cos(0.003)
    assert (tmp_path / 'a.spz').stat().st_size < 20 * 5000


def test_equal_maps_give_equal_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, seconds in (('a', 1.0), ('b', 2e9)):
        monkeypatch.setattr('time.time', lambda seconds=seconds: seconds)
        write_spz(tmp_path / name, random_splats(10, seed=1))
    assert (tmp_path / 'a').read_bytes() == (tmp_path / 'b').read_bytes()


def test_extremes_are_written_as_the_nearest_that_the_format_has(tmp_path: Path) -> None:
    planes = np.zeros((14, 3), np.float32)
    planes[:, 0], planes[:, 1] = -1e30, 1e30
    planes[:3] = np.array([[0], [1e5], [-8e6]])
    write_spz(tmp_path / 'a.spz', Splats(planes))
    found = read_spz(tmp_path / 'a.spz')
    assert np.abs(found.means - planes[:3]).max() <= 0.5  # metres: no bits of fraction are left
    assert np.isfinite(found.planes).all()
    assert found.log_scales[:, 0] == pytest.approx([-10] * 3)
    assert found.opacity_logits[0] < -13 and found.opacity_logits[1] > 13
    for value, reason in ((np.inf, '1 of 3 Gaussians are not finite'), (1e7, 'up to 1e.07 m')):
        planes[0, 1] = value
        with pytest.raises(SpzError, match=rf'b\.spz: not written: .*{reason}'):
            write_spz(tmp_path / 'b.spz', Splats(planes))
    assert [path.name for path in tmp_path.iterdir()] == ['a.spz']


def test_no_gaussians_are_a_file_too(tmp_path: Path) -> None:
    write_spz(tmp_path / 'a.spz', Splats(np.empty((14, 0), np.float32)))
    assert len(read_spz(tmp_path / 'a.spz')) == 0


GOOD = gzip.compress(header(3, 1) + POSITION + REST + ROTATION)
HOSTILE = {
    'empty': (b'', "no SPZ: begins with b''"),
    'an image': (b'\x89PNG\r\n\x1a\n' + bytes(100), 'no SPZ: begins with'),
    'another gzip': (gzip.compress(b'hello, world!'), "no SPZ: begins with b'hello"),
    'version 1': (gzip.compress(header(1, 1)), 'is of version 1; versions 2 to 4'),
    'version 5': (header(5, 1) + bytes(99), 'is of version 5'),
    'bits': (gzip.compress(header(3, 1, bits=25)), '25 of the 24 bits'),
    'short': (gzip.compress(header(3, 1) + POSITION), 'ends within its 1 Gaussians'),
    'cut off': (GOOD[:-12], 'its gzip is broken'),
    'damaged': (GOOD[:-8] + bytes(4) + GOOD[-4:], 'its gzip is broken'),
    'huge': (gzip.compress(header(3, 2**32 - 1)), '4294967295 Gaussians are more than its'),
    'bomb': (gzip.compress(header(3, 60 * MILLION) + bytes(1 << 20)), 'are more than its'),
}


@pytest.mark.parametrize('fault', HOSTILE)
def test_what_is_no_spz_is_refused_with_the_reason(tmp_path: Path, fault: str) -> None:
    content, reason = HOSTILE[fault]
    (tmp_path / 'a.spz').write_bytes(content)
    tracemalloc.start()
    with pytest.raises(SpzError, match=rf'a\.spz: .*{reason}'):
        read_spz(tmp_path / 'a.spz')
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 21


def test_broken_zstd_is_refused(tmp_path: Path) -> None:
    streams = [POSITION, REST[:1], REST[1:4], REST[4:], ROTATION]
    good = version_4(1, streams)
    for content, reason in (
        (good[:-9], 'its zstd is broken|ends within'),
        (good[:120] + b'\xff\xff' + good[122:], 'its zstd is broken'),
        (good[:16] + b'\xff' * 4 + good[20:], 'ends within'),
        (good[:20], 'ends within'),
        (version_4(1, streams[:4]), 'ends within'),
        (version_4(2, streams), 'ends within its 2'),
    ):
        with pytest.raises(SpzError, match=reason):
            read(tmp_path / 'a.spz', content)


def test_zstd_that_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content, found = version_4(1, [b'']), builtins.__import__

    def refuse(name: str, *rest: Any) -> Any:
        if name == 'zstandard':
            raise ImportError('gone')
        return found(name, *rest)

    monkeypatch.setattr(builtins, '__import__', refuse)
    with pytest.raises(SpzError, match=r"version 4 needs .* pip install 'dcgs_ros\[bags\]' .gone"):
        read(tmp_path / 'a.spz', content)


def test_files_that_are_not_there_are_named(tmp_path: Path) -> None:
    with pytest.raises(SpzError, match=r'a\.spz: cannot be read: No such file'):
        read_spz(tmp_path / 'a.spz')
    with pytest.raises(SpzError, match='cannot be written: No such file'):
        write_spz(tmp_path / 'nowhere' / 'a.spz', random_splats(1, seed=4))


def test_damaged_files_are_read_or_refused_and_nothing_else(tmp_path: Path) -> None:
    path, rng = tmp_path / 'a.spz', np.random.default_rng(5)
    for good in (gzip.decompress(GOOD), version_4(1, [POSITION, *[REST] * 4])):
        for seed in range(80):
            data = bytearray(good)
            for position in rng.integers(len(good), size=rng.integers(1, 4)):
                data[position] = rng.integers(256)
            path.write_bytes(gzip.compress(data) if seed % 2 and data[4] != 4 else data)
            try:
                read_spz(path)
            except SpzError:
                pass
