# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""`dcgs run`: a sequence through the tracker, into a folder."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from itertools import islice

from ..core.config import Config, ConfigError, override
from ..core.errors import FrameError
from ..core.frame import RgbdFrame
from ..core.jit import set_kernel_threads
from ..core.sensor import SensorNoise
from ..core.tracker import Tracker
from ..core.warmup import warm_up
from ..datasets.open import open_source
from ..datasets.prefetch import prefetch
from ..datasets.source import BadFrame, Source, SourceError
from ..evaluation.report import RunRecord, SkippedFrame, TrackedFrame
from ..io.settings import apply_file
from .arguments import RunArguments, UsageError
from .outputs import create_folder, refuse_used, write_outputs
from .progress import Progress
from .stopping import StopSignals
from .summary import run_summary

_SLOW_S = 2.0  # a start that takes longer is explained
_LOWEST_PRIORITY = 19  # as `nice` has it


def execute(arguments: RunArguments) -> int:
    """Track the sequence; what has been tracked is written however the loop ends."""
    if arguments.max_frames is not None and arguments.max_frames < 1:
        raise UsageError(f'--max-frames {arguments.max_frames}: at least one frame is needed')
    if arguments.out is not None:
        refuse_used(arguments.out)
    source = open_source(arguments.source, arguments.camera, arguments.groundtruth)
    config = configure(source.sensor, arguments)
    folder = create_folder(arguments.out, source.name)
    record = RunRecord(source.name, config.ablation)
    try:
        tracker = _ready(source, config)
        with StopSignals() as stop:
            total = min(len(source), arguments.max_frames or len(source))
            print(f'dcgs: tracking {total} frames of {source.name}', file=sys.stderr, flush=True)
            try:
                _follow(source, total, tracker, record, stop)
            finally:
                if record.tracked:
                    report, accuracy = write_outputs(folder, record, config, source)
                    print(run_summary(report, accuracy, folder), flush=True)
    finally:
        with contextlib.suppress(OSError):  # which says that it is not empty, as it should be
            folder.rmdir()
    if stop.status == 0 and not record.tracked:
        raise SourceError(_no_usable_frame(record))
    return stop.status


def configure(sensor: SensorNoise, arguments: RunArguments) -> Config:
    """Layer the source's sensor, the file, --ablation and --set, the last on top."""
    config = Config(sensor=sensor)
    if arguments.config is not None:
        config = apply_file(config, arguments.config)
    if arguments.ablation is not None:
        config = override(config, {'ablation': arguments.ablation})
    values: dict[str, str] = {}
    for text in (text for group in arguments.settings for text in group):
        key, equals, value = text.partition('=')
        if not equals:
            raise ConfigError(f'--set {text}: expected stage.field=value')
        values[key.strip()] = value.strip()
    return override(config, values)


def _ready(source: Source, config: Config) -> Tracker:
    """Make a tracker whose kernels are compiled."""
    with _explained_if_slow('dcgs: compiling kernels (once)'):
        warm_up(source.camera, config)
    return Tracker(source.camera, config)


@contextmanager
def _explained_if_slow(text: str) -> Iterator[None]:
    timer = threading.Timer(_SLOW_S, print, (text,), {'file': sys.stderr, 'flush': True})
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _follow(
    source: Source, total: int, tracker: Tracker, record: RunRecord, stop: StopSignals
) -> None:
    """Track frame by frame into `record`, until the last or a signal."""
    start = time.perf_counter()
    with closing(prefetch(_read(source, total))) as items, Progress(total) as progress:
        for index, item in enumerate(items):
            step = _step(index, item, tracker)
            if isinstance(step, TrackedFrame):
                record.tracked.append(step)
                progress.tracked(step)
            else:
                record.skipped.append(step)
                progress.skipped(step)
            record.wall_s = time.perf_counter() - start
            if stop.status:
                return
    record.interrupted = False


def _read(source: Source, total: int) -> Iterator[RgbdFrame | BadFrame]:
    """Read in the background, in a thread that gives way to the tracker's.

    At equal priority decoding costs the tracker a third of its speed on two cores (measured).
    A synthetic source's kernels may not take all the cores either.
    """
    set_kernel_threads(None)
    if sys.platform == 'linux':  # where priorities are of threads
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _LOWEST_PRIORITY)
    yield from islice(source, total)


def _step(index: int, item: RgbdFrame | BadFrame, tracker: Tracker) -> TrackedFrame | SkippedFrame:
    """Track one frame, timed, or say why not."""
    if isinstance(item, BadFrame):
        return SkippedFrame(index, None, item.name, item.reason)
    start = time.perf_counter()
    try:
        result = tracker.track(item)
    except FrameError as error:
        return SkippedFrame(index, item.stamp_ns, f'frame {index + 1}', str(error))
    return TrackedFrame(index, result, time.perf_counter() - start, len(tracker.gaussians))


def _no_usable_frame(record: RunRecord) -> str:
    if not record.skipped:
        return f'{record.source}: holds no frame'
    first, count = record.skipped[0], len(record.skipped)
    return f'no usable frame: {count} of {count} skipped; the first: {first.name}: {first.reason}'
