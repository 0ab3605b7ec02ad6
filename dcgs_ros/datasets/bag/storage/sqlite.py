# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""SQLite files of rosbag2, whole or damaged.

Rows are looked up one by one, in the order of an index made first, so a bad page costs its rows
and no sort moves images about.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path

from ...source import SourceError
from .compression import unpack
from .files import RawMessage

_BUSY_S = 1.0
# Views, virtual tables and columns that are computed would run what a stranger wrote.
_TABLES = (
    "SELECT count(*) FROM sqlite_master AS t WHERE type = 'table' AND sql LIKE 'CREATE TABLE%' "
    "AND name IN ('topics', 'messages') "
    'AND NOT EXISTS (SELECT 1 FROM pragma_table_xinfo(t.name) WHERE hidden)'
)
_HEADER_BYTES = 100  # https://www.sqlite.org/fileformat.html, 1.3


def read_sqlite(
    path: Path, topics: Collection[str] | None, losses: list[str]
) -> Iterator[RawMessage]:
    """Read messages of those topics, or all, in order of their stamps; tell what is lost.

    Raises `SourceError` for what is no recording at all.
    """
    with closing(_open(path, losses)) as db:
        names = _topics(db, losses)
        wanted = [key for key, (topic, _) in names.items() if topics is None or topic in topics]
        query = (
            'SELECT topic_id, data FROM messages WHERE id = ? '
            f'AND (topic_id IN ({",".join("?" * len(wanted))}))'
        )
        failures: list[str] = []
        for row, stamp_ns in _rows(db, losses):
            try:
                found = db.execute(query, (row, *wanted)).fetchone()
                if found is None:
                    continue
                topic, type_ = names[found[0]]
                data = found[1]
                if not isinstance(data, bytes):
                    raise ValueError(f'its data are {type(data).__name__}')
                cdr = unpack(data)
            except (sqlite3.Error, ValueError, LookupError, MemoryError) as error:
                failures.append(f'message {row}: {error}')
                continue
            yield RawMessage(topic, type_, stamp_ns, cdr)
        losses += failures


def sqlite_types(path: Path) -> dict[str, str] | None:
    """Types of the topics that hold messages, if the file is whole enough to tell."""
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
    """Open for reading, together with what a writer has not yet merged (its -wal)."""
    reason: sqlite3.Error | None = None
    for mode in ('mode=ro', 'immutable=1'):  # the latter where locks or the -wal are in the way
        db = sqlite3.connect(
            f'{path.resolve().as_uri()}?{mode}', _BUSY_S, uri=True, check_same_thread=False
        )
        db.text_factory = lambda text: text.decode(errors='replace')
        try:
            db.execute('PRAGMA writable_schema = ON')  # else a file cut off is refused
            db.execute('PRAGMA trusted_schema = OFF')
            tables = db.execute(_TABLES).fetchone()[0]
        except sqlite3.Error as error:
            db.close()
            reason = error
            continue
        if tables != 2:
            db.close()
            raise SourceError(f'no recording: it has {tables} of the 2 tables')
        if reason is not None:
            losses.append(f'what is not yet merged into it is left out: {reason}')
        if (cut := _cut_off(path)) is not None:
            losses.append(cut)
        return db
    raise SourceError(f'no SQLite file that can be read: {reason}')


def _cut_off(path: Path) -> str | None:
    """Say by how much the file is shorter than its header says."""
    with path.open('rb') as file:
        header = file.read(_HEADER_BYTES)
    if len(header) < _HEADER_BYTES:
        return None
    (page,) = struct.unpack_from('>H', header, 16)
    changes, pages = struct.unpack_from('>II', header, 24)
    (valid,) = struct.unpack_from('>I', header, 92)  # the change that `pages` belongs to
    expected = pages * (65536 if page == 1 else page)
    size = path.stat().st_size
    if changes != valid or size >= expected:
        return None
    return f'cut off at {size} of {expected} bytes'


def _topics(db: sqlite3.Connection, losses: list[str]) -> dict[int, tuple[str, str]]:
    """Name and type of each topic, by its key."""
    names = {}
    try:
        for key, name, type_ in db.execute('SELECT id, name, type FROM topics'):
            names[key] = str(name), str(type_)
    except sqlite3.Error as error:
        losses.append(f'its topics: {error}')
    return names


def _rows(db: sqlite3.Connection, losses: list[str]) -> list[tuple[int, int]]:
    """Keys and stamps in ns of the messages, by stamp: from the index, else from the table."""
    stamps: dict[int, int] = {}
    for query in (
        'SELECT id, timestamp FROM messages ORDER BY timestamp',
        'SELECT id, timestamp FROM messages NOT INDEXED',
    ):
        try:
            for row, stamp_ns in db.execute(query):
                if isinstance(row, int) and isinstance(stamp_ns, int):
                    stamps[row] = stamp_ns
            break
        except sqlite3.Error as error:
            losses.append(f'its list of messages ends after {len(stamps)}: {error}')
    return sorted(stamps.items(), key=lambda item: item[1])
