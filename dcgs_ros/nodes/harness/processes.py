# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The nodes as processes, for tests, the demo and benchmarks."""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ...core.config.schema import flatten
from ...core.sensor import SensorNoise
from ..transport import prepare

_START = 'import sys; from dcgs_ros.nodes.start import {} as main; sys.exit(main())'
_DOMAINS = 101  # whose ports are free on every Linux
_END_S = 20.0
_LEAVE_S = 5.0


class Processes:
    """Starts nodes in their own ROS domain, on this host only, and ends those that still run."""

    def __init__(self, logs: Path, discovery: str = 'LOCALHOST') -> None:
        """Write a log file per node into `logs`; `discovery` SUBNET allows several hosts."""
        self._claim, self.domain = claim_domain()
        self._logs = logs
        self._running: list[subprocess.Popen[bytes]] = []
        prepare()
        self._environment = os.environ | {
            'ROS_AUTOMATIC_DISCOVERY_RANGE': discovery,
            'ROS_DOMAIN_ID': str(self.domain),
            'ROS_LOG_DIR': str(logs),
        }

    def start(
        self,
        name: str,
        parameters: Mapping[str, Any] | None = None,
        file: Path | None = None,
        prefix: tuple[str, ...] = (),
        remappings: tuple[tuple[str, str], ...] = (),
    ) -> subprocess.Popen[bytes]:
        """Start a node: tracker, mapper or replay; `__ns` is remapped to its namespace."""
        command = [*prefix, sys.executable, '-c', _START.format(name), '--ros-args']
        if file is not None:
            command += ['--params-file', str(file)]
        for name_before, name_after in remappings:
            command += ['-r', f'{name_before}:={name_after}']
        for key, value in (parameters or {}).items():
            command += ['-p', f'{key}:={_yaml(value)}']
        with open(self._logs / f'{name}-{len(self._running)}.log', 'wb') as log:
            process = subprocess.Popen(
                command, env=self._environment, stdout=log, stderr=subprocess.STDOUT
            )
        self._running.append(process)
        return process

    def stop(self, process: subprocess.Popen[bytes], number: int = signal.SIGINT) -> int:
        """End a process by a signal; return its status."""
        process.send_signal(number)
        return process.wait(_END_S)

    def __enter__(self) -> Processes:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """End what still runs; kill, which leaves files in /dev/shm, only what does not end."""
        left = [process for process in self._running if process.poll() is None]
        for process in left:
            process.send_signal(signal.SIGINT)
        end_s = time.monotonic() + _LEAVE_S
        for process in left:
            try:
                process.wait(max(end_s - time.monotonic(), 0.0))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._claim.close()


def sensor_parameters(sensor: SensorNoise) -> dict[str, Any]:
    """Return the parameters of tracker and mapper for a sequence's sensor."""
    return {f'sensor.{key}': value for key, value in flatten(sensor).items()}


def claim_domain() -> tuple[socket.socket, int]:
    """Return a ROS domain that no other test or demo of this host uses, and a socket.

    The domain is claimed while the socket is open.
    """
    for domain in random.SystemRandom().sample(range(_DOMAINS), _DOMAINS):
        claim = socket.socket(socket.AF_UNIX)
        try:
            claim.bind(f'\0dcgs-ros-domain-{domain}')
        except OSError:
            claim.close()
        else:
            return claim, domain
    raise OSError(f'all of {_DOMAINS} ROS domains are taken')


def _yaml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else str(value)
