# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The machine a figure was measured on."""

from __future__ import annotations

import platform
import re
from pathlib import Path

from ..core.kernels.workers import cores


def machine() -> str:
    """Name processor, cores this process may use, system and Python."""
    model = _find(r'^model name\s*:\s*(.+)$', '/proc/cpuinfo') or platform.processor() or 'CPU'
    system = f'{platform.system()} {platform.machine()}'
    return f'{cores()} x {model}, {system}, Python {platform.python_version()}'


def peak_rss_mb() -> float | None:
    """Read the most memory this process has held so far, 10^6 bytes; None where not on Linux.

    Not `getrusage`, which may have inherited the parent process's peak.
    """
    kib = _find(r'^VmHWM:\s*(\d+) kB$', '/proc/self/status')
    return None if kib is None else int(kib) * 1024e-6


def _find(pattern: str, path: str) -> str | None:
    try:
        text = Path(path).read_text(encoding='utf-8', errors='replace')
    except OSError:
        return None
    match = re.search(pattern, text, re.MULTILINE)
    return None if match is None else match[1].strip()
