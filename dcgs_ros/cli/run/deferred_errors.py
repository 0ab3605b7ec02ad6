# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What has been computed is written, though a part of the run failed."""

from __future__ import annotations

from types import TracebackType


class DeferredErrors:
    """Holds failures back, so that the next part has its turn; `settle` raises the first one.

    Each part stands in a `with` of its own.
    """

    def __init__(self) -> None:
        """Nothing has failed yet."""
        self._failure: BaseException | None = None

    @property
    def failed(self) -> bool:
        """Whether any part has failed so far."""
        return self._failure is not None

    def __enter__(self) -> DeferredErrors:
        """Begin a part."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> bool:
        """Keep the part's failure; the signal to stop at once is one too."""
        self._failure = self._failure or error
        return True

    def settle(self) -> None:
        """Raise the first failure, if there was one."""
        if self._failure is not None:
            raise self._failure
