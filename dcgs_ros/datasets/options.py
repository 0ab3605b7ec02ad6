# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What the user says of a sequence, by flags or behind its address; nothing heavy is imported."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlencode

from ..core.config.presets import RegistrationChoice
from ..core.config.schema import Stage, described, flatten, override, ranged


@dataclass(frozen=True)
class SourceOptions(Stage):
    """What replaces the conventions of a format; None: as the format and its files say."""

    depth_per_metre: float | None = ranged(
        None,
        1,
        1e6,
        'Value of a depth pixel at one metre: 1000 for millimetres, 5000 in layouts of TUM. By '
        'default what the files or their format say; of a bag 1000, and 1 of 32FC1.',
    )
    sync_slop_s: float | None = ranged(
        None,
        0,
        0.1,
        'Largest difference of the stamps of colour and depth of one frame, seconds. By default '
        'half the interval of the images, but at least 0.02.',
    )
    rate_hz: float | None = ranged(
        None,
        1e-3,
        1e4,
        'Rate of the images, hertz, for stamps that are missing or useless: images are paired and '
        'stamped in their order. By default the stamps are used.',
    )
    depth_registration: RegistrationChoice = described(  # noqa: RUF009  it does not see that this is a Literal
        'auto',
        'Registration of the depth of a recording to its colour. none: depth is registered '
        'already; extrinsics: by the recorded ones. By default the frames, topics and intrinsics '
        'tell.',
    )


AS_STORED = SourceOptions()


def split_options(address: str, given: SourceOptions = AS_STORED) -> tuple[str, SourceOptions]:
    """Take the options out of `PATH?key=value&...`; what is `given` beside it goes before them.

    Keys that are no options stay in the address. Raises `ConfigError` for a value out of range.
    """
    path, mark, query = address.partition('?')
    if not mark or path.startswith('synthetic:') or Path(address).exists():
        return address, given
    known = {field.name for field in dataclasses.fields(SourceOptions)}
    pairs = parse_qsl(query, keep_blank_values=True)
    others = [pair for pair in pairs if pair[0] not in known]
    told = {key: value for key, value in pairs if key in known} | _given(given)
    return _joined(path, others), override(SourceOptions(), told)


def merged(options: SourceOptions, over: SourceOptions) -> SourceOptions:
    """Return the options, replaced by those that `over` has."""
    return dataclasses.replace(options, **_given(over))


def join_options(address: str, options: SourceOptions) -> str:
    """Return the address with the options behind it: `split_options` finds them there."""
    return _joined(address, [*_given(options).items()])


def _given(options: SourceOptions) -> dict[str, Any]:
    return {k: value for k, value in flatten(options).items() if value != getattr(AS_STORED, k)}


def _joined(address: str, pairs: Sequence[tuple[str, object]]) -> str:
    if not pairs:
        return address
    return f'{address}{"&" if "?" in address else "?"}{urlencode(pairs, safe="/")}'
