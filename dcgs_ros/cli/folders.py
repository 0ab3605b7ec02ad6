# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Output folders: always new or empty, of one process, so that no result is overwritten."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..core.errors import DcgsError
from ..io.whole_files import is_temporary, locked, remove_leftovers

RUNS = Path('runs')


class FolderError(DcgsError):
    """An output folder or file cannot be used."""


def refuse_used(folder: Path) -> None:
    """Raise `FolderError` if `folder` is a file, or holds more than killed processes left."""
    if folder.is_dir():
        if all(is_temporary(path) for path in folder.iterdir()):
            remove_leftovers(folder)
        if any(folder.iterdir()):
            raise FolderError(f'{folder} is not empty: a new folder is needed')
    elif folder.exists():
        raise FolderError(f'{folder} is a file, not a folder')


@contextmanager
def new_folder(folder: Path | None, name: str) -> Iterator[Path]:
    """Create `folder`, or the first of runs/NAME-1, -2, ... that does not exist, for one process.

    It is removed at the end if it is empty. Raises `FolderError` if it is in use.
    """
    folder = _create(folder, name)
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(locked(folder))
        except BlockingIOError:
            raise FolderError(f'{folder} is in use: another process writes there') from None
        refuse_used(folder)  # again: that process may just have finished
        stack.callback(_remove_empty, folder)
        yield folder


def _remove_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):  # it is not empty
        folder.rmdir()


def _create(folder: Path | None, name: str) -> Path:
    if folder is not None:
        refuse_used(folder)
        folder.mkdir(parents=True, exist_ok=True)
        return folder
    stem = re.sub(r'[^\w.]+', '-', name).strip('-.') or 'run'
    number = 1
    while True:
        folder = RUNS / f'{stem}-{number}'
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            remove_leftovers(folder)
            number += 1
        else:
            return folder
