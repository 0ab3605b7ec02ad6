# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Later parts run after an error, and the first error is raised at the end."""

from __future__ import annotations

import pytest

from dcgs_ros.cli.run.deferred_errors import DeferredErrors


def test_nothing_failed() -> None:
    part = DeferredErrors()
    with part:
        pass
    assert not part.failed
    part.raise_first()


@pytest.mark.parametrize('first', [ValueError('first'), KeyboardInterrupt('first')])
def test_the_first_failure_is_raised_after_the_last_part(first: BaseException) -> None:
    part, done = DeferredErrors(), []
    with part:
        raise first
    for error in (OSError('second'), None):
        with part:
            done.append(error)
            if error is not None:
                raise error
    assert part.failed
    assert len(done) == 2
    with pytest.raises(type(first), match='first'):
        part.raise_first()
