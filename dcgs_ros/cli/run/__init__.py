# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""`dcgs run`: track and map a sequence into a new folder."""

from __future__ import annotations

import contextlib
from contextlib import closing

from ...core.kernels.workers import Workers
from ...core.mapping.mapper import mapper_threads
from ...datasets.open import open_source
from ...datasets.source import SourceError
from ...evaluation.report import RunRecord
from ..arguments import RunArguments, UsageError
from ..folders import create_folder, refuse_used
from ..stopping import StopSignals
from .configuration import configure
from .pipeline import start
from .session import Session


def execute(arguments: RunArguments) -> int:
    """Run the sequence and return the exit status; what was computed is written in any case."""
    _check(arguments)
    source = open_source(arguments.source, arguments.camera, arguments.groundtruth)
    config = configure(source.sensor, arguments)
    folder = create_folder(arguments.out, source.name)
    record = RunRecord(source.name, config.ablation, arguments.source, arguments.camera)
    total = min(len(source), arguments.max_frames or len(source))
    try:
        with closing(Workers(mapper_threads(config, arguments.online))) as workers:
            pipeline = start(source.camera, config, arguments.mapping, arguments.online, workers)
            session = Session(source, pipeline, record, folder)
            with StopSignals() as stop:
                session.process(total, lambda: stop.status != 0)
                if record.tracked:
                    session.save()
            if record.tracked:
                session.evaluate(arguments.render_every, workers)
        session.deferred.raise_first()
    finally:
        with contextlib.suppress(OSError):  # it is not empty unless nothing was written
            folder.rmdir()
    if stop.status == 0 and not record.tracked:
        raise SourceError(_no_usable_frame(record))
    return stop.status


def _check(arguments: RunArguments) -> None:
    """Raise `UsageError` or `FolderError` before anything is read or written."""
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
