# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A run from the first frame to the last file; what was computed is written if a part fails."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

from tqdm import tqdm

from ... import __version__
from ...core.kernels.workers import Workers
from ...core.render import make_renderer
from ...datasets.prefetch import prefetch_frames
from ...datasets.source import Source
from ...evaluation.contact_sheet import write_contact_sheet
from ...evaluation.depth_range import scale_warning
from ...evaluation.host import machine, peak_rss_mb
from ...evaluation.report import Accuracy, RunRecord, assess_run, build_report, with_rendering
from ...evaluation.scoring import score_map
from ...io.map_archive import SavedMap, write_map
from ...io.ply import write_ply
from ...io.snapshot import saved_map
from ..tables import run_summary
from .checkpoints import Checkpoints
from .deferred_errors import DeferredErrors
from .outputs import write_optimized, write_plot, write_report, write_tracks
from .pacing import at_recorded_pace, on_demand
from .pipeline import Pipeline
from .progress import Progress


class Session:
    """One run: call `process`, `save`, `evaluate` in this order, then `deferred.raise_first`."""

    def __init__(
        self,
        source: Source,
        pipeline: Pipeline,
        record: RunRecord,
        folder: Path,
        asked_s: float,
    ) -> None:
        """Write into `folder`, which exists; the user waits since `asked_s` (perf_counter)."""
        self.deferred = DeferredErrors()
        self._source, self._pipeline, self._record = source, pipeline, record
        self._folder, self._asked_s = folder, asked_s
        self._saved: SavedMap | None = None
        self._accuracy = Accuracy()
        self._report: dict[str, Any] = {}

    def process(self, total: int, stopped: Callable[[], bool]) -> None:
        """Track and map the first `total` frames, then refine the map, until `stopped`."""
        pipeline, record, deferred = self._pipeline, self._record, self.deferred
        for note in self._source.notes:
            self._warn(note)
        print(f'dcgs: tracking {total} frames of {record.source}', file=sys.stderr, flush=True)
        arrive = at_recorded_pace if pipeline.online else on_demand
        decoded = prefetch_frames(self._source, total, quietly=not pipeline.online)
        checkpoints = Checkpoints(self._folder, record, pipeline)
        with Progress(total) as progress, checkpoints:
            with deferred, closing(decoded), closing(arrive(decoded)) as items:
                pipeline.process(items, record, progress, stopped)
            if record.tracked:
                with deferred:
                    write_tracks(self._folder, record, pipeline.tracker.config)
            self._survey_depth()
            with deferred:  # even after a failure: this ends the mapper's thread
                pipeline.refine(record, progress, lambda: stopped() or deferred.failed)
            if record.tracked:
                with deferred:
                    write_optimized(self._folder, record)
        if pipeline.online:  # the mapper worked all the time
            record.mapping_s += record.frames_s

    def save(self) -> None:
        """Write the map, and the report without the scores of its renderings."""
        self._save_map()
        with self.deferred:
            self._accuracy = assess_run(self._record, self._source.groundtruth)
            self._warn(scale_warning(self._accuracy.ate, self._record.depth_per_metre))
            self._record.wall_s = time.perf_counter() - self._asked_s
            self._report = build_report(
                self._record, self._accuracy, machine(), peak_rss_mb(), __version__
            )
            write_report(self._folder, self._report)

    def _survey_depth(self) -> None:
        """Warn if the depth is hardly where the sensor measures: its unit may be wrong."""
        record, sensor = self._record, self._pipeline.tracker.config.sensor
        record.depth_in_range = record.depth.share(sensor)
        record.depth_summary = record.depth.summary(sensor, record.depth_per_metre)
        self._warn(record.depth.warning(sensor, record.depth_per_metre))

    def _warn(self, text: str | None) -> None:
        if text is not None:
            self._record.warnings.append(text)
            tqdm.write(f'dcgs: warning: {text}', file=sys.stderr)

    def _save_map(self) -> None:
        mapper, record, deferred = self._pipeline.mapper, self._record, self.deferred
        if mapper is None:
            return
        with deferred:
            pipeline = self._pipeline
            saved = saved_map(mapper, pipeline.tracker, record.source, pipeline.sessions)
            record.gaussians, record.iterations = len(saved.splats), mapper.steps
            self._saved = saved if len(saved.splats) else None
        if self._saved is None:
            return
        with deferred:
            write_ply(self._folder / 'map.ply', self._saved.splats)
        with deferred:
            write_map(self._folder / 'map.dcgs', self._saved)

    def evaluate(self, every: int, workers: Workers) -> None:
        """Plot the trajectory, score the map on every `every`-th frame, print the summary."""
        record, deferred = self._record, self.deferred
        with deferred:
            trajectory = record.trajectory()
            truth = self._source.groundtruth if self._accuracy.ate is not None else None
            if len(trajectory):
                write_plot(self._folder, record, truth)
        if every and self._saved is not None and not deferred.failed:
            with deferred:
                found = score_map(
                    self._saved, record.mapped(), self._source, every, make_renderer(workers)
                )
                self._report = with_rendering(self._report, found.scores)
                write_contact_sheet(self._folder / 'views.png', found.pairs)
        if self._report:
            with deferred:
                self._report['wall_s'] = time.perf_counter() - self._asked_s
                write_report(self._folder, self._report)
            print(run_summary(self._report, self._accuracy, self._folder), flush=True)
