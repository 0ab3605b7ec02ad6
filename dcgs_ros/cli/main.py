# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The `dcgs` command: parse the arguments, run the verb, print errors as one line."""

from __future__ import annotations

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
}
_DESCRIPTION = 'Dual Covariance Gaussian Splatting SLAM. `dcgs --version` prints the version.'
_INTERRUPTED = 130  # 128 + SIGINT, as in shells


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb and return the exit status: 0, 2 for user errors, or 128 + a signal's number.

    An unexpected error is not caught: Python prints a traceback and exits with 1.
    """
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
