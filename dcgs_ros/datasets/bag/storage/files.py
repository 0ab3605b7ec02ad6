# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The files of a recording, and its metadata.yaml."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from ...source import SourceError
from .compression import ZSTD_SUFFIX

STORAGES = ('.mcap', '.db3')  # rosbag2's; ROS 1 has .bag

_METADATA = 'metadata.yaml'
_MAX_METADATA_BYTES = 1 << 22


@dataclass(frozen=True)
class Recording:
    """The files in the order they were recorded, and what metadata.yaml says of them."""

    files: tuple[Path, ...]
    missing: tuple[str, ...]  # files in metadata.yaml that do not exist
    counts: dict[str, int]  # messages of each topic, if known
    custom_data: dict[str, str]


def is_bag(path: Path) -> bool:
    """Return whether the path is a recording, by file names alone.

    That is a folder that holds a metadata.yaml, .mcap or .db3, or a file .mcap, .db3 or .bag.
    """
    if path.is_dir():
        return (path / _METADATA).exists() or bool(_storages(path))
    return path.exists() and storage_of(path) in (*STORAGES, '.bag')


def storage_of(path: Path) -> str:
    """Return the suffix of a file's name without `.zstd`: its kind of storage."""
    return Path(path.name.removesuffix(ZSTD_SUFFIX)).suffix


def find_files(path: Path) -> Recording:
    """Find the files of a recording; an unreadable metadata.yaml is ignored.

    Raises `SourceError` if the path is no recording.
    """
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
    """Return the .mcap and .db3 files in natural order of their names."""

    def key(path: Path) -> list[tuple[int, str]]:
        parts = re.findall(r'\d+|\D+', path.name)
        return [(int(part), '') if part.isdecimal() else (-1, part) for part in parts]

    return sorted((file for file in folder.iterdir() if storage_of(file) in STORAGES), key=key)


def _read_metadata(path: Path) -> dict[str, Any]:
    """Read rosbag2's metadata.yaml; empty if it is missing or is something else."""
    try:
        if path.stat().st_size > _MAX_METADATA_BYTES:
            return {}
        content = yaml.safe_load(path.read_bytes())['rosbag2_bagfile_information']
    except Exception:  # PyYAML raises more than YAMLError
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
    """Return the number of messages of each topic; empty if the metadata are not understood."""
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
