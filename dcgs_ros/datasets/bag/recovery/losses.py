# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Accounting for the parts of a damaged recording that cannot be read."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from ...source import SourceError

if TYPE_CHECKING:
    from ..storage.files import Recording


class DamagedError(SourceError):
    """A part of a recording is lost; raised after the readable part has been read."""


@contextmanager
def skipping(
    losses: list[str],
    what: str,
    *errors: type[Exception],
    show: Callable[[Exception], str] = str,
) -> Iterator[None]:
    """Skip the rest of a block that raises one of these errors, and append the loss of `what`."""
    try:
        yield
    except errors as error:
        losses.append(f'{what}: {show(error)}')


class RecordingLosses:
    """What could not be read of a recording's files."""

    def __init__(
        self, path: Path | str, recording: Recording, topics: Collection[str] | None
    ) -> None:
        """Add the files that are missing; `topics` are those read, None for all."""
        self.read = 0  # messages that were read, counted by the reader
        self._path, self._recording, self._topics = path, recording, topics
        self._losses = [f'{name} is missing' for name in recording.missing]
        self._unusable = 0  # files

    @contextmanager
    def of_file(self, file: Path) -> Iterator[list[str]]:
        """Collect the losses of one file: those appended to the list, or that it is unusable."""
        losses: list[str] = []
        try:
            yield losses
        except SourceError as error:
            losses.append(str(error))
            self._unusable += 1
        self._losses += [f'{file.name}: {loss}' for loss in losses]

    def check(self) -> None:
        """Check that nothing is lost; raises `DamagedError`, or `SourceError` if all is lost."""
        losses = self._losses
        if not self.read and self._unusable == len(self._recording.files):
            raise SourceError(f'{self._path}: cannot be read: {"; ".join(losses)}')
        if losses:
            more = f' (and {len(losses) - 1} more)' if len(losses) > 1 else ''
            raise DamagedError(
                f'{self._path}: {self.read}{self._of_recorded()} messages could be read: '
                f'{losses[0]}{more}'
            )

    def _of_recorded(self) -> str:
        """Return ' of N', the number of recorded messages, if metadata.yaml has one."""
        counts = self._recording.counts.items()
        recorded = [n for topic, n in counts if self._topics is None or topic in self._topics]
        return f' of {sum(recorded)}' if sum(recorded) >= self.read else ''
