# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The `dcgs` command: reads the arguments, runs the verb, turns errors into one line."""

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
_DESCRIPTION = 'Dual covariance Gaussian splatting SLAM. `dcgs --version` prints the version.'
_INTERRUPTED = 130  # 128 + SIGINT, as shells have it


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb; returns the exit status: 0, 2 for what the user can act on, 128 + a signal.

    Anything unexpected is left to Python: a traceback and status 1.
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
        return _refused(str(error))
    except OSError as error:
        where = f'{error.filename}: ' if error.filename else ''
        return _refused(f'{where}{error.strerror or error}')
    except KeyboardInterrupt:
        print('dcgs: interrupted', file=sys.stderr)
        return _INTERRUPTED
    return status


def _refused(reason: str) -> int:
    print(f'dcgs: {reason}', file=sys.stderr)
    return 2
