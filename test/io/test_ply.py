# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""PLY files read back bit for bit, and damaged or hostile ones are refused."""

from __future__ import annotations

import contextlib
import hashlib
import os
import resource
import struct
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from sealing import unsealed_ply  # type: ignore[import-not-found]

from dcgs_ros.core.mapping.splats import PLANES, Splats
from dcgs_ros.io.ply import PlyError, read_ply, write_ply

MEMORY_SLACK = 1 << 20  # bytes beside what the file's size explains
FLOATS = st.floats(width=32, allow_nan=False, allow_infinity=False)  # denormals and -0 too
SCALARS = {
    'char': 'i1', 'uchar': 'u1', 'short': 'i2', 'ushort': 'u2', 'int': 'i4', 'uint': 'u4',
    'float': 'f4', 'double': 'f8', 'int8': 'i1', 'uint8': 'u1', 'int16': 'i2', 'uint16': 'u2',
    'int32': 'i4', 'uint32': 'u4', 'float32': 'f4', 'float64': 'f8',
}  # fmt: skip
PROPERTIES = [f'property float {name}' for name in PLANES]


def random_splats(count: int, seed: int) -> Splats:
    return Splats(np.random.default_rng(seed).normal(size=(14, count)).astype(np.float32))


def header(*lines: str, order: str = 'little') -> bytes:
    encoding = order if order == 'ascii' else f'binary_{order}_endian'
    return '\n'.join(['ply', f'format {encoding} 1.0', *lines, 'end_header', '']).encode()


def as_text(rows: NDArray[np.void]) -> bytes:
    return b''.join(b' '.join(str(x).encode() for x in row.tolist()) + b'\n' for row in rows)


@contextlib.contextmanager
def bounded_memory(file_size: int) -> Iterator[None]:
    """Assert that the block takes no more than a few times the file's size."""
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 3 * file_size + MEMORY_SLACK


def assert_same(found: Splats, expected: Splats) -> None:
    assert found.planes.dtype == np.float32
    assert found.planes.shape == expected.planes.shape
    assert found.planes.tobytes() == expected.planes.tobytes()


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 5).flatmap(lambda n: arrays(np.float32, (14, n), elements=FLOATS)))
def test_written_then_read_is_the_same_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, planes: NDArray[np.float32]
) -> None:
    path = tmp_path_factory.mktemp('round') / 'map.ply'
    write_ply(path, Splats(planes))
    assert_same(read_ply(path), Splats(planes))


def test_more_gaussians_than_are_read_at_once_come_back_too(tmp_path: Path) -> None:
    splats = random_splats(70_001, seed=0)
    write_ply(tmp_path / 'a.ply', splats)
    assert_same(read_ply(tmp_path / 'a.ply'), splats)


def test_a_strided_view_of_a_larger_buffer_is_written_as_what_it_shows(tmp_path: Path) -> None:
    every_second = Splats(random_splats(10, seed=1).planes[:, ::2])
    write_ply(tmp_path / 'a.ply', every_second)
    assert_same(read_ply(tmp_path / 'a.ply'), every_second)


def test_one_gaussian_is_these_bytes(tmp_path: Path) -> None:
    names = 'x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2'.split()
    names += ['rot_0', 'rot_1', 'rot_2', 'rot_3']
    values = {name: 0.5 + index for index, name in enumerate(PLANES)}
    write_ply(tmp_path / 'a.ply', Splats(np.array([list(values.values())], np.float32).T))
    expected = header('element vertex 1', *(f'property float {name}' for name in names))
    expected += struct.pack('<17f', *(values.get(name, 0.0) for name in names))
    written = (tmp_path / 'a.ply').read_bytes()
    assert unsealed_ply(written) == expected
    digest = hashlib.blake2b(written.replace(written[44:116], b''), digest_size=32).hexdigest()
    assert written[36:117].decode() == f'comment blake2b {digest}\n'


def test_a_flipped_bit_anywhere_is_found_or_changes_nothing(tmp_path: Path) -> None:
    splats, path = random_splats(40, seed=9), tmp_path / 'a.ply'
    write_ply(path, splats)
    good, rng, read = path.read_bytes(), np.random.default_rng(10), 0
    for position in [*range(500), *rng.integers(500, len(good), 300)]:
        data = bytearray(good)
        data[position] ^= 1 << rng.integers(8)
        path.write_bytes(data)
        with contextlib.suppress(PlyError):
            assert_same(read_ply(path), splats)
            read += 1
    assert read < 30  # of the comment's first bytes


def test_a_ply_without_a_digest_is_read(tmp_path: Path) -> None:
    write_ply(tmp_path / 'a.ply', random_splats(3, seed=11))
    (tmp_path / 'a.ply').write_bytes(unsealed_ply((tmp_path / 'a.ply').read_bytes()))
    assert_same(read_ply(tmp_path / 'a.ply'), random_splats(3, seed=11))


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(['little', 'big', 'ascii']),
    st.permutations(PLANES),
    st.lists(st.tuples(st.integers(0, 14), st.sampled_from(sorted(SCALARS))), max_size=8),
    st.lists(st.sampled_from(['float', 'float32', 'double', 'float64']), min_size=14, max_size=14),
    st.sampled_from([b'\n', b'\r\n']),
)
def test_any_order_of_properties_and_bytes_and_any_extra_ones_are_read(
    tmp_path_factory: pytest.TempPathFactory,
    order: str,
    names: list[str],
    extras: list[tuple[int, str]],
    kinds: list[str],
    newline: bytes,
) -> None:
    properties = list(zip(names, kinds, strict=True))
    for number, (place, kind) in enumerate(extras):
        properties.insert(place, (f'extra_{number}', kind))
    sign = '>' if order == 'big' else '<'
    splats = random_splats(3, seed=2)
    rows = np.ones(3, [(name, sign + SCALARS[kind]) for name, kind in properties])
    for name, plane in zip(PLANES, splats.planes, strict=True):
        rows[name] = plane
    lines = [f'property {kind} {name}' for name, kind in properties]
    text = header('comment é', 'element vertex 3', 'obj_info 1', *lines, order=order)
    path = tmp_path_factory.mktemp('order') / 'a.ply'
    data = as_text(rows).replace(b'\n', newline) if order == 'ascii' else rows.tobytes()
    path.write_bytes(text.replace(b'\n', newline) + data)
    assert_same(read_ply(path), splats)


@pytest.mark.parametrize('order', ['little', 'ascii'])
def test_elements_before_and_after_the_vertices_are_ignored(tmp_path: Path, order: str) -> None:
    splats = random_splats(2, seed=3)
    cameras = ['element camera 3', 'property int id', 'property double fx']
    faces = ['element face 1', 'property list uchar int vertex_indices', 'property half odd']
    text = header(*cameras, 'element vertex 2', *PROPERTIES, *faces, order=order)
    before = np.ones(3, [('id', '<i4'), ('fx', '<f8')])
    rows = np.rec.fromarrays(list(splats.planes), dtype=[(name, '<f4') for name in PLANES])
    pack = as_text if order == 'ascii' else np.ndarray.tobytes
    after = b'3 0 1 2 0.5\n' if order == 'ascii' else b'\x03' + bytes(14)
    space = b' \r\n' if order == 'ascii' else b''
    (tmp_path / 'a.ply').write_bytes(text + pack(before) + space + pack(rows) + after)
    assert_same(read_ply(tmp_path / 'a.ply'), splats)


def without(name: str) -> list[str]:
    return [line for line in PROPERTIES if not line.endswith(f' {name}')]


def vertices(count: str) -> bytes:
    return header(f'element vertex {count}', *PROPERTIES) + bytes(56)


def text_of(*rows: str, count: int = 2) -> bytes:
    lines = header(f'element vertex {count}', *PROPERTIES, order='ascii')
    return lines + '\n'.join(rows).encode()


ONES = ' '.join(['1.0'] * 14)


HOSTILE = {
    'empty': (b'', "no PLY: begins with b''"),
    'an image': (b'\x89PNG\r\n\x1a\n' + bytes(100), r"no PLY: begins with b'\\x89PNG"),
    'prefix': (b'plywood\n', 'no PLY'),
    'no end': (header()[:-11], 'no end_header within the first 36 bytes'),
    'endless': (b'ply\n' + b'comment x\n' * 10_000, 'no end_header within the first 65536 bytes'),
    'end in a comment': (b'ply\ncomment end_header\n', 'no end_header'),
    'text of one row': (text_of(ONES, ' '), 'ends after 1 of 2 vertices'),
    'text of one number less': (text_of(ONES, ONES[:-4]), 'after row 0 .* 14 columns but 13'),
    'text of one number more': (text_of(ONES, ONES + ' 1'), 'after row 0 .* 14 columns but 15'),
    'text of words': (text_of(ONES, ONES[:-3] + 'one'), "convert string 'one' to float32"),
    'text of commas': (text_of(*[ONES.replace(' ', ',')] * 2), '14 columns but 1 were found'),
    'text, cut off': (text_of('1 ' * 14), '2 vertices of 28 bytes need 55 bytes, but 28 follow'),
    'text, huge': (text_of(ONES, count=10**17), 'need 27999'),
    'version': (b'ply\nformat binary_little_endian 2.0\nend_header\n', '2.0.*only'),
    'two formats': (
        header('format binary_big_endian 1.0'),
        "'format binary_big_endian 1.0': only one format",
    ),
    'no format': (b'ply\nelement vertex 0\nend_header\n', 'header has no format'),
    'no vertices': (header(), 'header has no element vertex'),
    'vertices twice': (header('element vertex 0', 'element vertex 0'), "vertex 0' is not underst"),
    'faces first': (
        header('element face 0', 'property list uchar int a', 'element vertex 0', *PROPERTIES),
        "'a' of the rows of 'face' is a list",
    ),
    'list': (
        header('element vertex 0', *PROPERTIES, 'property list uchar int a'),
        "'a' of the vertices is a list",
    ),
    'type': (
        header('element vertex 0', *PROPERTIES, 'property half a'),
        "'property half a' is not understood",
    ),
    'orphan': (header('property float x'), "'property float x' is not understood"),
    'junk': (header('hello' * 1000), "'hello.{55}' is not understood"),
    'twice': (header('element vertex 0', *PROPERTIES, 'property int z'), "'z' of the .* twice"),
    'missing': (header('element vertex 0', *without('rot_3')), 'vertices lack rot_3$'),
    'a cloud': (header('element vertex 0', *PROPERTIES[:3]), 'lack scale_0, .*, f_dc_2$'),
    'integer': (
        header('element vertex 0', *without('y'), 'property int y'),
        'y are neither float',
    ),
    'negative': (vertices('-1'), "'-1' is no number of vertices"),
    'fraction': (vertices('1.5'), "'1.5' is no number of vertices"),
    'exponent': (vertices('1e3'), "'1e3' is no number of vertices"),
    'digits': (vertices('9' * 5000), "'9{40}' is no number of vertices"),
    'one too many': (vertices('2'), '2 vertices of 56 bytes need 112 bytes, but 56 follow'),
    'huge': (vertices('9' * 18), '9{18} vertices of 56 bytes need 5[0-9]+ bytes, but 56'),
    'cut off': (vertices('1')[:-1], 'need 56 bytes, but 55 follow the header'),
}


@pytest.mark.parametrize('fault', HOSTILE)
def test_what_is_no_file_of_gaussians_is_refused_with_the_reason(
    tmp_path: Path, fault: str
) -> None:
    content, reason = HOSTILE[fault]
    (tmp_path / 'bad.ply').write_bytes(content)
    with bounded_memory(0), pytest.raises(PlyError, match=rf'bad\.ply: .*{reason}'):
        read_ply(tmp_path / 'bad.ply')


def test_a_file_that_is_not_there_or_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PlyError, match=r'a\.ply: cannot be read: No such file'):
        read_ply(tmp_path / 'a.ply')
    with pytest.raises(PlyError, match='cannot be read: Is a directory'):
        read_ply(tmp_path)
    with pytest.raises(PlyError, match='cannot be written: No such file'):
        write_ply(tmp_path / 'nowhere' / 'a.ply', random_splats(1, seed=4))


@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf])
def test_gaussians_that_are_not_finite_are_counted_and_not_written(
    tmp_path: Path, value: float
) -> None:
    splats = random_splats(40_000, seed=5)
    path = tmp_path / 'a.ply'
    write_ply(path, splats)
    good = path.read_bytes()
    splats.planes[[0, 13], [7, 7]] = value  # two parameters of one Gaussian
    splats.planes[10, 39_999] = value
    with pytest.raises(PlyError, match=r'a\.ply: not written: 2 of 40000 Gaussians are not fini'):
        write_ply(path, splats)
    assert path.read_bytes() == good


@pytest.mark.parametrize('order', ['little', 'ascii'])
@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf])
def test_gaussians_that_are_not_finite_are_left_out_and_counted(
    tmp_path: Path, value: float, order: str
) -> None:
    splats = random_splats(50, seed=5)
    rows = np.rec.fromarrays(list(splats.planes), dtype=[(name, '<f4') for name in PLANES])
    rows['opacity'][[3, 49]] = value
    rows['x'][7] = value
    pack = as_text if order == 'ascii' else np.ndarray.tobytes
    path, warnings = tmp_path / 'a.ply', list[str]()
    path.write_bytes(header('element vertex 50', *PROPERTIES, order=order) + pack(rows))
    found = read_ply(path, warnings.append)
    assert_same(found, Splats(np.delete(splats.planes, [3, 7, 49], axis=1)))
    assert found.planes.flags.c_contiguous
    assert warnings == [f'{path}: 3 of 50 Gaussians are not finite and are left out']
    with pytest.warns(UserWarning, match='3 of 50'):
        read_ply(path)


@pytest.mark.filterwarnings('error')
def test_a_double_beyond_float32_is_not_finite(tmp_path: Path) -> None:
    lines = [f'property double {name}' for name in PLANES]
    text = header('element vertex 1', *lines) + struct.pack('<14d', 1e39, *[0.0] * 13)
    (tmp_path / 'a.ply').write_bytes(text)
    with pytest.raises(PlyError, match=r'1 of 1 Gaussians are not finite$'):
        read_ply(tmp_path / 'a.ply')


def test_a_file_that_shrinks_meanwhile_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_ply(tmp_path / 'a.ply', random_splats(5, seed=10))
    whole = np.fromfile
    monkeypatch.setattr(np, 'fromfile', lambda *arguments: whole(*arguments)[:3])
    with pytest.raises(PlyError, match='ends after 3 of 5 vertices'):
        read_ply(tmp_path / 'a.ply')


def test_a_pipe_is_refused() -> None:
    reading, writing = os.pipe()
    os.write(writing, header('element vertex 0', *PROPERTIES))
    os.close(writing)
    with pytest.raises(PlyError, match=r'cannot be read: .*not seekable'):
        read_ply(f'/dev/fd/{reading}')
    os.close(reading)


def fails(*_: object) -> None:
    raise OSError('gone')  # without a number, as numpy raises it too


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / 'a.ply'
    write_ply(path, random_splats(1, seed=6))
    old = path.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, hard))
    try:
        with pytest.raises(PlyError, match=r'a\.ply: cannot be written: File too large'):
            write_ply(path, random_splats(1000, seed=7))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (path.read_bytes(), list(tmp_path.iterdir())) == (old, [path])
    monkeypatch.setattr(os, 'replace', fails)
    with pytest.raises(PlyError, match=r'a\.ply: cannot be written: gone'):
        write_ply(path, random_splats(1000, seed=7))
    assert (path.read_bytes(), list(tmp_path.iterdir())) == (old, [path])


def damaged(good: bytes, seed: int) -> bytes:
    """Change a few bytes, half the time of the first 500, or cut the file off."""
    rng = np.random.default_rng(seed)
    if seed % 4 == 0:
        return good[: rng.integers(len(good))]
    data = bytearray(good)
    for position in rng.integers(500 if seed % 2 else len(good), size=rng.integers(1, 4)):
        data[position] = rng.integers(256)
    return bytes(data)


def test_damaged_files_are_read_or_refused_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / 'a.ply'
    write_ply(path, random_splats(20, seed=8))
    good = unsealed_ply(path.read_bytes())
    refused = 0
    for seed in range(400):
        path.write_bytes(damaged(good, seed))
        with bounded_memory(len(good)):
            try:
                read_ply(path)
            except PlyError:
                refused += 1
    assert 200 < refused < 400
