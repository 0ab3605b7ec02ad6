# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""YAML from files that are not trusted."""

from __future__ import annotations

import re
from typing import Any

import yaml

_VALUES_LIMIT, _BRACKETS_LIMIT = 10_000, 100
# YAML's own errors, and those that PyYAML's constructors let through for tags with odd values.
_ERRORS = (
    yaml.YAMLError, ValueError, TypeError, ArithmeticError, LookupError, AttributeError,
)  # fmt: skip


def load_yaml(text: str | bytes) -> Any:
    """Parse one document; raises `ValueError` with the problem in one line.

    What is returned can be walked: it is nested some hundred levels deep at most, and holds up to
    10,000 values, where those that an alias repeats count again.
    """
    _check_brackets(text if isinstance(text, bytes) else text.encode())
    try:
        tree = yaml.safe_load(text)
    except RecursionError:
        raise ValueError('no YAML: its blocks are nested too deeply') from None
    except _ERRORS as error:
        mark = getattr(error, 'problem_mark', None)
        where = '' if mark is None else f' in line {mark.line + 1}'
        problem = getattr(error, 'problem', None) or str(error).partition('\n')[0]
        raise ValueError(f'no YAML: {problem}{where}') from None
    _check_values(tree)
    return tree


def _check_brackets(text: bytes) -> None:
    """Check the depth of brackets, for which PyYAML takes time by its square."""
    depth = 0
    for bracket in re.findall(rb'[][{}]', text):
        depth += 1 if bracket in b'[{' else -1
        if depth > _BRACKETS_LIMIT:
            raise ValueError(f'no YAML: more than {_BRACKETS_LIMIT} brackets within each other')


def _check_values(tree: Any) -> None:
    values, count = [tree], 0
    while values:
        value = values.pop()
        count += 1
        if count > _VALUES_LIMIT:
            raise ValueError(
                f'no settings: more than {_VALUES_LIMIT} values; does an alias (*name) stand in '
                'what it names?'
            )
        if isinstance(value, dict):
            values.extend(value.values())
        elif isinstance(value, list | set):
            values.extend(value)
