# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""One run from the first frame to the last file; nothing computed is lost when a part fails."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

from ... import __version__
from ...core.kernels.workers import Workers
from ...core.render import make_renderer
from ...datasets.prefetch import prefetch_frames
from ...datasets.source import Source
from ...evaluation.contact_sheet import write_contact_sheet
from ...evaluation.host import machine, peak_rss_mb
from ...evaluation.report import Accuracy, RunRecord, assess, build_report, with_rendering
from ...evaluation.scoring import score_map
from ...io.map_archive import SavedMap, write_map
from ...io.ply import write_ply
from ...io.snapshot import saved_map
from ..tables import run_summary
from .deferred_errors import DeferredErrors
from .outputs import write_plot, write_report, write_tracks
from .pipeline import Slam, as_they_come, follow, paced, refine
from .progress import Progress


class Session:
    """What a run works on; its methods are called in their order."""

    def __init__(self, source: Source, slam: Slam, record: RunRecord, folder: Path) -> None:
        """Take what is ready to start."""
        self.salvage = DeferredErrors()
        self._source, self._slam, self._record, self._folder = source, slam, record, folder
        self._saved: SavedMap | None = None
        self._accuracy = Accuracy()
        self._report: dict[str, Any] = {}

    def follow(self, total: int, stopped: Callable[[], bool]) -> None:
        """Track and map the first `total` frames, then refine the map, until `stopped`."""
        slam, record, part = self._slam, self._record, self.salvage
        print(f'dcgs: tracking {total} frames of {record.source}', file=sys.stderr, flush=True)
        feed = paced if slam.online else as_they_come
        decoded = prefetch_frames(self._source, total, quietly=not slam.online)
        with Progress(total) as progress:
            with part, closing(decoded), closing(feed(decoded)) as items:
                follow(items, slam.tracker, slam.mapping, record, progress, stopped)
            if record.tracked:
                with part:
                    write_tracks(self._folder, record, slam.tracker.config)
            with part:  # in any case: the mapper's thread ends here
                refine(slam.mapping, record, progress, lambda: stopped() or part.failed)
        if slam.online:  # the mapper was at it all the time
            record.mapping_s += record.wall_s

    def save(self) -> None:
        """Write the map, and the report as far as it goes."""
        self._save_map()
        record, part = self._record, self.salvage
        with part:
            self._accuracy = assess(record.trajectory(), self._source.groundtruth)
            self._report = build_report(
                record, self._accuracy, machine(), peak_rss_mb(), __version__
            )
            write_report(self._folder, self._report)

    def _save_map(self) -> None:
        mapper, record, part = self._slam.mapper, self._record, self.salvage
        if mapper is None:
            return
        with part:
            saved = saved_map(mapper, self._slam.tracker)
            record.gaussians, record.iterations = len(saved.splats), mapper.steps
            self._saved = saved if len(saved.splats) else None
        if self._saved is None:
            return
        with part:
            write_ply(self._folder / 'map.ply', self._saved.splats)
        with part:
            write_map(self._folder / 'map.dcgs', self._saved)

    def evaluate(self, every: int, workers: Workers) -> None:
        """Draw the trajectory, score the map on every `every`-th frame, and print what came."""
        record, part = self._record, self.salvage
        with part:
            truth = self._source.groundtruth if self._accuracy.ate is not None else None
            write_plot(self._folder, record, truth)
        if every and self._saved is not None and not part.failed:
            with part:
                trajectory, renderer = record.trajectory(), make_renderer(workers)
                found = score_map(self._saved, trajectory, self._source, every, renderer)
                self._report = with_rendering(self._report, found.scores)
                write_report(self._folder, self._report)
                write_contact_sheet(self._folder / 'views.png', found.pairs)
        if self._report:
            print(run_summary(self._report, self._accuracy, self._folder), flush=True)
