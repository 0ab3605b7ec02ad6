# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Whatever a recording is kept in, its messages are those that were recorded."""

from __future__ import annotations

import gc
import shutil
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

pytest.importorskip('rosbags')
pytest.importorskip('mcap_ros2')

from bags import (  # type: ignore[import-not-found]
    COLOR,
    DEPTH,
    INFO,
    MCAP,
    SQLITE,
    START_NS,
    TYPES,
    Entry,
    color_of,
    image_entry,
    recording,
    various,
    write_bag,
    write_mcap,
    write_ros1,
)
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from dcgs_ros.datasets.bag.messages import IMAGE, RawMessage, decode
from dcgs_ros.datasets.bag.recording import custom_data, raw_messages, topic_types
from dcgs_ros.datasets.bag.storage.files import is_bag
from dcgs_ros.datasets.source import SourceError

Write = Callable[[Path, list[Entry]], Path]

HEADER_BYTES = 1000  # more than a header has
FLAT_BYTES = 3_000_000  # more than the messages of two chunks, less than those of 300 frames


def compressed(mode: CompressionMode, plugin: StoragePlugin) -> Write:
    """Return a writer of folders with zstd."""

    def write(path: Path, entries: list[Entry]) -> Path:
        writer = Writer(path / 'bag', version=9, storage_plugin=plugin)
        writer.set_compression(mode, CompressionFormat.ZSTD)
        return write_bag(path / 'bag', entries, writer=writer)

    return write


def alone(plugin: StoragePlugin) -> Write:
    def write(path: Path, entries: list[Entry]) -> Path:
        folder = write_bag(path / 'bag', entries, plugin)
        (file,) = [file for file in folder.iterdir() if file.suffix != '.yaml']
        return file.rename(path / file.name)

    return write


def by_mcap(**options: Any) -> Write:
    return lambda path, entries: write_mcap(path / 'a.mcap', entries, **options)


def ros1(compression: Writer1.CompressionFormat | None) -> Write:
    return lambda path, entries: write_ros1(path / 'a.bag', entries, compression)


KINDS: dict[str, Write] = {
    'mcap folder': lambda path, entries: write_bag(path / 'bag', entries, MCAP),
    'sqlite folder': lambda path, entries: write_bag(path / 'bag', entries, SQLITE),
    'mcap alone': alone(MCAP),
    'sqlite alone': alone(SQLITE),
    'mcap, zstd files': compressed(CompressionMode.FILE, MCAP),
    'sqlite, zstd files': compressed(CompressionMode.FILE, SQLITE),
    'sqlite, zstd messages': compressed(CompressionMode.MESSAGE, SQLITE),
    'mcap, zstd chunks': by_mcap(compression=CompressionType.ZSTD, chunk_size=30_000),
    'mcap, lz4 chunks': by_mcap(compression=CompressionType.LZ4, chunk_size=30_000),
    'mcap, no chunks': by_mcap(use_chunking=False),
    'mcap, no index': by_mcap(
        index_types=IndexType.NONE,
        use_statistics=False,
        repeat_channels=False,
        repeat_schemas=False,
    ),
    'ROS 1': ros1(None),
    'ROS 1, bz2': ros1(Writer1.CompressionFormat.BZ2),
    'ROS 1, lz4': ros1(Writer1.CompressionFormat.LZ4),
}


def as_read(entries: list[Entry]) -> list[RawMessage]:
    return [RawMessage(*entry) for entry in sorted(entries, key=lambda e: e.recorded_ns)]


@pytest.mark.parametrize('kind', KINDS)
def test_messages_are_those_recorded(tmp_path: Path, kind: str) -> None:
    entries = [*various(), *recording(4)]
    path = KINDS[kind](tmp_path, entries)
    assert is_bag(path)
    assert list(raw_messages(path, None)) == as_read(entries)
    assert topic_types(path) == {entry.topic: entry.type for entry in entries}
    chosen = [entry for entry in entries if entry.topic in (COLOR, INFO)]
    assert list(raw_messages(path, (COLOR, INFO))) == as_read(chosen)
    assert list(raw_messages(path, ('/elsewhere',))) == []
    for message in raw_messages(path, None):
        np.testing.assert_equal(
            vars(decode(message.cdr, message.type)),
            vars(TYPES.deserialize_cdr(message.cdr, message.type)),
        )


@pytest.mark.parametrize('kind', KINDS)
def test_heads_are_how_messages_begin(tmp_path: Path, kind: str) -> None:
    entries = [*various(), *recording(4)]
    path = KINDS[kind](tmp_path, entries)
    heads = list(raw_messages(path, None, heads=True))
    for head, whole in zip(heads, as_read(entries), strict=True):
        assert head[:3] == whole[:3]
        assert whole.cdr.startswith(head.cdr)
        assert len(head.cdr) >= min(len(whole.cdr), HEADER_BYTES)
    if kind == 'mcap folder':
        assert sum(len(head.cdr) for head in heads) < sum(len(entry.cdr) for entry in entries)


@pytest.mark.parametrize('kind', [kind for kind in KINDS if 'mcap, ' not in kind])
def test_rosbags_reads_the_same(tmp_path: Path, kind: str) -> None:
    path = KINDS[kind](tmp_path, list(recording(5)))
    with AnyReader([path]) as reader:
        theirs = [(c, stamp_ns, data) for c, stamp_ns, data in reader.messages()]
        ours = list(raw_messages(path, None))
        for message, (connection, stamp_ns, data) in zip(ours, theirs, strict=True):
            assert message[:3] == (connection.topic, connection.msgtype, stamp_ns)
            if reader.is2:
                assert message.cdr == data
            elif message.type == IMAGE:
                their: Any = reader.deserialize(data, message.type)
                np.testing.assert_array_equal(decode(message.cdr, IMAGE).data, their.data)


@pytest.mark.parametrize(
    'kind', [kind for kind in KINDS if 'mcap, ' in kind and 'files' not in kind]
)
def test_the_mcap_library_reads_the_same(tmp_path: Path, kind: str) -> None:
    path = KINDS[kind](tmp_path, list(recording(5)))
    with path.open('rb') as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        theirs = [
            (RawMessage(channel.topic, schema.name, message.log_time, message.data), decoded)
            for schema, channel, message, decoded in reader.iter_decoded_messages()
            if schema is not None
        ]
    ours = list(raw_messages(path, None))
    assert ours == [message for message, _ in theirs]
    for message, decoded in theirs:
        mine = decode(message.cdr, message.type)
        assert mine.header.stamp.nanosec == decoded.header.stamp.nanosec
        assert (mine.width, mine.height) == (decoded.width, decoded.height)


@given(
    messages=st.lists(
        st.tuples(st.sampled_from('abc'), st.integers(0, 2**62), st.binary(max_size=80)),
        min_size=1,
    )
)
@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@pytest.mark.parametrize('plugin', [MCAP, SQLITE])
def test_any_bytes_at_any_time_come_back(
    tmp_path_factory: pytest.TempPathFactory, plugin: int, messages: list[tuple[str, int, bytes]]
) -> None:
    entries = [
        Entry(f'/{topic}', 'std_msgs/msg/String', stamp_ns, b'\0\1\0\0' + data)
        for topic, stamp_ns, data in messages
    ]
    path = write_bag(tmp_path_factory.mktemp('any') / 'bag', entries, plugin)
    read = list(raw_messages(path, None))
    assert [m.stamp_ns for m in read] == sorted(e.recorded_ns for e in entries)
    assert sorted(read) == sorted(RawMessage(*e) for e in entries)
    shutil.rmtree(path)


def test_chunks_that_overlap_are_merged(tmp_path: Path) -> None:
    by_topic = sorted(recording(20), key=lambda entry: entry.topic)
    path = write_mcap(tmp_path / 'a.mcap', by_topic, chunk_size=30_000)
    assert list(raw_messages(path, None)) == as_read(by_topic)


def test_a_topic_without_messages_is_none(tmp_path: Path) -> None:
    for plugin in (MCAP, SQLITE):
        with Writer(tmp_path / str(plugin), version=9, storage_plugin=plugin) as writer:
            writer.add_connection('/silent', 'std_msgs/msg/String', typestore=TYPES)
            entry = image_entry(COLOR, START_NS, 'rgb8', color_of(0))
            connection = writer.add_connection(COLOR, entry.type, typestore=TYPES)
            writer.write(connection, entry.recorded_ns, entry.cdr)
        assert topic_types(tmp_path / str(plugin)) == {COLOR: entry.type}


@pytest.mark.parametrize('plugin', [MCAP, SQLITE])
def test_files_without_metadata_are_read_in_the_order_of_their_numbers(
    tmp_path: Path, plugin: int
) -> None:
    entries = list(recording(12))
    folder = tmp_path / 'split'
    folder.mkdir()
    for k in range(12):
        part = write_bag(tmp_path / f'part{k}', entries[3 * k : 3 * k + 3], plugin)
        (file,) = [file for file in part.iterdir() if file.suffix != '.yaml']
        file.rename(folder / f'split_{k}{file.suffix}')
    assert is_bag(folder)
    assert list(raw_messages(folder, None)) == as_read(entries)
    assert topic_types(folder) == {entry.topic: entry.type for entry in entries}
    assert custom_data(folder) == {}


def test_what_the_recorder_noted_is_read(tmp_path: Path) -> None:
    writer = Writer(tmp_path / 'bag', version=9, storage_plugin=MCAP)
    writer.set_custom_data('dcgs_ros.sensor', '{"a": 1.5}')
    folder = write_bag(tmp_path / 'bag', recording(1), writer=writer)
    assert custom_data(folder) == {'dcgs_ros.sensor': '{"a": 1.5}'}
    assert custom_data(folder / 'bag.mcap') == {'dcgs_ros.sensor': '{"a": 1.5}'}
    (folder / 'bag.mcap').rename(folder / 'another.mcap')
    assert custom_data(folder / 'another.mcap') == {}
    (folder / 'metadata.yaml').write_text('rosbag2_bagfile_information: {custom_data: [1, 2')
    assert custom_data(folder) == {}


def test_recordings_are_known_by_their_names(tmp_path: Path) -> None:
    for name in ('a.mcap', 'a.db3', 'a.bag', 'a.mcap.zstd', 'a.png', 'a.zstd'):
        (tmp_path / name).touch()
        assert is_bag(tmp_path / name) == ('png' not in name and name != 'a.zstd')
    (tmp_path / 'empty').mkdir()
    assert not is_bag(tmp_path / 'empty')
    assert not is_bag(tmp_path / 'nowhere.mcap')
    for path in (tmp_path / 'empty', tmp_path / 'nowhere.mcap', tmp_path / 'a.png'):
        with pytest.raises(SourceError, match='no recording'):
            list(raw_messages(path, None))


@pytest.mark.slow
@pytest.mark.parametrize('kind', ['mcap folder', 'sqlite folder', 'ROS 1', 'mcap, zstd chunks'])
def test_memory_does_not_grow_with_the_messages(tmp_path: Path, kind: str) -> None:
    path = KINDS[kind](tmp_path, list(recording(300)))
    next(raw_messages(path, None))
    gc.collect()
    tracemalloc.start()
    total = sum(len(message.cdr) for message in raw_messages(path, (COLOR, DEPTH)))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < FLAT_BYTES < total
