# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Reading SQLite files of rosbag2.

Messages are looked up one by one, in the order of an index that is read first: no sort moves
images in memory, and a damaged page costs only the messages on it.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path

from ...source import SourceError
from ..messages import RawMessage
from ..recovery.losses import skipping
from ..recovery.sqlite import add_without_index, note_cut_off, open_without_wal
from .compression import unpack

_BUSY_S = 1.0
# A recording is not trusted: its views, virtual tables and computed columns would run queries.
_TABLES = (
    "SELECT count(*) FROM sqlite_master AS t WHERE type = 'table' AND sql LIKE 'CREATE TABLE%' "
    "AND name IN ('topics', 'messages') "
    'AND NOT EXISTS (SELECT 1 FROM pragma_table_xinfo(t.name) WHERE hidden)'
)


def read_sqlite(
    path: Path, topics: Collection[str] | None, losses: list[str]
) -> Iterator[RawMessage]:
    """Read the messages of those topics, or all, in order of their stamps.

    What is damaged is skipped and appended to `losses`. Raises `SourceError` if the file is no
    recording at all.
    """
    with closing(_open(path, losses)) as db:
        names = _topics(db, losses)
        wanted = [key for key, (topic, _) in names.items() if topics is None or topic in topics]
        query = (
            'SELECT topic_id, data FROM messages WHERE id = ? '
            f'AND (topic_id IN ({",".join("?" * len(wanted))}))'
        )
        for row, stamp_ns in _rows(db, losses):
            try:
                found = db.execute(query, (row, *wanted)).fetchone()
                if found is None:
                    continue
                message = _message(names, stamp_ns, *found)
            except (sqlite3.Error, ValueError, LookupError, MemoryError) as error:
                losses.append(f'message {row}: {error}')
                continue
            yield message


def sqlite_types(path: Path) -> dict[str, str] | None:
    """Return the types of the topics that hold messages; None if the file is damaged."""
    losses: list[str] = []
    try:
        with closing(_open(path, losses)) as db:
            exists = 'SELECT 1 FROM messages WHERE topic_id = ? LIMIT 1'
            names = _topics(db, losses).items()
            types = dict(name for key, name in names if db.execute(exists, (key,)).fetchone())
    except sqlite3.Error:
        return None
    return None if losses else types


def _open(path: Path, losses: list[str]) -> sqlite3.Connection:
    """Open for reading, together with what a writer has not merged yet (the file's -wal)."""
    try:
        db = _connect(path, 'mode=ro')
    except sqlite3.Error as error:
        db = open_without_wal(path, _connect, error, losses)
    note_cut_off(path, losses)
    return db


def _connect(path: Path, mode: str) -> sqlite3.Connection:
    """Connect and check the tables; raises `sqlite3.Error`, or `SourceError` for other tables."""
    uri = f'{path.resolve().as_uri()}?{mode}'
    db = sqlite3.connect(uri, _BUSY_S, uri=True, check_same_thread=False)
    db.text_factory = lambda text: text.decode(errors='replace')
    try:
        db.execute('PRAGMA writable_schema = ON')  # else SQLite refuses a file that is cut off
        db.execute('PRAGMA trusted_schema = OFF')
        tables = db.execute(_TABLES).fetchone()[0]
        if tables != 2:
            raise SourceError(f'no recording: it has {tables} of the 2 tables')
    except (sqlite3.Error, SourceError):
        db.close()
        raise
    return db


def _topics(db: sqlite3.Connection, losses: list[str]) -> dict[int, tuple[str, str]]:
    """Return name and type of each topic, by its key."""
    names = {}
    with skipping(losses, 'its topics', sqlite3.Error):
        for key, name, type_ in db.execute('SELECT id, name, type FROM topics'):
            names[key] = str(name), str(type_)
    return names


def _rows(db: sqlite3.Connection, losses: list[str]) -> list[tuple[int, int]]:
    """Return keys and stamps in ns of the messages, by stamp."""
    stamps: dict[int, int] = {}
    try:
        _add_rows(db, 'ORDER BY timestamp', stamps)  # for which SQLite reads only an index
    except sqlite3.Error as error:
        add_without_index(db, _add_rows, stamps, error, losses)
    return sorted(stamps.items(), key=lambda item: item[1])


def _add_rows(db: sqlite3.Connection, clause: str, stamps: dict[int, int]) -> None:
    """Add the messages' stamps in ns by their keys; raises `sqlite3.Error` after the good ones."""
    for row, stamp_ns in db.execute(f'SELECT id, timestamp FROM messages {clause}'):
        if isinstance(row, int) and isinstance(stamp_ns, int):
            stamps[row] = stamp_ns


def _message(
    names: dict[int, tuple[str, str]], stamp_ns: int, topic_id: int, data: object
) -> RawMessage:
    """Return the message of a row; raises `LookupError` or `ValueError`."""
    topic, type_ = names[topic_id]
    if not isinstance(data, bytes):
        raise ValueError(f'its data are {type(data).__name__}')
    return RawMessage(topic, type_, stamp_ns, unpack(data))
