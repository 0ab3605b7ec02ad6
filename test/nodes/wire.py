# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Two network namespaces and a slow, lossy wire between them: `python wire.py NAME NAME`.

The wire is two TAP devices and a process that carries packets, since few kernels have netem. Its
queue is netem's by default: a thousand packets a direction, what comes beyond is dropped. It ends
with its standard input, and so with whoever started it.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import random
import select
import shutil
import struct
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

RATE_BITS_PER_S = 100e6
DELAY_S = 0.02
LOSS = 0.01
QUEUE = 1000  # packets
ADDRESSES = ('10.77.0.1', '10.77.0.2')
_TUNSETIFF, _TAP_WITHOUT_HEADER = 0x400454CA, 0x1002
_CLONE_NEWNET = 0x40000000
_FRAME = 65536  # bytes, of the largest packet
_PATIENCE_S = 10.0


def why_not() -> str | None:
    """Say what is lacking for a wire, if something is."""
    if shutil.which('ip') is None:
        return 'there is no `ip`'
    if os.geteuid() != 0:
        return 'namespaces are for root'
    if not os.access('/dev/net/tun', os.W_OK):
        return 'there is no /dev/net/tun'
    name = f'dcgs-{os.getpid()}-try'
    made = subprocess.run(['ip', 'netns', 'add', name], capture_output=True, text=True)
    if made.returncode:
        return f'ip netns add: {made.stderr.strip()}'
    subprocess.run(['ip', 'netns', 'del', name], check=True)
    return None


@contextmanager
def wired() -> Iterator[tuple[str, str]]:
    """Make two namespaces joined by a wire; yields their names."""
    names = f'dcgs-{os.getpid()}-a', f'dcgs-{os.getpid()}-b'
    wire: subprocess.Popen[str] | None = None
    try:
        for name in names:
            _ip('netns', 'add', name)
        wire = subprocess.Popen(
            [sys.executable, __file__, *names],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert wire.stdout is not None
        assert wire.stdout.readline() == 'up\n', f'wire ended with {wire.wait(_PATIENCE_S)}'
        yield names
    finally:
        if wire is not None:
            wire.kill()
            wire.communicate()
        for name in names:
            subprocess.run(['ip', 'netns', 'del', name], capture_output=True)


def inside(name: str, own_shm: bool = True) -> tuple[str, ...]:
    """Begin a command with this to run it there, by default with a /dev/shm of its own."""
    there = ('ip', 'netns', 'exec', name)
    mount = 'mount -t tmpfs shm /dev/shm && exec "$@"'
    return (*there, 'unshare', '--mount', 'sh', '-c', mount, 'sh') if own_shm else there


@contextmanager
def entered(name: str) -> Iterator[None]:
    """Be in a namespace: sockets that this thread, and threads that it starts, make are there."""
    libc = ctypes.CDLL(None, use_errno=True)
    with open('/proc/thread-self/ns/net') as home, open(f'/var/run/netns/{name}') as there:
        if libc.setns(there.fileno(), _CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), f'setns {name}')
        try:
            yield
        finally:
            libc.setns(home.fileno(), _CLONE_NEWNET)


def received_bytes(name: str) -> int:
    """Count what came over the wire into a namespace."""
    text = subprocess.run(
        ['ip', 'netns', 'exec', name, 'cat', '/proc/net/dev'],
        check=True, capture_output=True, text=True,
    ).stdout  # fmt: skip
    line = next(line for line in text.splitlines() if line.strip().startswith('dcgs'))
    return int(line.split(':')[1].split()[0])


class _Direction:
    """Packets on their way."""

    def __init__(self, source: int, sink: int, seed: int) -> None:
        self._source, self._sink = source, sink
        self._random = random.Random(seed)
        self._on_the_way: deque[tuple[float, bytes]] = deque()
        self._free_s = 0.0  # when all that waits has been put on the wire

    def take(self) -> None:
        """Put a packet on the wire, unless it gets lost."""
        packet, now = os.read(self._source, _FRAME), time.monotonic()
        waiting_s = max(0.0, self._free_s - now)
        full = waiting_s * RATE_BITS_PER_S > QUEUE * 8 * len(packet)
        if full or self._random.random() < LOSS:
            return
        self._free_s = now + waiting_s + 8 * len(packet) / RATE_BITS_PER_S
        self._on_the_way.append((self._free_s + DELAY_S, packet))

    def deliver(self) -> float:
        """Hand over what has arrived; returns the seconds until the next one does."""
        while self._on_the_way:
            left_s = self._on_the_way[0][0] - time.monotonic()
            if left_s > 0:
                return left_s
            try:
                os.write(self._sink, self._on_the_way.popleft()[1])
            except OSError:  # the other side is going
                pass
        return 1.0

    def carry(self) -> None:
        """Carry packets for ever."""
        left_s = 1.0
        while True:
            ready, _, _ = select.select([self._source], [], [], left_s)
            if ready:
                self.take()
            left_s = self.deliver()


def _plug(name: str, address: str) -> int:
    """Make a TAP device in a namespace; returns its other end."""
    device = f'dcgs{os.getpid()}{name[-1]}'
    end = os.open('/dev/net/tun', os.O_RDWR)
    fcntl.ioctl(end, _TUNSETIFF, struct.pack('16sH', device.encode(), _TAP_WITHOUT_HEADER))
    _ip('link', 'set', device, 'netns', name)
    _ip('-n', name, 'addr', 'add', f'{address}/24', 'dev', device)
    for each in ('lo', device):
        _ip('-n', name, 'link', 'set', each, 'up')
    return end


def _ip(*arguments: str) -> None:
    subprocess.run(['ip', *arguments], check=True)


def _main() -> None:
    a, b = (_plug(*each) for each in zip(sys.argv[1:], ADDRESSES, strict=True))
    for k, (source, sink) in enumerate([(a, b), (b, a)]):
        threading.Thread(target=_Direction(source, sink, k).carry, daemon=True).start()
    print('up', flush=True)
    sys.stdin.read()


if __name__ == '__main__':
    _main()
