# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The files a recording consists of, and what its metadata.yaml tells of them."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from ...source import SourceError
from .compression import ZSTD_SUFFIX

STORAGES = ('.mcap', '.db3')  # rosbag2's; ROS 1 has .bag

_METADATA = 'metadata.yaml'
_MAX_METADATA_BYTES = 1 << 22


class RawMessage(NamedTuple):
    """A message as it was on the wire."""

    topic: str
    type: str  # package/msg/Name
    stamp_ns: int  # when it was recorded; its header has its own
    cdr: bytes


class DamagedError(SourceError):
    """A part of a recording is lost; what was good has been read before this is raised."""


@dataclass(frozen=True)
class Recording:
    """Files in the order they were recorded, and what is known of them."""

    files: tuple[Path, ...]
    missing: tuple[str, ...]  # files that metadata.yaml names and nobody has
    counts: dict[str, int]  # messages of each topic, as metadata.yaml says
    custom_data: dict[str, str]


def is_bag(path: Path) -> bool:
    """Whether the path is a recording, by names alone.

    That is a folder with a metadata.yaml, an .mcap or a .db3 in it, or an .mcap, .db3 or .bag.
    """
    if path.is_dir():
        return (path / _METADATA).exists() or bool(_storages(path))
    return path.exists() and storage_of(path) in (*STORAGES, '.bag')


def storage_of(path: Path) -> str:
    """Tell the kind of a file from its name, `.zstd` aside."""
    return Path(path.name.removesuffix(ZSTD_SUFFIX)).suffix


def find_files(path: Path) -> Recording:
    """Find the files of a recording; a bad metadata.yaml is as none. Raises `SourceError`."""
    if not is_bag(path):
        raise SourceError(
            f'{path}: no recording: no folder of .mcap or .db3, no .mcap, .db3, .bag'
        )
    folder = path if path.is_dir() else path.parent
    metadata = _read_metadata(folder / _METADATA)
    listed = _list(metadata, 'relative_file_paths')
    named = list(dict.fromkeys(os.path.basename(n) for n in listed if isinstance(n, str)))
    if path.is_dir():
        files = [folder / n for n in named if storage_of(Path(n)) in STORAGES]
        files = [file for file in files if os.path.isfile(file)]
        missing = [name for name in named if folder / name not in files]
        if not files:
            files = _storages(path)
        if not files:
            raise SourceError(f'{path}: no recording: no .mcap or .db3 beside its {_METADATA}')
    else:
        files, missing = [path], []
        metadata = metadata if path.name in named else {}
    counts = _message_counts(metadata) if path.is_dir() or len(named) == 1 else {}
    return Recording(tuple(files), tuple(missing), counts, _custom_data(metadata))


def _storages(folder: Path) -> list[Path]:
    """Files of rosbag2's storages in order of their names, numbers by their values."""

    def key(path: Path) -> list[tuple[int, str]]:
        parts = re.findall(r'\d+|\D+', path.name)
        return [(int(part), '') if part.isdecimal() else (-1, part) for part in parts]

    return sorted((file for file in folder.iterdir() if storage_of(file) in STORAGES), key=key)


def _read_metadata(path: Path) -> dict[str, Any]:
    """Read what rosbag2 wrote on its recording; nothing where that is no such thing."""
    try:
        if path.stat().st_size > _MAX_METADATA_BYTES:
            return {}
        content = yaml.safe_load(path.read_bytes())['rosbag2_bagfile_information']
    except Exception:  # PyYAML raises more than its YAMLError
        return {}
    return content if isinstance(content, dict) else {}


def _list(metadata: dict[str, Any], key: str) -> list[Any]:
    value = metadata.get(key)
    return value if isinstance(value, list) else []


def _custom_data(metadata: dict[str, Any]) -> dict[str, str]:
    custom = metadata.get('custom_data')
    items = custom.items() if isinstance(custom, dict) else ()
    return {key: text for key, text in items if isinstance(key, str) and isinstance(text, str)}


def _message_counts(metadata: dict[str, Any]) -> dict[str, int]:
    """Count the messages of each topic as the metadata do."""
    try:
        counts = {
            entry['topic_metadata']['name']: entry['message_count']
            for entry in _list(metadata, 'topics_with_message_count')
        }
    except (LookupError, TypeError):
        return {}
    return {
        topic: count
        for topic, count in counts.items()
        if isinstance(topic, str) and isinstance(count, int)
    }
