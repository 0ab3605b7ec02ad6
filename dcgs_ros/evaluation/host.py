# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Facts about this machine and its processes, for reports and benchmarks."""

from __future__ import annotations

import platform
import re
from pathlib import Path

from ..core.kernels.workers import cores


def machine() -> str:
    """Return the processor, the cores this process may use, the system and Python's version."""
    model = _find(r'^model name\s*:\s*(.+)$', '/proc/cpuinfo') or platform.processor() or 'CPU'
    system = f'{platform.system()} {platform.machine()}'
    return f'{cores()} x {model}, {system}, Python {platform.python_version()}'


def peak_rss_mb() -> float | None:
    """Return the largest memory this process has held so far, 10^6 bytes; None if not on Linux.

    `getrusage` may report the parent process's peak instead.
    """
    return _memory_mb('VmHWM', 'self')


def rss_mb(process: int | str = 'self') -> float | None:
    """Return the memory that a process, by default this one, holds now, 10^6 bytes.

    None if the process has ended or the system is not Linux.
    """
    return _memory_mb('VmRSS', process)


def _memory_mb(field: str, process: int | str) -> float | None:
    kib = _find(rf'^{field}:\s*(\d+) kB$', f'/proc/{process}/status')
    return None if kib is None else int(kib) * 1024e-6


def _find(pattern: str, path: str) -> str | None:
    """Return the first group of a pattern's first match in a file, or None."""
    try:
        text = Path(path).read_text(encoding='utf-8', errors='replace')
    except OSError:
        return None
    match = re.search(pattern, text, re.MULTILINE)
    return None if match is None else match[1].strip()
