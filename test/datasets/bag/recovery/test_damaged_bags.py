# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Of a damaged recording the good part is read, and then it is told what is lost."""

from __future__ import annotations

import resource
import shutil
import sqlite3
import struct
import tracemalloc
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

pytest.importorskip('rosbags')
pytest.importorskip('mcap')

from bags import (  # type: ignore[import-not-found]
    COLOR,
    INFO,
    MCAP,
    SQLITE,
    Entry,
    recording,
    various,
    write_bag,
    write_mcap,
    write_ros1,
)
from mcap.reader import make_reader
from mcap.writer import CompressionType
from rosbags.rosbag1 import Writer as Writer1

from dcgs_ros.datasets.bag.messages import RawMessage, decode
from dcgs_ros.datasets.bag.recording import custom_data, raw_messages, topic_types
from dcgs_ros.datasets.bag.recovery.losses import DamagedError
from dcgs_ros.datasets.bag.storage.files import is_bag
from dcgs_ros.datasets.source import SourceError
from dcgs_ros.io.ros_images import MessageError

FRAMES = 8
MAX_GROWTH_BYTES = 100e6
FOOTER_BYTES = 28  # behind its head; nothing in them is needed
GIGABYTE = 1 << 30
BOMB = (
    'a: &a0 [x]\n'
    + ''.join(f'a{k}: &a{k + 1} [{", ".join(10 * [f"*a{k}"])}]\n' for k in range(20))
    + 'rosbag2_bagfile_information:\n  relative_file_paths: [*a20]\n  custom_data: {b: *a20}\n'
    '  topics_with_message_count: [{topic_metadata: {name: b}, message_count: *a20}]'
)
LYING = (0, 1, 255, 2**31, 2**32 - 1, 2**40, 2**63, 2**64 - 1)
FOOTER = struct.pack('<BQ', 2, 20) + bytes(20)


def recovered(path: Path, heads: bool = False) -> tuple[list[RawMessage], str]:
    """Messages that can be read, and what is said of the others ('' where there are none)."""
    messages = []
    try:
        for message in raw_messages(path, None, heads):
            messages.append(message)
    except SourceError as error:
        assert isinstance(error, DamagedError) or not messages
        return messages, str(error)
    return messages, ''


def entries() -> list[RawMessage]:
    return [RawMessage(*entry) for entry in sorted(recording(FRAMES), key=lambda e: e[2])]


def is_part(part: list[RawMessage], whole: list[RawMessage]) -> bool:
    return Counter(part) <= Counter(whole)


@pytest.mark.parametrize('compression', CompressionType)
def test_an_mcap_cut_off_anywhere_gives_what_is_before(
    tmp_path: Path, compression: CompressionType
) -> None:
    path = write_mcap(
        tmp_path / 'a.mcap', recording(FRAMES), chunk_size=30_000, compression=compression
    )
    whole = path.read_bytes()
    previous = 0
    for size in [*range(0, len(whole), len(whole) // 30), len(whole) - 1]:
        path.write_bytes(whole[:size])
        messages, loss = recovered(path)
        assert messages == entries()[: len(messages)]
        assert len(messages) >= previous
        assert loss or size >= len(whole) - FOOTER_BYTES
        previous = len(messages)
    assert previous == len(entries())


def test_an_mcap_that_was_never_closed_is_read(tmp_path: Path) -> None:
    class KilledError(Exception):
        pass

    def until_killed():  # type: ignore[no-untyped-def]
        yield from recording(FRAMES)
        raise KilledError

    path = tmp_path / 'a.mcap'
    with pytest.raises(KilledError):
        write_mcap(path, until_killed(), use_chunking=False)
    messages, loss = recovered(path)
    assert messages == entries()
    assert f'{len(messages)} messages could be read: a.mcap: never closed' in loss
    assert topic_types(path) == {message.topic: message.type for message in messages}


def test_a_damaged_chunk_costs_only_its_messages(tmp_path: Path) -> None:
    path = write_mcap(
        tmp_path / 'a.mcap', recording(FRAMES), chunk_size=30_000, compression=CompressionType.NONE
    )
    data = bytearray(path.read_bytes())
    lost = entries()[FRAMES]
    data[data.index(lost.cdr) + 5000] ^= 1
    path.write_bytes(data)
    messages, loss = recovered(path)
    assert is_part(messages, entries())
    assert lost not in messages
    assert messages[0] == entries()[0] and messages[-1] == entries()[-1]
    assert len(messages) > len(entries()) / 2
    assert 'chunk at byte' in loss and 'checksum' in loss


@pytest.mark.parametrize('length', [0, 1, 2**32, 2**64 - 1])
def test_behind_a_gap_the_index_leads_on(tmp_path: Path, length: int) -> None:
    path = write_mcap(tmp_path / 'a.mcap', recording(FRAMES), chunk_size=30_000)
    data = bytearray(path.read_bytes())
    with path.open('rb') as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    at = summary.chunk_indexes[1].chunk_start_offset
    data[at + 1 : at + 9] = struct.pack('<Q', length)
    path.write_bytes(data)
    messages, loss = recovered(path)
    per_chunk = -(-len(entries()) // len(summary.chunk_indexes))
    assert is_part(messages, entries())
    assert len(entries()) - per_chunk <= len(messages) < len(entries())
    assert messages[-1] == entries()[-1]
    assert 'byte' in loss


def test_how_many_messages_there_were_is_told(tmp_path: Path) -> None:
    folder = write_bag(tmp_path / 'bag', recording(200), MCAP)
    file = folder / 'bag.mcap'
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    messages, loss = recovered(folder)
    assert 0 < len(messages) < 600
    assert f'{len(messages)} of 600 messages could be read: bag.mcap: cut off' in loss
    with pytest.raises(DamagedError, match=' of 200 messages'):
        list(raw_messages(folder, [COLOR]))


@pytest.mark.parametrize('plugin', [MCAP, SQLITE])
def test_a_missing_file_and_an_empty_one_are_told(tmp_path: Path, plugin: int) -> None:
    folder = write_bag(tmp_path / 'bag', recording(FRAMES), plugin)
    (file,) = [file for file in folder.iterdir() if file.suffix != '.yaml']
    metadata = folder / 'metadata.yaml'
    content = yaml.safe_load(metadata.read_text())
    paths = content['rosbag2_bagfile_information']['relative_file_paths']
    paths.append(f'../../elsewhere{file.suffix}')
    metadata.write_text(yaml.safe_dump(content))
    messages, loss = recovered(folder)
    assert messages == entries()
    assert f'elsewhere{file.suffix} is missing' in loss and '..' not in loss.split(':')[-1]
    (folder / f'elsewhere{file.suffix}').touch()
    messages, loss = recovered(folder)
    assert messages == entries()
    assert f'elsewhere{file.suffix}: no ' in loss
    file.write_bytes(b'')
    with pytest.raises(SourceError, match='cannot be read: '):
        next(raw_messages(folder, None))
    with pytest.raises(SourceError, match='cannot be read: '):
        topic_types(folder)


@pytest.mark.parametrize(
    'text',
    [
        '',
        '\0\1\2',
        '[' * 1000,
        'a: &a [*a, 2020-99-99]',
        'rosbag2_bagfile_information: 3',
        'rosbag2_bagfile_information: {relative_file_paths: 7, custom_data: 8}',
        'rosbag2_bagfile_information: {relative_file_paths: [[], {}, ..], message_count: x}',
        'rosbag2_bagfile_information: {relative_file_paths: [metadata.yaml, "\\0", /etc/passwd]}',
        'rosbag2_bagfile_information: {relative_file_paths: [bag.db3, a/bag.db3, ../bag.db3]}',
        f'rosbag2_bagfile_information: {{relative_file_paths: [{"n" * 5000}.db3]}}',
        'a: !!timestamp noon',
        BOMB,
        'rosbag2_bagfile_information: {topics_with_message_count: [1, {topic_metadata: 2}]}',
    ],
)
def test_metadata_that_are_garbage_are_as_none(tmp_path: Path, text: str) -> None:
    folder = write_bag(tmp_path / 'bag', recording(FRAMES), SQLITE)
    (folder / 'metadata.yaml').write_text(text)
    assert is_bag(folder)
    assert custom_data(folder) == {}
    messages, loss = recovered(folder)
    assert messages == entries()
    assert ('missing' in loss) == any(word in text for word in ('..]', 'passwd', 'nnn'))


def test_counts_that_lie_are_not_repeated(tmp_path: Path) -> None:
    folder = write_bag(tmp_path / 'bag', recording(FRAMES), MCAP)
    metadata = folder / 'metadata.yaml'
    metadata.write_text(
        metadata.read_text().replace(f'message_count: {FRAMES}', 'message_count: 1')
    )
    assert recovered(folder) == (entries(), '')
    (folder / 'bag.mcap').write_bytes((folder / 'bag.mcap').read_bytes()[:-38])
    assert f': {len(entries())} messages could be read' in recovered(folder)[1]


def test_recordings_of_nothing_are_empty(tmp_path: Path) -> None:
    for path in (
        write_bag(tmp_path / 'mcap', [], MCAP),
        write_bag(tmp_path / 'sqlite', [], SQLITE),
        write_mcap(tmp_path / 'a.mcap', []),
        write_ros1(tmp_path / 'a.bag', []),
    ):
        assert recovered(path) == ([], '')
        assert topic_types(path) == {}


@pytest.mark.parametrize('suffix', ['.mcap', '.db3', '.bag', '.mcap.zstd', '.db3.zstd'])
@pytest.mark.parametrize('content', [b'', b'x', b'not a recording' * 1000])
def test_what_is_no_recording_is_refused_at_once(
    tmp_path: Path, suffix: str, content: bytes
) -> None:
    path = tmp_path / f'a{suffix}'
    path.write_bytes(content)
    for read in (lambda: next(raw_messages(path, None)), lambda: topic_types(path)):
        with pytest.raises(SourceError, match=str(path)) as error:
            read()
        assert not isinstance(error.value, DamagedError)


def sqlite_file(tmp_path: Path, messages: list[Entry] | None = None) -> Path:
    folder = write_bag(tmp_path / 'bag', messages or list(recording(FRAMES)), SQLITE)
    return next(folder.glob('*.db3')).rename(tmp_path / 'a.db3')


def test_an_sqlite_file_cut_off_gives_what_is_before(tmp_path: Path) -> None:
    path = sqlite_file(tmp_path)
    whole = path.read_bytes()
    numbers = []
    for size in range(len(whole) - 1, 0, -len(whole) // 30):
        path.write_bytes(whole[:size])
        messages, loss = recovered(path)
        broken = [message for message in messages if message not in entries()]
        assert len(broken) <= 1  # whose last page is incomplete
        assert loss
        numbers.append(len(messages))
    assert max(numbers) >= len(entries()) - 1
    assert sum(numbers) > len(numbers) * len(entries()) / 3


def test_a_bad_page_costs_the_messages_on_it(tmp_path: Path) -> None:
    path = sqlite_file(tmp_path)
    whole = path.read_bytes()
    losses = 0
    for page in range(5, len(whole) // 4096, 2):
        path.write_bytes(whole[: page * 4096] + b'\xa5' * 4096 + whole[(page + 1) * 4096 :])
        messages, loss = recovered(path)
        good = [message for message in messages if message in entries()]
        if page > 7:  # where topics, index and the table's root are not
            assert len(good) >= len(entries()) - 6
        losses += bool(loss)
    assert losses


def test_what_a_writer_has_not_merged_is_read(tmp_path: Path) -> None:
    path = sqlite_file(tmp_path)
    copy = tmp_path / 'copy.db3'
    with sqlite3.connect(path) as db:
        db.execute('PRAGMA journal_mode = WAL')
        late = entries()[-1].stamp_ns + 1
        db.execute(
            'INSERT INTO messages (topic_id, timestamp, data) VALUES (1, ?, ?)', (late, b'a')
        )
        db.commit()
        for suffix in ('', '-wal'):
            shutil.copy(f'{path}{suffix}', f'{copy}{suffix}')
        messages, loss = recovered(copy)
    assert (messages[:-1], loss) == (entries(), '')
    assert (messages[-1].stamp_ns, messages[-1].cdr) == (late, b'a')
    Path(f'{copy}-wal').write_bytes(b'x' * 5000)
    assert is_part(entries(), recovered(copy)[0])


@pytest.mark.parametrize(
    'messages',
    [
        'VIEW messages AS WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) '
        'SELECT x id, x timestamp FROM c',
        'TABLE messages (id INTEGER PRIMARY KEY, topic_id, timestamp, data AS (zeroblob(9)))',
    ],
)
def test_tables_that_compute_are_refused(tmp_path: Path, messages: str) -> None:
    path = tmp_path / 'a.db3'
    with sqlite3.connect(path) as db:
        db.execute('CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT, type TEXT)')
        db.execute(f'CREATE {messages}')
    with pytest.raises(SourceError, match='1 of the 2 tables'):
        next(raw_messages(path, None))


def test_columns_of_other_types_are_lost(tmp_path: Path) -> None:
    path = sqlite_file(tmp_path)
    with sqlite3.connect(path) as db:
        db.execute("UPDATE messages SET data = 'text' WHERE id = 2")
        db.execute('UPDATE messages SET data = 7 WHERE id = 3')
        db.execute("UPDATE messages SET timestamp = 'noon' WHERE id = 4")
        db.execute('UPDATE messages SET topic_id = 99 WHERE id = 5')
    messages, loss = recovered(path)
    assert is_part(messages, entries())
    assert len(messages) == len(entries()) - 4
    assert 'message 2: its data are str (and 1 more)' in loss


def test_a_bag_of_ros_1_that_was_not_closed_is_to_be_reindexed(tmp_path: Path) -> None:
    path = write_ros1(tmp_path / 'a.bag', recording(FRAMES))
    whole = path.read_bytes()
    for size in (5000, len(whole) // 2, len(whole) - 3):
        path.write_bytes(whole[:size])
        with pytest.raises(SourceError, match="'rosbag reindex' repairs it"):
            next(raw_messages(path, None))


def test_a_damaged_chunk_of_ros_1_ends_the_good_part(tmp_path: Path) -> None:
    path = write_ros1(tmp_path / 'a.bag', recording(FRAMES), Writer1.CompressionFormat.BZ2)
    data = bytearray(path.read_bytes())
    at = len(data) // 2
    data[at : at + 64] = bytes(64)
    path.write_bytes(data)
    messages, loss = recovered(path)
    assert 0 < len(messages) < len(entries())
    assert messages == entries()[: len(messages)]
    assert 'a chunk cannot be read' in loss


def chunk(size: int, compression: bytes, data: bytes) -> bytes:
    """Return an MCAP with one chunk that says this of itself."""
    text = struct.pack('<I', len(compression)) + compression
    body = struct.pack('<QQQI', 1, 2, size, 0) + text + struct.pack('<Q', len(data)) + data
    return b'\x89MCAP0\r\n' + struct.pack('<BQ', 6, len(body)) + body + FOOTER


@pytest.mark.parametrize('told', [1000, GIGABYTE - 1, GIGABYTE, 2**63])
@pytest.mark.parametrize('compression', ['zstd', 'lz4', '', 'other'])
def test_sizes_that_lie_are_not_believed(tmp_path: Path, told: int, compression: str) -> None:
    import lz4.frame  # type: ignore[import-untyped]
    import zstandard

    compressors = {
        'zstd': zstandard.ZstdCompressor().compressobj,  # which does not tell the size
        'lz4': lz4.frame.LZ4FrameCompressor,
    }
    packed = b'zeros'
    if compression in compressors:
        packer = compressors[compression]()
        begin = packer.begin() if compression == 'lz4' else b''
        megabyte = bytes(1 << 20)
        packed = begin + b''.join(packer.compress(megabyte) for _ in range(300)) + packer.flush()
    (tmp_path / 'a.mcap').write_bytes(chunk(told, compression.encode(), packed))
    tracemalloc.start()
    messages, loss = recovered(tmp_path / 'a.mcap')
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert not messages
    assert 'chunk at byte' in loss
    assert peak < MAX_GROWTH_BYTES


def peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Return the bytes with flips, a cut, a block put elsewhere or a length that lies."""
    out = bytearray(data)
    kind = rng.integers(4)
    if kind == 0:
        for at in rng.integers(len(out), size=rng.integers(1, 20)):
            out[at] ^= 1 << rng.integers(8)
    elif kind == 1:
        del out[rng.integers(len(out)) :]
    elif kind == 2:
        start, at, size = rng.integers(len(out), size=3)
        out[at : at + rng.integers(2) * size] = data[start : start + size]
    else:
        at = rng.integers(len(out))
        number = LYING[rng.integers(len(LYING))]
        out[at : at + 8] = struct.pack('<Q', number)
    return bytes(out)


def tiny() -> list[Entry]:
    """Messages of all types, without much of an image."""
    return [*various(), *(entry for entry in recording(1) if entry.topic == INFO)]


WRITERS: dict[str, Callable[[Path], Path]] = {
    'mcap': lambda path: write_mcap(path / 'a.mcap', tiny(), chunk_size=500),
    'mcap, lz4': lambda path: write_mcap(
        path / 'a.mcap', tiny(), compression=CompressionType.LZ4, enable_crcs=False
    ),
    'mcap, plain': lambda path: write_mcap(path / 'a.mcap', tiny(), use_chunking=False),
    'sqlite': lambda path: sqlite_file(path, tiny()),
    'ROS 1': lambda path: write_ros1(path / 'a.bag', tiny()),
}


def fuzz(tmp_path: Path, kind: str, times: int, seed: int) -> None:
    path = WRITERS[kind](tmp_path)
    whole = path.read_bytes()
    assert len(recovered(path)[0]) == len(tiny())
    before = peak_bytes()
    rng = np.random.default_rng(seed)
    for _ in range(times):
        path.write_bytes(mutated(whole, rng))
        messages, _ = recovered(path)
        recovered(path, heads=True)
        for message in messages:
            try:
                decode(message.cdr, message.type)
            except MessageError:
                pass
        try:
            topic_types(path)
        except SourceError:
            pass
    assert peak_bytes() - before < MAX_GROWTH_BYTES


@pytest.mark.parametrize('kind', WRITERS)
def test_no_damage_is_more_than_a_loss(tmp_path: Path, kind: str) -> None:
    fuzz(tmp_path, kind, 20, 1)


@pytest.mark.slow
@pytest.mark.parametrize('kind', WRITERS)
def test_no_damage_of_5000_is_more_than_a_loss(tmp_path: Path, kind: str) -> None:
    fuzz(tmp_path, kind, 5000, 2)
