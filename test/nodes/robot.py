# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The nodes as processes, a sequence to play to them, and somebody who watches."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from subprocess import Popen

from dcgs_ros.datasets.open import open_source
from dcgs_ros.datasets.source import Source
from dcgs_ros.nodes.harness.observer import Observer, wait_until
from dcgs_ros.nodes.harness.processes import Processes, sensor_parameters

PATIENCE_S = 600.0  # only a failure takes so long
SENSOR = Path(__file__).resolve().parents[2] / 'config' / 'tum_fr3.yaml'
SYNTHETIC = 'synthetic:room?frames=200'  # where there are no real sequences
SYNTHETIC_RATE = 0.25  # making a frame takes 40 ms of a core
SYNTHETIC_SLOP_S = 0.03  # its depth is up to 25 ms before colour


@dataclass
class Robot:
    processes: Processes
    observer: Observer
    logs: Path
    address: str  # of the sequence
    prefixes: dict[str, tuple[str, ...]]  # of a node's command, by its name
    started: list[Popen[bytes]] = field(default_factory=list)

    @property
    def source(self) -> Source:
        return open_source(self.address)

    @property
    def is_real(self) -> bool:
        return not self.address.startswith('synthetic:')

    def tracker(self, **parameters: object) -> Popen[bytes]:
        chosen: dict[str, object] = {'node.reliability': 'reliable', 'node.resume': True}
        if not self.is_real:
            chosen['node.sync_slop_s'] = SYNTHETIC_SLOP_S
        return self._start('tracker', chosen, parameters)

    def mapper(self, **parameters: object) -> Popen[bytes]:
        return self._start('mapper', {'node.save_folder': str(self.logs / 'maps')}, parameters)

    def replay(self, **parameters: object) -> Popen[bytes]:
        chosen: dict[str, object] = {'source': self.address, 'wait_for_subscribers': 1}
        if not self.is_real:
            chosen['rate'] = SYNTHETIC_RATE
        chosen |= parameters
        return self._started('replay', chosen, None)

    def _start(
        self, name: str, chosen: dict[str, object], parameters: dict[str, object]
    ) -> Popen[bytes]:
        chosen |= {key.replace('__', '.'): value for key, value in parameters.items()}
        if self.is_real:
            return self._started(name, chosen, SENSOR)
        return self._started(name, chosen | sensor_parameters(self.source.sensor), None)

    def _started(self, name: str, chosen: dict[str, object], file: Path | None) -> Popen[bytes]:
        node = self.processes.start(name, chosen, file, self.prefixes.get(name, ()))
        self.started.append(node)
        return node

    def wait(self, condition: Callable[[], bool], what: str) -> None:
        """Wait until something has come true.

        The threads that give way to all others get a share like theirs meanwhile, where we may:
        beside a load that fills the cores the mapper would come to nothing.
        """

        def reached() -> bool:
            for node in self.started:
                _make_equal(node.pid)
            return condition()

        wait_until(reached, PATIENCE_S, what)

    def wait_ready(self, *nodes: str) -> None:
        def ready() -> bool:
            return all(self.observer.ready(f'dcgs_{node}') for node in nodes)

        self.wait(ready, f'{nodes} ready')

    def wait_frames(self, count: int) -> None:
        self.wait(lambda: len(self.observer.poses) >= count, f'{count} poses')

    def saved(self) -> Path:
        response = self.observer.call('/dcgs_mapper/save_map')
        assert response.success, response.message
        return Path(response.message.rpartition(' in ')[2])


def _make_equal(pid: int) -> None:
    with suppress(OSError):  # of an end, or of not being allowed to
        for task in Path(f'/proc/{pid}/task').iterdir():
            if os.getpriority(os.PRIO_PROCESS, int(task.name)) > 0:
                os.setpriority(os.PRIO_PROCESS, int(task.name), 0)


def sequence() -> str:
    """Address of the real sequence, else of a synthetic one."""
    folder = os.environ.get('DCGS_TEST_DATA')
    real = Path(folder, 'tum_fr3_teddy_200') if folder else None
    return str(real) if real is not None and real.is_dir() else SYNTHETIC
