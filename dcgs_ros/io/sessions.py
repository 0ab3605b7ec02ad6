# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The sessions of a map: what recorded it, one after the other."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from ..core.camera import PinholeCamera
from ..core.config.schema import override
from ..core.config.stages import Config
from ..core.sensor import SensorNoise
from .map_parts import MapFileError, read_camera

SESSIONS_NAME = 'sessions.json'  # of their member of the archive
_SIZE_LIMIT = 1 << 20  # bytes: a thousand sessions
_NAME_LIMIT = 100  # characters


@dataclass(frozen=True)
class SavedSession:
    """A run of tracker and mapper that began a map or extended it.

    Keyframes and views of a map stand in the order of its sessions.
    """

    name: str  # of the sequence, or of the camera's frame
    camera: PinholeCamera
    sensor: SensorNoise
    keyframes: int  # of the tracker
    views: int  # of the mapper

    def __post_init__(self) -> None:
        """Check the counts."""
        if self.keyframes < 0 or self.views < 0:
            raise MapFileError(
                f'session {self.name!r} has {self.keyframes} keyframes and {self.views} views'
            )


def extended(
    sessions: Sequence[SavedSession], newest: SavedSession, keyframes: int, views: int
) -> tuple[SavedSession, ...]:
    """Return the sessions with the `newest`, which made the rest of so many keyframes and views.

    A session that made neither is left out.
    """
    newest = replace(
        newest,
        name=newest.name[:_NAME_LIMIT],
        keyframes=keyframes - sum(session.keyframes for session in sessions),
        views=views - sum(session.views for session in sessions),
    )
    return (*sessions, newest) if newest.keyframes or newest.views else tuple(sessions)


def write_sessions(sessions: Sequence[SavedSession]) -> bytes:
    """Return the sessions as JSON; raises `MapFileError` for too many."""
    rows = [dataclasses.asdict(s) | {'sensor': dataclasses.asdict(s.sensor)} for s in sessions]
    text = json.dumps(rows, indent=1, allow_nan=False).encode('ascii')
    if len(text) > _SIZE_LIMIT:
        raise MapFileError(f'{len(rows)} sessions take {len(text)} bytes, limit {_SIZE_LIMIT}')
    return text


def read_sessions(text: bytes) -> tuple[SavedSession, ...]:
    """Return the sessions of JSON; raises a `DcgsError` that says what is wrong with it."""
    if len(text) > _SIZE_LIMIT:
        raise MapFileError(f'{SESSIONS_NAME} has {len(text)} bytes, limit {_SIZE_LIMIT}')
    try:
        rows = json.loads(text.decode('ascii'))
        return tuple(_session(row) for row in rows)
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise MapFileError(f'{SESSIONS_NAME}: {type(error).__name__}: {error}') from error


def _session(row: Any) -> SavedSession:
    name, keyframes, views = str(row['name']), row['keyframes'], row['views']
    if not isinstance(keyframes, int) or not isinstance(views, int):
        raise MapFileError(f'session {name[:40]!r} has {keyframes} keyframes, {views} views')
    sensor = override(Config(), {f'sensor.{key}': v for key, v in row['sensor'].items()}).sensor
    return SavedSession(name[:_NAME_LIMIT], read_camera(row['camera']), sensor, keyframes, views)
