# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..core.errors import DcgsError


class StagingError(DcgsError):
    """A folder cannot be written."""


@contextmanager
def staged_folder(path: Path) -> Iterator[Path]:
    """Give the name of a folder to create, which takes the place of `path` in the end.

    `path` does not exist or is an empty folder. The name's last part is that of `path`: recordings
    name their files after it. Where anything fails nothing is left behind; an `OSError` becomes a
    `StagingError`.
    """
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f'.{target.name}.{os.getpid()}.tmp')
    try:
        temporary.mkdir(parents=True)
        yield temporary / target.name
        os.rename(temporary / target.name, target)
    except OSError as error:
        reason = error.strerror or error
        raise StagingError(f'{path}: cannot be written: {reason}') from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a name beside `path` to write to; the file then takes its place.

    Where anything fails, nothing is left behind and `path` is as it was.
    """
    temporary = path.with_name(f'.{path.name}.{os.getpid()}.tmp')
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()
