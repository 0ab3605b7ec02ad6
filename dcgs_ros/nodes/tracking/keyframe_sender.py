# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Sends keyframes to the mapper, and again to one that lacks them."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Collection
from typing import Protocol

from ...core.kernels.workers import give_way
from ...core.keyframe import Correction
from ..messages.packet import KeyframePacket
from .kept_keyframe import Alive, KeptKeyframe

_IN_FLIGHT = 4  # sent and not acknowledged yet; views beyond it are left out
_RESENT_IN_FLIGHT = 2  # the same where keyframes are sent again
_PATIENCE_S = 3.0  # after which an unacknowledged packet counts as lost
_TICK_S = 0.1
_QUEUED = 16  # views waiting for the thread; keyframes always wait
_BYTES_PER_MB = 1e6


class KeyframeTransport(Protocol):
    """What carries packets to the mapper."""

    def connected(self) -> bool:
        """Return whether a mapper listens."""
        ...

    def send(self, packet: KeyframePacket) -> None:
        """Publish a packet."""
        ...


class KeyframeSender:
    """Sends keyframes from its own thread, and keeps them for a mapper that starts later.

    The mapper acknowledges by a list of the stamps it has. A keyframe that is not in the list is
    sent again, the oldest first. A packet without Gaussians is sent once, if few are in flight.
    Beyond `memory_mb` the images of every second kept keyframe are dropped; its Gaussians are
    then sent with a neighbour.
    """

    def __init__(self, transport: KeyframeTransport, memory_mb: float, alive: Alive) -> None:
        """Start the thread; `alive` tells which Gaussians still exist."""
        self._transport, self._alive = transport, alive
        self._budget = _BYTES_PER_MB * memory_mb
        self._kept: dict[int, KeptKeyframe] = {}
        self._sent_s: dict[int, float] = {}  # monotonic time by stamp, of what is in flight
        self._received: frozenset[int] = frozenset()  # stamps that the mapper has
        self._epoch = 0  # of the current map; what waits of another one is not sent
        self._queue: queue.SimpleQueue[KeyframePacket | Correction | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._closed = False
        self.sent = self.resent = self.left_out = 0
        self.failed = 0  # times that the transport raised; `failure` is the last such error
        self.failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name='keyframes', daemon=True)
        self._thread.start()

    def put(self, packet: KeyframePacket) -> None:
        """Queue a packet; return at once. One of another epoch drops all that is kept."""
        if packet.epoch != self._epoch:
            self.forget()
            self._epoch = packet.epoch
        if packet.carries_gaussians or self._queue.qsize() < _QUEUED:
            self._queue.put(packet)
        else:
            self.left_out += 1

    def correct(self, correction: Correction) -> None:
        """Have what is kept moved to its corrected poses; return at once. Nothing is sent."""
        self._queue.put(correction)

    def acknowledge(self, stamps_ns: Collection[int]) -> None:
        """Take the list of all stamps that the mapper has."""
        with self._lock:
            self._received = frozenset(stamps_ns)
            for stamp in self._received & self._sent_s.keys():
                del self._sent_s[stamp]

    def forget(self) -> None:
        """Drop all that is kept: a new map has begun."""
        with self._lock:
            self._epoch = 0
            self._kept.clear()
            self._sent_s.clear()

    @property
    def missing(self) -> int:
        """Number of kept keyframes that the mapper has not acknowledged."""
        with self._lock:
            return len(self._kept.keys() - self._received)

    def figures(self) -> dict[str, object]:
        """Return the counts for diagnostics."""
        return {
            'keyframes_missing': self.missing,
            'views_left_out': self.left_out,
            'offers_failed': self.failed,
        }

    def close(self) -> None:
        """End the thread; what still waits is not sent."""
        self._closed = True
        self._queue.put(None)
        self._thread.join()

    def _run(self) -> None:
        give_way()
        while not self._closed:
            try:
                self._send_next()
                self._resend()
            except Exception as error:  # what is kept is sent again
                self.failed, self.failure = self.failed + 1, error

    def _send_next(self) -> None:
        """Send the next packet of the queue; keep it if it carries Gaussians."""
        try:
            packet = self._queue.get(timeout=_TICK_S)
        except queue.Empty:
            return
        if isinstance(packet, Correction):
            self._move_kept(packet)
            return
        if packet is None or packet.epoch != self._epoch:
            return
        try:
            if self._transport.connected() and self._has_room(_IN_FLIGHT):
                self._send(packet)
                self.sent += 1
            elif not packet.carries_gaussians:
                self.left_out += 1
        finally:
            if packet.carries_gaussians:
                self._keep(packet)

    def _move_kept(self, correction: Correction) -> None:
        """Put all that is kept into one world: thinning joins Gaussians of several keyframes."""
        with self._lock:
            kept = dict(self._kept)
        for stamp, T in zip(correction.stamps_ns.tolist(), correction.T_world_cam, strict=True):
            if stamp in kept:
                kept[stamp].move_to(T)

    def _keep(self, packet: KeyframePacket) -> None:
        kept = KeptKeyframe.of(packet)
        with self._lock:
            if packet.epoch == self._epoch:
                self._kept[packet.stamp_ns] = kept
                self._thin()

    def _resend(self) -> None:
        """Send the oldest keyframe that the mapper lacks and that is not in flight."""
        if self._closed or not self._transport.connected():
            return
        if not self._has_room(_RESENT_IN_FLIGHT):
            return
        with self._lock:
            lacking = self._kept.keys() - self._received - self._sent_s.keys()
            if not lacking:
                return
            kept = self._kept[min(lacking)]
            # Before it is sent: one that cannot be must not hold up the others.
            self._sent_s[min(lacking)] = time.monotonic()
        self._send(kept.decoded(self._alive))
        self.resent += 1

    def _send(self, packet: KeyframePacket) -> None:
        with self._lock:
            self._sent_s[packet.stamp_ns] = time.monotonic()
        self._transport.send(packet)

    def _has_room(self, limit: int) -> bool:
        """Return whether fewer than `limit` packets are in flight, lost ones not counted."""
        late = time.monotonic() - _PATIENCE_S
        with self._lock:
            self._sent_s = {k: sent for k, sent in self._sent_s.items() if sent > late}
            return len(self._sent_s) < limit

    def _thin(self) -> None:
        """Beyond the budget drop every second keyframe; a neighbour gets its Gaussians."""
        if sum(kept.bytes for kept in self._kept.values()) <= self._budget:
            return
        stamps = sorted(self._kept)
        for pair in zip(stamps[:-2:2], stamps[1:-1:2], strict=True):
            for dropped, heir in (pair, pair[::-1]):
                if self._may_take_over(heir, dropped):
                    self._kept[heir].take_over(self._kept.pop(dropped))
                    break

    def _may_take_over(self, heir: int, dropped: int) -> bool:
        """Return whether the Gaussians of `dropped` reach the mapper, which may lack them."""
        together = self._kept[heir].keyframe.submap == self._kept[dropped].keyframe.submap
        reaches = dropped in self._received or heir not in self._received
        return heir not in self._sent_s and together and reaches
