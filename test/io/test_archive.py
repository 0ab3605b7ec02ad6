# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Archives are exact, have the same bytes each time, and are safe to read."""

from __future__ import annotations

import contextlib
import io
import json
import os
import resource
import struct
import tracemalloc
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from sealing import unsealed_zip  # type: ignore[import-not-found]

from dcgs_ros.io import archive, zip_members
from dcgs_ros.io.archive import ArchiveError, read_archive, write_archive
from dcgs_ros.io.digest import SEAL_LENGTH

MEMORY_SLACK = 1 << 20  # bytes beside what the file's size explains
DTYPES = ['|b1', '|i1', '|u1', '<i2', '<u2', '<i4', '<u4', '<i8', '<u8', '<f4', '<f8']
NAMES = st.from_regex(r'[A-Za-z0-9_][A-Za-z0-9_.-]{0,30}', fullmatch=True)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=10,
)  # fmt: skip
ARRAYS = st.sampled_from(DTYPES).flatmap(
    lambda dtype: hnp.arrays(dtype, hnp.array_shapes(min_dims=0, min_side=0, max_side=3))
)
# Of version 1, which has no digest that would hide what else is wrong.
GOOD_METADATA = json.dumps({'format': 'dcgs_ros archive', 'version': 1, 'metadata': {}})


def small(path: Path) -> bytes:
    """Write an archive with something of each kind."""
    arrays: dict[str, NDArray[Any]] = {
        'means': np.arange(12, dtype=np.float32).reshape(4, 3),
        'ids': np.array([-1, 5]),
        'none': np.zeros((0, 3)),
    }
    write_archive(path, arrays, {'camera': {'fx': 525.1}, 'list': [1, None]}, {'a.jpg': b'jpeg'})
    return path.read_bytes()


def npy(array: NDArray[Any], allow_pickle: bool = False) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array(file, array, allow_pickle=allow_pickle)
    return file.getvalue()


def npy_of(description: str, data: bytes = b'') -> bytes:
    """Write an .npy file with any header."""
    text = description.encode()
    text += b' ' * (-(11 + len(text)) % 64) + b'\n'
    return b'\x93NUMPY\x01\x00' + struct.pack('<H', len(text)) + text + data


def npy_of_shape(shape: str, data: bytes = b'') -> bytes:
    return npy_of(f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}", data)


def packed(
    *members: tuple[str, bytes], metadata: str = GOOD_METADATA, method: int = zipfile.ZIP_STORED
) -> bytes:
    """Return a zip with good metadata and these members, with their CRC."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, 'w', method) as target:
        target.writestr(zipfile.ZipInfo('metadata.json'), metadata)
        for name, content in members:
            info = zipfile.ZipInfo(name)
            info.compress_type = method
            target.writestr(info, content)
    return file.getvalue()


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


@settings(max_examples=100, deadline=None)
@given(
    st.dictionaries(NAMES, ARRAYS, max_size=4),
    st.dictionaries(st.text(), JSON, max_size=4),
    st.dictionaries(
        NAMES.filter(lambda name: not name.endswith('.npy')), st.binary(max_size=50), max_size=4
    ),
)
def test_written_then_read_is_the_same_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory,
    arrays: dict[str, NDArray[Any]],
    metadata: dict[str, Any],
    blobs: dict[str, bytes],
) -> None:
    path = tmp_path_factory.mktemp('round') / 'a'
    write_archive(path, arrays, metadata, blobs)
    again = read_archive(path)
    assert (again.metadata, again.blobs) == (metadata, blobs)
    assert list(again.arrays) == list(arrays)
    for name, array in arrays.items():
        found = again.arrays[name]
        assert (found.dtype, found.shape) == (array.dtype, array.shape)
        assert found.tobytes() == array.tobytes()
        assert found.flags.writeable and found.flags.aligned and found.flags.c_contiguous
    with np.load(path) as opened:  # and numpy reads the same arrays
        for name, array in arrays.items():
            assert opened[f'{name}.npy'].tobytes() == array.tobytes()


def test_any_order_in_memory_becomes_rows(tmp_path: Path) -> None:
    array = np.arange(24).reshape(2, 3, 4)
    write_archive(tmp_path / 'a', {'turned': array.T, 'some': array[:, ::2]}, {}, {})
    again = read_archive(tmp_path / 'a')
    np.testing.assert_array_equal(again.arrays['turned'], array.T)
    np.testing.assert_array_equal(again.arrays['some'], array[:, ::2])


def test_equal_contents_are_equal_bytes_without_date_or_compression(tmp_path: Path) -> None:
    assert small(tmp_path / 'a') == small(tmp_path / 'b')
    with zipfile.ZipFile(tmp_path / 'a') as opened:
        assert opened.testzip() is None
        assert opened.namelist() == ['metadata.json', 'means.npy', 'ids.npy', 'none.npy', 'a.jpg']
        assert {info.date_time for info in opened.infolist()} == {(1980, 1, 1, 0, 0, 0)}
        assert {info.compress_type for info in opened.infolist()} == {zipfile.ZIP_STORED}


def test_every_file_cut_off_is_refused(tmp_path: Path) -> None:
    good = small(tmp_path / 'a')
    for length in range(len(good)):
        (tmp_path / 'a').write_bytes(good[:length])
        with pytest.raises(ArchiveError):
            read_archive(tmp_path / 'a')


ONE = packed(('x', b'12345678'))
AT = ONE.index(b'PK\x03\x04', 4)  # where the header of x begins
DIRECTORY = ONE.index(b'PK\x01\x02')


def patched(offset: int, form: str, *values: int) -> bytes:
    """Write numbers into the header of x."""
    data = bytearray(ONE)
    struct.pack_into(form, data, AT + offset, *values)
    return bytes(data)


def repeated_in_directory() -> bytes:
    """Return a zip whose directory names x twice, as one with overlapping members does."""
    entry = ONE[ONE.index(b'PK\x01\x02', DIRECTORY + 1) : -22]
    size = len(ONE) - 22 - DIRECTORY + len(entry)
    end = struct.pack('<4s4H2IH', b'PK\x05\x06', 0, 0, 3, 3, size, DIRECTORY, 0)
    return ONE[:-22] + entry + end


def array(content: bytes) -> bytes:
    return packed(('x.npy', content))


def versioned(version: Any) -> str:
    return json.dumps({'format': 'dcgs_ros archive', 'version': version, 'metadata': {}})


HOSTILE = {
    'empty': (b'', "no archive: begins with b''"),
    'an image': (b'\x89PNG\r\n\x1a\n' + bytes(50), 'no archive: begins with'),
    'no members': (b'PK\x05\x06' + bytes(18), 'no archive'),
    'deflated': (
        packed(('x', bytes(5000)), method=zipfile.ZIP_DEFLATED),
        "'x' is compressed: method 8, 5000 bytes in [0-9]+",
    ),
    'packed size': (patched(18, '<I', 7), "'x' is compressed: method 0, 8 bytes in 7"),
    'other method': (patched(8, '<H', 8), "'x' is compressed: method 8, 8 bytes in 8"),
    'encrypted': (patched(6, '<H', 1), "'x' is encrypted or streamed: flags 0x0001"),
    'streamed': (patched(6, '<H', 8), "'x' is encrypted or streamed: flags 0x0008"),
    'larger than the file': (
        patched(18, '<II', 2**32 - 1, 2**32 - 1),
        "'x' has 4294967295 bytes by its header, but [0-9]{3} are left",
    ),
    'over the directory': (patched(18, '<II', 9, 9), "'x' is damaged: CRC"),
    'shorter': (patched(18, '<II', 7, 7), "'x' is damaged: CRC"),
    'extra field beyond the end': (patched(28, '<H', 60_000), 'but -[0-9]+ are left'),
    'flipped': (ONE.replace(b'12345678', b'12345679'), "'x' is damaged: CRC .{8}, not 9ae0daaf"),
    'junk': (
        ONE[:DIRECTORY] + b'junk' + ONE[DIRECTORY:],
        'cut off or damaged after 2 members',
    ),
    'overlapping': (repeated_in_directory(), 'holds 2 members, but its end counts 3'),
    'twice': (ONE[:DIRECTORY] + ONE[AT:], "'x' is there twice"),
    'up': (packed(('..', b'')), r"'\.\.' is no name"),
    'folder': (packed(('a/b', b'')), "'a/b' is no name"),
    'absolute': (packed(('/etc', b'')), "'/etc' is no name"),
    'nameless': (packed(('', b'')), "'' is no name"),
    'long name': (packed(('a' * 101, b'')), "'a{40}' is no name"),
    'not ascii': (packed(('é', b'')), 'is no name'),
    'no metadata': (ONE[AT:], "begins with 'x', not with metadata.json"),
    'no json': (packed(metadata='{'), 'metadata.json is no JSON'),
    'deep json': (packed(metadata='[' * 60_000), 'metadata.json is no JSON: .*recursion'),
    'endless json': (
        packed(metadata=' ' * 70_000),
        'metadata.json has 70000 bytes, more than 655',
    ),
    'a list': (packed(metadata='[]'), 'does not say that this is a dcgs_ros archive'),
    'another': (packed(metadata='{"format": "zip"}'), 'does not say that this is a dcgs_ros'),
    'no version': (packed(metadata='{"format": "dcgs_ros archive"}'), 'lacks the version'),
    'no metadata inside': (
        packed(metadata='{"format": "dcgs_ros archive", "version": 1}'),
        'lacks the version or the metadata',
    ),
    'from the future': (
        packed(metadata=versioned(99)),
        'version 99; this program reads versions 1 to 3',
    ),
    'version as text': (packed(metadata=versioned('1')), 'lacks the version'),
    'objects': (array(npy(np.array([None]), True)), r"'x' is of type b'\|O'"),
    'structured': (array(npy(np.zeros(1, 'i4,i4'))), "'x' is no array of numbers: .*descr"),
    'big-endian': (array(npy(np.zeros(1, '>f4'))), "'x' is of type b'>f4'"),
    'text': (array(npy(np.array(['a']))), "'x' is of type b'<U1'"),
    'complex': (array(npy(np.zeros(1, complex))), "'x' is of type b'<c16'"),
    'columns': (array(npy(np.zeros((2, 2)).T)), "'x' is no array of numbers: .*'fortran_order"),
    'no array': (array(b'hello'), "'x' is no array of numbers: b'hello'"),
    'code': (array(npy_of_shape('(1+1,)', bytes(8))), "'x' is no array of numbers"),
    'negative': (array(npy_of_shape('(-1,)')), "'x' is no array of numbers"),
    'too few': (array(npy_of_shape('(3, 2)', bytes(20))), r'\(3, 2\) needs 24 bytes, not 20'),
    'too many': (array(npy_of_shape('(3, 2)', bytes(28))), r'\(3, 2\) needs 24 bytes, not 28'),
    'huge': (array(npy_of_shape(f'({"9" * 18}, {"9" * 18})')), 'needs 39{17}.* bytes, not 0'),
    'overflow to zero': (array(npy_of_shape(f'({2**32}, {2**30})')), 'needs [0-9]+ bytes, not 0'),
    'nothing of huge things': (array(npy_of_shape(f'(0, {2**40}, {2**40})')), 'shape .*big|large'),
    '70 dimensions': (array(npy_of_shape(f'({"0, " * 69}0)')), 'shape .*dimension'),
    'header': (
        array(npy(np.zeros(2)).replace(b'\x76\x00', b'\x75\x00', 1)),
        "'x' has a header of 128",
    ),
    'not aligned': (
        array(b'\x93NUMPY\x01\x00\x3b\0' + npy_of_shape('(0,)')[10:68] + b'\n'),
        "'x' has a header of 69",
    ),
}


@pytest.mark.parametrize('fault', HOSTILE)
def test_a_hostile_file_is_refused_with_the_reason(tmp_path: Path, fault: str) -> None:
    content, reason = HOSTILE[fault]
    (tmp_path / 'bad.map').write_bytes(content)
    with bounded_memory(len(content)), pytest.raises(ArchiveError, match=rf'bad\.map: .*{reason}'):
        read_archive(tmp_path / 'bad.map')


def test_members_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small(tmp_path / 'a')
    for module in (archive, zip_members):
        monkeypatch.setattr(module, 'MEMBERS_LIMIT', 4)
    with pytest.raises(ArchiveError, match='more than 4 members'):
        read_archive(tmp_path / 'a')
    with pytest.raises(ArchiveError, match=r'b: not written: 5 members are more than 4'):
        small(tmp_path / 'b')


def test_members_have_a_largest_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archive, 'MEMBER_LIMIT', 8)
    write_archive(tmp_path / 'a', {'x': np.zeros(1)}, {}, {'y': bytes(8)})
    with pytest.raises(ArchiveError, match="'x' has 16 bytes, more than 8"):
        write_archive(tmp_path / 'a', {'x': np.zeros(2)}, {}, {})
    with pytest.raises(ArchiveError, match="'y' has 9 bytes, more than 8"):
        write_archive(tmp_path / 'a', {}, {}, {'y': bytes(9)})


UNWRITABLE: dict[str, tuple[dict[str, NDArray[Any]], dict[str, Any], dict[str, bytes], str]] = {
    'objects': ({'x': np.array([None])}, {}, {}, "array 'x' is object"),
    'complex': ({'x': np.zeros(1, complex)}, {}, {}, "array 'x' is complex128"),
    'big-endian': ({'x': np.zeros(1, '>f4')}, {}, {}, "array 'x' is >f4"),
    'large': ({'x': np.broadcast_to(0.0, 10**9)}, {}, {}, 'has 8000000000 bytes, more than 2000'),
    'array name': ({'a/b': np.zeros(1)}, {}, {}, "'a/b.npy' is no name"),
    'blob name': ({}, {}, {'../a': b''}, "'../a' is no name"),
    'array as blob': ({}, {}, {'x.npy': b''}, "blob 'x.npy' has the name of another kind"),
    'metadata as blob': ({}, {}, {'metadata.json': b''}, 'has the name of another kind'),
    'not finite': ({}, {'a': np.nan}, {}, 'metadata do not fit JSON: .*not JSON compliant'),
    'no json': ({}, {'a': np.zeros(1)}, {}, 'metadata do not fit JSON: .*ndarray'),
    'long': ({}, {'a': 'x' * 70_000}, {}, 'metadata take 70[0-9]{3} bytes, more than 65536'),
}


@pytest.mark.parametrize('fault', UNWRITABLE)
def test_what_could_not_be_read_is_not_written(tmp_path: Path, fault: str) -> None:
    arrays, metadata, blobs, reason = UNWRITABLE[fault]
    with pytest.raises(ArchiveError, match=f'a: not written: .*{reason}'):
        write_archive(tmp_path / 'a', arrays, metadata, blobs)
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_is_not_there_or_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ArchiveError, match='a: cannot be read: No such file'):
        read_archive(tmp_path / 'a')
    with pytest.raises(ArchiveError, match='cannot be read: Is a directory'):
        read_archive(tmp_path)
    with pytest.raises(ArchiveError, match='cannot be written: No such file'):
        write_archive(tmp_path / 'nowhere' / 'a', {}, {}, {})


def test_a_pipe_is_refused(tmp_path: Path) -> None:
    reading, writing = os.pipe()
    os.write(writing, small(tmp_path / 'a'))
    os.close(writing)
    with pytest.raises(ArchiveError, match=r'cannot be read: .*not seekable'):
        read_archive(f'/dev/fd/{reading}')
    os.close(reading)


def fails(*_: object) -> None:
    raise OSError('gone')  # without a number, as numpy raises it too


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / 'a'
    old = small(path)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, hard))
    try:
        for large in ({'x': np.zeros(100_000)}, {f'x{n}': np.zeros(10) for n in range(300)}):
            with pytest.raises(ArchiveError, match='a: cannot be written: File too large'):
                write_archive(path, large, {}, {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (path.read_bytes(), list(tmp_path.iterdir())) == (old, [path])
    monkeypatch.setattr(os, 'replace', fails)
    with pytest.raises(ArchiveError, match='a: cannot be written: gone'):
        write_archive(path, {}, {}, {})
    assert (path.read_bytes(), list(tmp_path.iterdir())) == (old, [path])


def damaged(good: bytes, seed: int) -> bytes:
    """Change a few bytes, or take some out."""
    rng = np.random.default_rng(seed)
    data = bytearray(good)
    if seed % 4 == 0 and data:
        start = rng.integers(len(data))
        del data[start : start + rng.integers(1, 20)]
    elif data:
        for position in rng.integers(len(data), size=rng.integers(1, 4)):
            data[position] = rng.integers(256)
    return bytes(data)


def read_or_refused(path: Path, content: bytes) -> bool:
    """Read within the bounds of memory; return whether that raised no `ArchiveError`."""
    path.write_bytes(content)
    with bounded_memory(len(content)):
        try:
            read_archive(path)
        except ArchiveError:
            return False
    return True


def test_damaged_files_are_read_or_refused_and_nothing_else(tmp_path: Path) -> None:
    good = unsealed_zip(small(tmp_path / 'a'))
    read = sum(read_or_refused(tmp_path / 'a', damaged(good, seed)) for seed in range(400))
    assert 0 < read < 200


def test_every_flipped_bit_is_found(tmp_path: Path) -> None:
    """Of members, of the headers between them, of the directory, of the digest itself."""
    good, path = small(tmp_path / 'a'), tmp_path / 'b'
    for position, bit in enumerate(np.random.default_rng(5).integers(8, size=len(good))):
        data = bytearray(good)
        data[position] ^= 1 << bit
        path.write_bytes(data)
        with pytest.raises(ArchiveError):
            read_archive(path)


def test_a_digest_that_is_missing_or_wrong_is_said(tmp_path: Path) -> None:
    path = tmp_path / 'a'
    good = small(path)
    path.write_bytes(good[:-1] + (b'0' if good[-1:] != b'0' else b'1'))
    with pytest.raises(ArchiveError, match='a: is damaged: its digest is not that of its cont'):
        read_archive(path)
    path.write_bytes(good[: -SEAL_LENGTH - 2] + bytes(2))
    with pytest.raises(ArchiveError, match='a: has no digest at its end'):
        read_archive(path)


def test_forged_members_are_read_or_refused_and_nothing_else(tmp_path: Path) -> None:
    """Damage the contents but not their CRC, so that the parsers read them."""
    (tmp_path / 'a').write_bytes(unsealed_zip(small(tmp_path / 'a')))
    with zipfile.ZipFile(tmp_path / 'a') as opened:
        members = {name: opened.read(name) for name in opened.namelist()}
    metadata = members.pop('metadata.json').decode()
    read = 0
    for seed in range(400):
        victim = ('', 'means.npy', 'ids.npy', 'none.npy')[seed % 16 // 4]
        head = damaged(metadata.encode(), seed).decode('latin-1') if not victim else metadata
        content = [
            (name, damaged(data, seed) if name == victim else data)
            for name, data in members.items()
        ]
        read += read_or_refused(tmp_path / 'a', packed(*content, metadata=head))
    assert 0 < read < 200
