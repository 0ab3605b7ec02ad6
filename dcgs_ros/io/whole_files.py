# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Writing files and folders completely or not at all."""

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
    """Provide the name of a temporary folder to create, which is moved to `path` at the end.

    `path` must not exist or be an empty folder. The temporary folder has the same name, as
    recordings name their files after it. On any error the temporary folder is removed; an
    `OSError` is raised as `StagingError`.
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
    """Provide a temporary name beside `path` to write to; the file then replaces `path`.

    On any error the temporary file is removed, and `path` is unchanged.
    """
    temporary = path.with_name(f'.{path.name}.{os.getpid()}.tmp')
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()
