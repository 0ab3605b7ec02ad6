# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The progress of a run on stderr."""

from __future__ import annotations

import sys
from types import TracebackType

from tqdm import tqdm

from ...evaluation.report import SkippedFrame, TrackedFrame

_WARNINGS = 10  # skipped frames that get a line of their own; the others are only counted


class Progress:
    """Shows a progress bar if stderr is a terminal, and names skipped frames in any case."""

    def __init__(self, total: int) -> None:
        """Start the bar for `total` frames."""
        self._bar = tqdm(total=total, unit='frame', disable=None, dynamic_ncols=True)
        self._tracked = self._skipped = self._keyframes = 0
        self._seconds = 0.0

    def __enter__(self) -> Progress:
        """Return itself; the bar is already shown."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the bar, and print the number of skipped frames if not all were named."""
        self._bar.close()
        if self._skipped > _WARNINGS:
            print(f'dcgs: skipped {self._skipped} frames in all', file=sys.stderr)

    def tracked(self, frame: TrackedFrame) -> None:
        """Advance by a tracked frame."""
        self._tracked += 1
        self._seconds += frame.seconds
        self._keyframes += frame.result.keyframe
        self._bar.set_postfix_str(
            f'{frame.result.state.value}, tracking {self._tracked / self._seconds:.0f} fps, '
            f'{self._keyframes} keyframes',
            refresh=False,
        )
        self._bar.update()

    def skipped(self, frame: SkippedFrame) -> None:
        """Advance by a skipped frame, and print why it was skipped."""
        self._skipped += 1
        if self._skipped <= _WARNINGS:
            tqdm.write(f'dcgs: skipped {frame.name}: {frame.reason}', file=sys.stderr)
        self._bar.update()

    def refined(self, left: int) -> None:
        """Show how many steps of the refinement are left."""
        self._bar.set_postfix_str(f'refining, {left} steps left')
