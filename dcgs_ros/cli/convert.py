# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""`dcgs convert`: write a sequence as a rosbag2 or a TUM folder, complete or not at all."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path

from tqdm import tqdm

from ..core.errors import DcgsError
from ..core.frame import RgbdFrame
from ..datasets.bag.writing.storage import BagOptions
from ..datasets.bag.writing.writer import write_bag
from ..datasets.open import open_source
from ..datasets.prefetch import prefetch
from ..datasets.source import BadFrame, Source, SourceError
from ..datasets.tum.writer import write_tum_folder
from ..io.whole_files import staged_folder
from .arguments import ConvertArguments, OutputFormat, UsageError
from .folders import refuse_used
from .stopping import StopSignals
from .tables import Row, table

_BY_SUFFIX: dict[str, OutputFormat] = {'.db3': 'sqlite3', '.tum': 'tum'}
_NAMED = 10  # bad frames that the summary names; the others are only counted


class _StoppedError(DcgsError):
    """SIGINT or SIGTERM was received."""


@dataclass
class _FrameFilter:
    """Passes the good frames on, and records what it has seen."""

    stamps_ns: list[int] = field(default_factory=list)
    bad: list[BadFrame] = field(default_factory=list)
    depth_stamps_ns: set[int] = field(default_factory=set)

    def good(
        self, items: Iterable[RgbdFrame | BadFrame], stopped: Callable[[], bool]
    ) -> Iterator[RgbdFrame]:
        """Yield the good frames.

        Raises `SourceError` after the last item if there was none, `_StoppedError` once `stopped`.
        """
        for item in items:
            if stopped():
                raise _StoppedError
            if isinstance(item, BadFrame):
                self.bad.append(item)
            else:
                self.stamps_ns.append(item.stamp_ns)
                yield self._with_own_depth(item)
        if not self.stamps_ns:
            first = f'; the first: {self.bad[0].name}: {self.bad[0].reason}' if self.bad else ''
            raise SourceError(f'no usable frame: {len(self.bad)} skipped{first}')

    def _with_own_depth(self, frame: RgbdFrame) -> RgbdFrame:
        """Move depth that has served another colour by a nanosecond: readers pair one to one."""
        while frame.depth_stamp_ns in self.depth_stamps_ns:
            frame = replace(frame, depth_stamp_ns=frame.depth_stamp_ns + 1)
        self.depth_stamps_ns.add(frame.depth_stamp_ns)
        return frame


def execute(arguments: ConvertArguments) -> int:
    """Convert the sequence and return the exit status; if it is stopped, nothing is written."""
    output_format = _check(arguments)
    source = open_source(
        arguments.source, arguments.camera, arguments.groundtruth, arguments.options
    )
    total = min(len(source), arguments.max_frames or len(source))
    frame_filter, start = _FrameFilter(), time.perf_counter()
    with StopSignals() as stop:
        try:
            with (
                staged_folder(arguments.dest) as folder,
                closing(prefetch(islice(source, total))) as items,
                tqdm(items, total=total, unit='frame', disable=None, dynamic_ncols=True) as bar,
            ):
                frames = frame_filter.good(bar, lambda: stop.status != 0)
                lost = _write(output_format, folder, source, frames, arguments)
                if stop.status:
                    raise _StoppedError
        except _StoppedError:
            print(f'dcgs: stopped; {arguments.dest} is not written', file=sys.stderr)
            return stop.status
    seconds = time.perf_counter() - start
    rows = _rows(arguments.dest, frame_filter, source.notes, lost, seconds)
    print(table(f'{source.name} as {output_format}', rows), flush=True)
    return 0


def _check(arguments: ConvertArguments) -> OutputFormat:
    """Return the format; raise `UsageError` or `FolderError` before anything is read."""
    output_format = arguments.format or _BY_SUFFIX.get(arguments.dest.suffix, 'mcap')
    if output_format == 'tum' and (arguments.compress or arguments.zstd):
        raise UsageError(
            '--compress and --zstd are for a rosbag2: the images of a TUM folder are PNGs'
        )
    if arguments.max_frames is not None and arguments.max_frames < 1:
        raise UsageError(f'--max-frames {arguments.max_frames}: at least one frame is needed')
    refuse_used(arguments.dest)
    return output_format


def _write(
    output_format: OutputFormat,
    folder: Path,
    source: Source,
    frames: Iterator[RgbdFrame],
    arguments: ConvertArguments,
) -> list[str]:
    """Write the folder and return what the format could not hold."""
    if output_format == 'tum':
        return write_tum_folder(folder, source, frames)
    options = BagOptions(output_format, arguments.compress, arguments.zstd)
    return write_bag(folder, source, frames, options)


def _rows(
    dest: Path, seen: _FrameFilter, notes: Sequence[str], lost: list[str], seconds: float
) -> list[Row]:
    """Return the rows of the summary: what was written, and what was not."""
    frames, bad, stamps_ns = len(seen.stamps_ns), seen.bad, seen.stamps_ns
    size_mb = 1e-6 * sum(path.stat().st_size for path in dest.rglob('*') if path.is_file())
    return [
        ('frames', f'{frames}, {1e-9 * (stamps_ns[-1] - stamps_ns[0]):.1f} s'),
        ('skipped', f'{len(bad)}'),
        *[('', f'{item.name}: {item.reason}') for item in bad[:_NAMED]],
        *[('note', note) for note in notes],
        ('lost', '; '.join(lost) or 'nothing'),
        ('size', f'{size_mb:.1f} MB'),
        ('speed', f'{frames / seconds:.0f} pairs/s'),
        ('written to', str(dest)),
    ]
