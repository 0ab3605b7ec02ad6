# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What is seen of a run while it lasts."""

from __future__ import annotations

import sys
from types import TracebackType

from tqdm import tqdm

from ...evaluation.report import SkippedFrame, TrackedFrame

_WARNINGS = 10  # lines about skipped frames; the rest is counted


class Progress:
    """A bar on a terminal's stderr, nothing elsewhere; skipped frames are named in both."""

    def __init__(self, total: int) -> None:
        """Expect `total` frames."""
        self._bar = tqdm(total=total, unit='frame', disable=None, dynamic_ncols=True)
        self._tracked = self._skipped = self._keyframes = 0
        self._seconds = 0.0

    def __enter__(self) -> Progress:
        """Show the bar, which stands since it was made."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Leave the bar as it is and count what was not named."""
        self._bar.close()
        if self._skipped > _WARNINGS:
            print(f'dcgs: skipped {self._skipped} frames in all', file=sys.stderr)

    def tracked(self, frame: TrackedFrame) -> None:
        """Go on by one frame."""
        self._tracked += 1
        self._seconds += frame.seconds
        self._keyframes += frame.result.keyframe
        self._bar.set_postfix_str(
            f'{frame.result.state.value}, tracking {self._tracked / self._seconds:.0f} fps, '
            f'{self._keyframes} keyframes',
            refresh=False,
        )
        self._bar.update()

    def refined(self, left: int) -> None:
        """Show how many steps of the refinement are left."""
        self._bar.set_postfix_str(f'refining, {left} steps left')

    def skipped(self, frame: SkippedFrame) -> None:
        """Name a frame that is left out."""
        self._skipped += 1
        if self._skipped <= _WARNINGS:
            tqdm.write(f'dcgs: skipped {frame.name}: {frame.reason}', file=sys.stderr)
        self._bar.update()
