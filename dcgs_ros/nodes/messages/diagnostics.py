# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A node's health as a DiagnosticArray."""

from __future__ import annotations

from collections.abc import Mapping

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import Header

from ..health import Verdict


def diagnostics(
    stamp: Time, name: str, verdict: Verdict, values: Mapping[str, object]
) -> DiagnosticArray:
    """Return one status under a name, with values as text: floats with four digits."""
    shown = [KeyValue(key=key, value=_text(value)) for key, value in values.items()]
    status = DiagnosticStatus(
        level=bytes([verdict.level]), name=name, message=verdict.message, values=shown
    )
    return DiagnosticArray(header=Header(stamp=stamp), status=[status])


def _text(value: object) -> str:
    return f'{value:.4g}' if isinstance(value, float) else str(value)
