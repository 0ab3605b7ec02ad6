# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The Gaussians of map files, and `dcgs convert` between their formats."""

from __future__ import annotations

import sys
from pathlib import Path

from ..core.mapping.splats import Splats
from ..io.map_archive import read_map
from ..io.ply import PlyError, read_ply, write_ply
from ..io.spz import read_spz, write_spz
from .arguments import ConvertArguments, UsageError
from .folders import FolderError
from .tables import table

_READERS = {'.ply': read_ply, '.spz': read_spz}
WRITERS = {'.ply': write_ply, '.spz': write_spz}


def is_splats(path: Path) -> bool:
    """Return whether a file, by its name, holds Gaussians and nothing else."""
    return path.suffix.lower() in _READERS


def read_splats(path: Path) -> Splats:
    """Read a map's Gaussians, and print how many are left out.

    Raises a `DcgsError` naming the file, also if there are none.
    """
    if not is_splats(path):
        return read_map(path).splats
    splats = _READERS[path.suffix.lower()](
        path, lambda text: print(f'dcgs: {text}', file=sys.stderr)
    )
    if not len(splats):
        raise PlyError(f'{path}: holds no Gaussian')
    return splats


def convert_map(arguments: ConvertArguments) -> int:
    """Write the Gaussians of a map in another format, and return the exit status."""
    source, dest = Path(arguments.source), arguments.dest
    if arguments != ConvertArguments(arguments.source, dest):
        raise UsageError(f'{dest}: --format and the other options are for sequences, not for maps')
    if dest.exists():
        raise FolderError(f'{dest} exists: no file is overwritten')
    splats = read_splats(source)
    WRITERS[dest.suffix.lower()](dest, splats)
    size_mb = 1e-6 * dest.stat().st_size
    rows = [
        ('Gaussians', f'{len(splats)}'),
        ('size', f'{size_mb:.1f} MB'),
        ('written to', f'{dest}'),
    ]
    print(table(f'{source.name} as {dest.suffix[1:].lower()}', rows), flush=True)
    return 0
