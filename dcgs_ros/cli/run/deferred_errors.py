# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Errors held back so that the other parts of a run still write their results."""

from __future__ import annotations

from types import TracebackType


class DeferredErrors:
    """Context manager for each part of a run: its error is kept, and raised by `raise_first`."""

    def __init__(self) -> None:
        """Start without an error."""
        self._first: BaseException | None = None

    @property
    def failed(self) -> bool:
        """Whether any part has failed so far."""
        return self._first is not None

    def __enter__(self) -> DeferredErrors:
        """Begin a part."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> bool:
        """Keep the part's error, a `KeyboardInterrupt` too."""
        self._first = self._first or error
        return True

    def raise_first(self) -> None:
        """Raise the first error, if there was one."""
        if self._first is not None:
            raise self._first
