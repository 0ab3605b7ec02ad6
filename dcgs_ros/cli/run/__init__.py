# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""`dcgs run`: track and map a sequence into a new folder."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np

from ...core.errors import DcgsError
from ...core.kernels.workers import Workers
from ...core.mapping.mapper import mapper_threads
from ...datasets.open import open_source
from ...datasets.options import join_options
from ...datasets.readings import Readings, priors_of
from ...datasets.source import SourceError
from ...evaluation.report import RunRecord
from ..arguments import RunArguments, UsageError
from ..folders import new_folder, refuse_used
from ..stopping import StopSignals
from .configuration import configure
from .known_map import read_known
from .pipeline import start
from .session import Session


class RunError(DcgsError):
    """A run that led to nothing."""


def execute(arguments: RunArguments) -> int:
    """Run the sequence and return the exit status; what was computed is written in any case."""
    _check(arguments)
    source = open_source(
        arguments.source, arguments.camera, arguments.groundtruth, arguments.options
    )
    known = read_known(arguments, source.camera)
    config = configure(source.sensor, arguments)
    priors = priors_of(source, config.priors)
    record = RunRecord(
        source.name,
        config.ablation,
        join_options(arguments.source, arguments.options),
        arguments.camera,
        source.depth_per_metre,
    )
    total = min(len(source), arguments.max_frames or len(source))
    with (
        new_folder(arguments.out, source.name) as folder,
        closing(Workers(mapper_threads(config, arguments.online))) as workers,
    ):
        mapping = arguments.mapping and not arguments.localize
        pipeline = start(
            source.camera, config, mapping, arguments.online, workers, known, arguments.localize,
            priors, Readings(source, config.priors),
        )  # fmt: skip
        session = Session(source, pipeline, record, folder, arguments.asked_s)
        with StopSignals() as stop:
            session.process(total, lambda: stop.status != 0)
            if record.tracked:
                session.save()
        if record.tracked:
            session.evaluate(arguments.render_every, workers)
    session.deferred.raise_first()
    if stop.status == 0 and not record.tracked:
        raise SourceError(_no_usable_frame(record))
    if stop.status == 0 and _is_lost(record):
        raise RunError(_lost(record, folder))
    return stop.status


def _check(arguments: RunArguments) -> None:
    """Raise `UsageError` or `FolderError` before anything is read or written."""
    if arguments.max_frames is not None and arguments.max_frames < 1:
        raise UsageError(f'--max-frames {arguments.max_frames}: at least one frame is needed')
    if arguments.localize and arguments.map is None:
        raise UsageError('--localize: in which map? Name it with --map')
    if arguments.render_every < 0:
        raise UsageError(f'--render-every {arguments.render_every}: 1 or more, or 0 for none')
    if arguments.out is not None:
        refuse_used(arguments.out)


def _is_lost(record: RunRecord) -> bool:
    """Return whether no frame was tracked but the first, which nothing can be tracked against."""
    frames = len(record.tracked) + len(record.skipped)
    return frames > 1 and len(record.trajectory()) <= 1


def _lost(record: RunRecord, folder: Path) -> str:
    """Return how much of its frames a run that tracked nothing could use, and what is likely."""
    frames = len(record.tracked) + len(record.skipped)
    lost = len(record.tracked) - len(record.trajectory())
    causes = [f'the camera is lost in {lost} of {frames} frames{_fit(record)}']
    if record.skipped:
        first = record.skipped[0]
        causes.append(
            f'{len(record.skipped)} are skipped; the first: {first.name}: {first.reason}'
        )
    causes += record.warnings
    if record.depth_summary is not None and not any(
        warning.startswith(record.depth_summary) for warning in record.warnings
    ):
        causes.append(record.depth_summary)
    return (
        f'nothing was tracked: {". ".join(causes)}. Check depth, intrinsics and pairing with '
        f'`dcgs info`. What was written is in {folder}'
    )


def _fit(record: RunRecord) -> str:
    """Return how much of a median frame fits the map."""
    later = record.tracked[1:]
    if not later:
        return ''
    points, inliers = (
        int(np.median([getattr(frame.result, name) for frame in later]))
        for name in ('points', 'inliers')
    )
    return f'; of a median frame {inliers} of {points} depth points fit the map'


def _no_usable_frame(record: RunRecord) -> str:
    if not record.skipped:
        return f'{record.source}: holds no frame'
    first, count = record.skipped[0], len(record.skipped)
    return f'no usable frame: {count} of {count} skipped; the first: {first.name}: {first.reason}'
