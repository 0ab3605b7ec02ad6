# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""SQLite files of rosbag2 that are cut off, damaged, or beside a -wal that cannot be read."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path

from ...source import SourceError

_HEADER_BYTES = 100  # https://www.sqlite.org/fileformat.html, 1.3


def open_without_wal(
    path: Path,
    connect: Callable[[Path, str], sqlite3.Connection],
    reason: sqlite3.Error,
    losses: list[str],
) -> sqlite3.Connection:
    """Open a file without its locks and -wal, after opening it with these failed for `reason`.

    Raises `SourceError` if that fails, too.
    """
    try:
        db = connect(path, 'immutable=1')
    except sqlite3.Error as error:
        raise SourceError(f'no SQLite file that can be read: {error}') from error
    losses.append(f'what is not yet merged into it is left out: {reason}')
    return db


def note_cut_off(path: Path, losses: list[str]) -> None:
    """Append to `losses` that the file is shorter than its header says, if it is."""
    with path.open('rb') as file:
        header = file.read(_HEADER_BYTES)
    if len(header) < _HEADER_BYTES:
        return
    (page,) = struct.unpack_from('>H', header, 16)
    changes, pages = struct.unpack_from('>II', header, 24)
    (valid,) = struct.unpack_from('>I', header, 92)  # the change that `pages` belongs to
    expected = pages * (65536 if page == 1 else page)
    size = path.stat().st_size
    if changes == valid and size < expected:
        losses.append(f'cut off at {size} of {expected} bytes')


def add_without_index(
    db: sqlite3.Connection,
    add_rows: Callable[[sqlite3.Connection, str, dict[int, int]], None],
    stamps: dict[int, int],
    reason: sqlite3.Error,
    losses: list[str],
) -> None:
    """Add the messages by walking the table, after reading the index failed for `reason`."""
    losses.append(f'its list of messages ends after {len(stamps)}: {reason}')
    try:
        add_rows(db, 'NOT INDEXED', stamps)
    except sqlite3.Error as error:
        losses.append(f'its list of messages ends after {len(stamps)}: {error}')
