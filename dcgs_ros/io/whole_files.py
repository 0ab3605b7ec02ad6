# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Writing files and folders completely or not at all, also if the power fails.

Temporary names are `.NAME.PID.tmp` beside the target, locked while they are written: the system
unlocks those of a process that is killed, so the next writer can tell them, and removes them.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..core.errors import DcgsError

_TEMPORARY = re.compile(r'\.(.+)\.[0-9]+\.tmp')


class StagingError(DcgsError):
    """A folder cannot be written."""


@contextmanager
def staged_folder(path: Path) -> Iterator[Path]:
    """Provide the name of a temporary folder to create, which is moved to `path` at the end.

    `path` must not exist or be an empty folder. The temporary folder has the same name, as
    recordings name their files after it. On any error the temporary folder is removed; an
    `OSError` is raised as `StagingError`.
    """
    target = Path(os.path.realpath(path))
    temporary = _temporary(target)
    try:
        temporary.mkdir(parents=True)
        with locked(temporary):
            remove_leftovers(target.parent, target.name)
            yield temporary / target.name
            os.sync()  # thousands of images one by one take long
            os.rename(temporary / target.name, target)
            _names_to_disk(target.parent)
    except OSError as error:
        reason = error.strerror or error
        raise StagingError(f'{path}: cannot be written: {reason}') from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Provide a temporary name beside `path` to write to; the file then replaces `path`.

    On any error the temporary file is removed, and `path` is unchanged.
    """
    temporary = _temporary(path)
    try:
        temporary.touch()
        with locked(temporary):
            remove_leftovers(path.parent, path.name)
            yield temporary
            with temporary.open('rb') as file:
                os.fsync(file.fileno())
            os.replace(temporary, path)
            _names_to_disk(path.parent)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def is_temporary(path: Path) -> bool:
    """Return whether a file or folder has the name of an unfinished one."""
    return _TEMPORARY.fullmatch(path.name) is not None


def remove_leftovers(folder: Path, name: str | None = None) -> None:
    """Remove what killed processes left of files and folders, by default of any name."""
    with contextlib.suppress(OSError):
        for path in folder.iterdir():
            found = _TEMPORARY.fullmatch(path.name)
            if found is not None and name in (None, found[1]):
                _remove_unlocked(path)


@contextmanager
def locked(path: Path) -> Iterator[bool]:
    """Hold the lock of a file or folder; provide False where the file system has no locks.

    Raises `BlockingIOError` if another process holds it.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise
        except OSError:
            yield False
        else:
            yield True
    finally:
        os.close(descriptor)


def _remove_unlocked(path: Path) -> None:
    with contextlib.suppress(OSError), locked(path) as is_locked:
        if is_locked and path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        elif is_locked:
            path.unlink()


def _temporary(path: Path) -> Path:
    return path.with_name(f'.{path.name}.{os.getpid()}.tmp')


def _names_to_disk(folder: Path) -> None:
    """Wait until the names in a folder are on the disk, where the file system can tell."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
