# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The nodes as processes, a sequence to play to them, and somebody who watches."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from subprocess import Popen

from dcgs_ros.datasets.open import open_source
from dcgs_ros.datasets.source import Source
from dcgs_ros.nodes.harness.observer import Observer, wait_until
from dcgs_ros.nodes.harness.processes import Processes, sensor_parameters

LOADED_S = 300.0
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
        return self.processes.start('replay', chosen, None, self.prefixes.get('replay', ()))

    def _start(
        self, name: str, chosen: dict[str, object], parameters: dict[str, object]
    ) -> Popen[bytes]:
        chosen |= {key.replace('__', '.'): value for key, value in parameters.items()}
        if self.is_real:
            return self.processes.start(name, chosen, SENSOR, self.prefixes.get(name, ()))
        chosen |= sensor_parameters(self.source.sensor)
        return self.processes.start(name, chosen, None, self.prefixes.get(name, ()))

    def wait_ready(self, *nodes: str) -> None:
        def ready() -> bool:
            return all(self.observer.ready(f'dcgs_{node}') for node in nodes)

        wait_until(ready, LOADED_S, f'{nodes} ready')

    def wait_frames(self, count: int) -> None:
        wait_until(lambda: len(self.observer.poses) >= count, LOADED_S, f'{count} poses')

    def saved(self) -> Path:
        response = self.observer.call('/dcgs_mapper/save_map')
        assert response.success, response.message
        return Path(response.message.rpartition(' in ')[2])


def sequence() -> str:
    """Address of the real sequence, else of a synthetic one."""
    folder = os.environ.get('DCGS_TEST_DATA')
    real = Path(folder, 'tum_fr3_teddy_200') if folder else None
    return str(real) if real is not None and real.is_dir() else SYNTHETIC
