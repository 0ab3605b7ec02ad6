# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What a run leaves that is killed or loses its power: trajectory and map of a moment ago."""

from __future__ import annotations

import queue
import sys
import threading
from contextlib import closing, suppress
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ...core.errors import DcgsError
from ...core.mapping.mapper import Mapper
from ...core.mapping.splats import Splats
from ...evaluation.report import RunRecord
from ...io.ply import write_ply
from ...io.trajectory import TrajectoryStream
from .pipeline import Pipeline

INTERVAL_S = 15.0  # and as long again may the slowest of disks take


class Checkpoints:
    """Context manager with a thread that saves what there is.

    The run's own threads are only asked for a copy of the Gaussians, between two steps, and of the
    map only `map.ply` is written: `map.dcgs` takes ten times the work. The thread's priority is
    the usual one: where cores are busy, one that gives way while it holds the interpreter's lock
    stalls all others.
    """

    def __init__(self, folder: Path, record: RunRecord, pipeline: Pipeline) -> None:
        """Save into `folder` what the pipeline writes into `record`, and its map."""
        self._folder, self._record, self._pipeline = folder, record, pipeline
        self._frames = 0  # of the record, in the file
        self._copies: queue.SimpleQueue[NDArray[np.float32] | None] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name='checkpoints', daemon=True)

    def __enter__(self) -> Checkpoints:
        """Start the thread."""
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """End the thread, after a file that it is writing."""
        self._stop.set()
        self._copies.put(None)
        self._thread.join()

    def _run(self) -> None:
        with closing(TrajectoryStream(self._folder / 'trajectory.tum')) as stream:
            try:
                while not self._stop.wait(INTERVAL_S):
                    self._append_poses(stream)
                    self._save_map()
            except (DcgsError, OSError) as error:
                tqdm.write(f'dcgs: no more is saved before the end: {error}', file=sys.stderr)

    def _append_poses(self, stream: TrajectoryStream) -> None:
        frames = self._record.tracked[self._frames :]
        self._frames += len(frames)
        with suppress(FileExistsError):  # all frames are done, and the whole trajectory is there
            stream.append(RunRecord('', '', tracked=frames).trajectory())

    def _save_map(self) -> None:
        if self._pipeline.mapper is None:
            return
        self._pipeline.mapping.between_steps(self._copy)
        planes = self._copies.get()
        if planes is not None and planes.size:
            write_ply(self._folder / 'map.ply', Splats(planes[:, np.isfinite(planes).all(axis=0)]))

    def _copy(self, mapper: Mapper) -> None:
        self._copies.put(mapper.table.splats.planes.copy())
