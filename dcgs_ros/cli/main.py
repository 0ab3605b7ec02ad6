# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The `dcgs` command: parse the arguments, run the verb, print errors as one line."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import tyro

from .. import __version__
from ..core.errors import DcgsError
from .arguments import (
    ConvertArguments,
    EvaluateArguments,
    GridArguments,
    InfoArguments,
    RenderArguments,
    RunArguments,
)

VERBS: dict[str, Any] = {
    'run': RunArguments,
    'evaluate': EvaluateArguments,
    'render': RenderArguments,
    'info': InfoArguments,
    'convert': ConvertArguments,
    'grid': GridArguments,
}
_DESCRIPTION = 'Dual Covariance Gaussian Splatting SLAM. `dcgs --version` prints the version.'
_INTERRUPTED = 130  # 128 + SIGINT, as in shells
_READER_GONE = 141  # 128 + SIGPIPE


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb and return the exit status: 0, 2 for user errors, or 128 + a signal's number.

    A reader that closes the pipe, as `head` does, is SIGPIPE. An unexpected error is not caught:
    Python prints a traceback and exits with 1.
    """
    try:
        try:
            return _run(argv)
        finally:
            print(end='', flush=True)  # after the help, too, which raises `SystemExit`
    except BrokenPipeError:
        _close_pipes()
        return _READER_GONE


def _run(argv: Sequence[str] | None) -> int:
    words = sys.argv[1:] if argv is None else list(argv)
    if words == ['--version']:
        print(f'dcgs {__version__}')
        return 0
    arguments = tyro.extras.subcommand_cli_from_dict(
        VERBS, prog='dcgs', description=_DESCRIPTION, args=words
    )
    verb = next(name for name, kind in VERBS.items() if isinstance(arguments, kind))
    try:
        status: int = import_module(f'.{verb}', __package__).execute(arguments)
    except DcgsError as error:
        return _print_error(str(error))
    except BrokenPipeError:
        raise
    except OSError as error:
        where = f'{error.filename}: ' if error.filename else ''
        return _print_error(f'{where}{error.strerror or error}')
    except KeyboardInterrupt:
        print('dcgs: interrupted', file=sys.stderr)
        return _INTERRUPTED
    return status


def _print_error(reason: str) -> int:
    print(f'dcgs: {reason}', file=sys.stderr)
    return 2


def _close_pipes() -> None:
    """Send to nowhere what Python would still write to a closed pipe when it exits."""
    for stream in filter(None, (sys.stdout, sys.stderr)):
        try:
            stream.flush()
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
