# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Output folders: always new or empty, so that no earlier result is overwritten."""

from __future__ import annotations

import re
from pathlib import Path

from ..core.errors import DcgsError

RUNS = Path('runs')


class FolderError(DcgsError):
    """An output folder or file cannot be used."""


def refuse_used(folder: Path) -> None:
    """Raise `FolderError` if `folder` holds anything or is a file."""
    if folder.is_dir():
        if any(folder.iterdir()):
            raise FolderError(f'{folder} is not empty: a new folder is needed')
    elif folder.exists():
        raise FolderError(f'{folder} is a file, not a folder')


def create_folder(folder: Path | None, name: str) -> Path:
    """Create `folder`, or the first of runs/NAME-1, -2, ... that does not exist."""
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
            number += 1
        else:
            return folder
