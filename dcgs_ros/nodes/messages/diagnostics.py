# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What /diagnostics takes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import Header


def status(
    level: bytes, name: str, message: str, values: Mapping[str, object]
) -> DiagnosticStatus:
    """One status; `level` is one of DiagnosticStatus's, floats are shown with four digits."""
    shown = [KeyValue(key=key, value=_text(value)) for key, value in values.items()]
    return DiagnosticStatus(level=level, name=name, message=message, values=shown)


def diagnostics(stamp: Time, statuses: Iterable[DiagnosticStatus]) -> DiagnosticArray:
    """Statuses of one instant."""
    return DiagnosticArray(header=Header(stamp=stamp), status=list(statuses))


def _text(value: object) -> str:
    """Write a value for people."""
    return f'{value:.4g}' if isinstance(value, float) else str(value)
