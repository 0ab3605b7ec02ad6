# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""`dcgs run`: a sequence through tracker and mapper, into a folder."""

from __future__ import annotations

import contextlib
from contextlib import closing

from ...core.kernels.workers import Workers
from ...datasets.open import open_source
from ...datasets.source import SourceError
from ...evaluation.report import RunRecord
from ..arguments import RunArguments, UsageError
from ..stopping import StopSignals
from .configuration import configure
from .outputs import create_folder, refuse_used
from .pipeline import start, threads_of_mapper
from .session import Session


def execute(arguments: RunArguments) -> int:
    """Track and map the sequence; what has been done is written however it ends."""
    _check(arguments)
    source = open_source(arguments.source, arguments.camera, arguments.groundtruth)
    config = configure(source.sensor, arguments)
    folder = create_folder(arguments.out, source.name)
    record = RunRecord(source.name, config.ablation, arguments.source, arguments.camera)
    total = min(len(source), arguments.max_frames or len(source))
    try:
        with closing(Workers(threads_of_mapper(config, arguments.online))) as workers:
            slam = start(source.camera, config, arguments.mapping, arguments.online, workers)
            session = Session(source, slam, record, folder)
            with StopSignals() as stop:
                session.follow(total, lambda: stop.status != 0)
                if record.tracked:
                    session.save()
            if record.tracked:
                session.evaluate(arguments.render_every, workers)
        session.salvage.settle()
    finally:
        with contextlib.suppress(OSError):  # which says that it is not empty, as it should be
            folder.rmdir()
    if stop.status == 0 and not record.tracked:
        raise SourceError(_no_usable_frame(record))
    return stop.status


def _check(arguments: RunArguments) -> None:
    if arguments.max_frames is not None and arguments.max_frames < 1:
        raise UsageError(f'--max-frames {arguments.max_frames}: at least one frame is needed')
    if arguments.render_every < 0:
        raise UsageError(f'--render-every {arguments.render_every}: 1 or more, or 0 for none')
    if arguments.out is not None:
        refuse_used(arguments.out)


def _no_usable_frame(record: RunRecord) -> str:
    if not record.skipped:
        return f'{record.source}: holds no frame'
    first, count = record.skipped[0], len(record.skipped)
    return f'no usable frame: {count} of {count} skipped; the first: {first.name}: {first.reason}'
