# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Keyframes on their way to the mapper, and again to one that does not have them."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.camera import PinholeCamera
from ...core.kernels.workers import give_way
from ...core.keyframe import Keyframe
from ...io.ros_images import in_millimetres

_IN_FLIGHT = 4  # offered and not acknowledged yet; views beyond it are left out
_AGAIN = 2  # ... and of those offered once more, one at a time for each of this
_PATIENCE_S = 3.0  # after which an offer counts as lost on the way
_TICK_S = 0.1
_QUEUED = 16  # views waiting for the sender; keyframes always wait
_DEPTH_UNITS = np.float32(1000.0)  # of a metre: the 16UC1 that is sent
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 95]
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]


@dataclass(frozen=True)
class KeyframePacket:
    """A keyframe for the mapper."""

    epoch: int
    camera: PinholeCamera
    keyframe: Keyframe


@dataclass
class _Kept:
    """An offer with its images as files would have them."""

    offer: KeyframePacket  # without images
    color: NDArray[np.uint8]
    depth: NDArray[np.uint8]

    @property
    def bytes(self) -> int:
        return self.color.nbytes + self.depth.nbytes + 60 * len(self.offer.keyframe.ids)


class Link(Protocol):
    """The way to the mapper."""

    def connected(self) -> bool:
        """Tell whether a mapper listens."""
        ...

    def send(self, offer: KeyframePacket) -> None:
        """Publish an offer."""
        ...


class KeyframeSender:
    """Sends keyframes from a thread of its own, and keeps them for a mapper that comes later.

    What a mapper has it says: a list of stamps. A keyframe that is not among them is offered
    again, the oldest first. Views that bring no Gaussians are sent once, if the way is free.
    Beyond `memory_mb` every second of the kept images goes; its Gaussians are then offered with
    the next.
    """

    def __init__(
        self, link: Link, memory_mb: float, alive: Callable[[NDArray], NDArray[np.bool_]]
    ) -> None:
        """Start the thread; `alive` tells which of a keyframe's Gaussians there still are."""
        self._link, self._budget, self._alive = link, 1e6 * memory_mb, alive
        self._kept: dict[int, _Kept] = {}
        self._sent_s: dict[int, float] = {}  # monotonic time by stamp, of what is not acknowledged
        self._had: frozenset[int] = frozenset()
        self._epoch = 0  # of the map that is offered; what still waits of another is of no use
        self._queue: queue.SimpleQueue[KeyframePacket | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._closed = False
        self.offered = self.offered_again = self.left_out = 0
        self.failed = 0  # times that the link raised; `failure` is the last such error
        self.failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name='offers', daemon=True)
        self._thread.start()

    def put(self, offer: KeyframePacket) -> None:
        """Take an offer to be sent; returns at once. One of another map is the end of the last."""
        if offer.epoch != self._epoch:
            self.forget()
            self._epoch = offer.epoch
        if len(offer.keyframe.ids) or self._queue.qsize() < _QUEUED:
            self._queue.put(offer)
        else:
            self.left_out += 1

    def acknowledge(self, stamps_ns: Collection[int]) -> None:
        """Take the list of all that the mapper has."""
        with self._lock:
            self._had = frozenset(stamps_ns)
            for stamp in self._had & self._sent_s.keys():
                del self._sent_s[stamp]

    def forget(self) -> None:
        """Drop all that is kept: a new map has begun."""
        with self._lock:
            self._epoch = 0
            self._kept.clear()
            self._sent_s.clear()

    @property
    def missing(self) -> int:
        """Keyframes that the mapper has not told it has."""
        with self._lock:
            return len(self._kept.keys() - self._had)

    def close(self) -> None:
        """End the thread; what still waits is not sent."""
        self._closed = True
        self._queue.put(None)
        self._thread.join()

    def _run(self) -> None:
        give_way()
        while not self._closed:
            try:
                self._offer_next()
                self._offer_again()
            except Exception as error:  # what is kept is offered again
                self.failed, self.failure = self.failed + 1, error

    def _offer_next(self) -> None:
        try:
            offer = self._queue.get(timeout=_TICK_S)
        except queue.Empty:
            return
        if offer is not None and offer.epoch == self._epoch:
            self._offer(offer)

    def _offer(self, offer: KeyframePacket) -> None:
        keyframe = bool(len(offer.keyframe.ids))
        try:
            if self._link.connected() and self._room(_IN_FLIGHT):
                self._send(offer)
                self.offered += 1
            elif not keyframe:
                self.left_out += 1
        finally:
            if keyframe:
                self._keep(offer)

    def _keep(self, offer: KeyframePacket) -> None:
        kept = _encoded(offer)
        with self._lock:
            if offer.epoch == self._epoch:
                self._kept[offer.keyframe.frame.stamp_ns] = kept
                self._thin()

    def _offer_again(self) -> None:
        if not self._link.connected() or not self._room(_AGAIN):
            return
        with self._lock:
            lacking = self._kept.keys() - self._had - self._sent_s.keys()
            if not lacking:
                return
            kept = self._kept[min(lacking)]
            self._sent_s[min(lacking)] = time.monotonic()  # whatever comes of it: others are next
        self._send(_decoded(kept, self._alive))
        self.offered_again += 1

    def _send(self, offer: KeyframePacket) -> None:
        with self._lock:
            self._sent_s[offer.keyframe.frame.stamp_ns] = time.monotonic()
        self._link.send(offer)

    def _room(self, limit: int) -> bool:
        """Tell whether fewer than `limit` are on their way; what is for too long is lost."""
        late = time.monotonic() - _PATIENCE_S
        with self._lock:
            self._sent_s = {k: sent for k, sent in self._sent_s.items() if sent > late}
            return len(self._sent_s) < limit

    def _thin(self) -> None:
        """Do without every second of the kept images, the newest apart; Gaussians stay."""
        if sum(kept.bytes for kept in self._kept.values()) <= self._budget:
            return
        stamps = sorted(self._kept)
        for pair in zip(stamps[:-2:2], stamps[1:-1:2], strict=True):
            for left, heir in (pair, pair[::-1]):
                if self._inherits(heir, left):
                    offer = self._kept.pop(left).offer
                    self._kept[heir].offer = _merged(self._kept[heir].offer, offer)
                    break

    def _inherits(self, heir: int, left: int) -> bool:
        """Tell whether what a keyframe takes over comes to the mapper, if it is not there yet."""
        return heir not in self._sent_s and (left in self._had or heir not in self._had)


def _merged(heir: KeyframePacket, left: KeyframePacket) -> KeyframePacket:
    ours, theirs = heir.keyframe, left.keyframe
    keyframe = replace(
        ours, ids=np.concatenate([ours.ids, theirs.ids]),
        means=np.concatenate([ours.means, theirs.means]),
        normals=np.concatenate([ours.normals, theirs.normals]),
    )  # fmt: skip
    return replace(heir, keyframe=keyframe)


def _encoded(offer: KeyframePacket) -> _Kept:
    """Compress the images, depth without loss to the millimetre that is sent."""
    frame = offer.keyframe.frame
    pixel = frame.color[:1, :1].copy()  # a view would keep the whole image
    small = replace(frame, color=pixel, depth_m=np.ones((1, 1), np.float32))
    color = frame.color if frame.color.ndim == 2 else frame.color[..., ::-1]
    return _Kept(
        replace(offer, keyframe=replace(offer.keyframe, frame=small)),
        cv2.imencode('.jpg', color, _JPEG)[1],
        cv2.imencode('.png', in_millimetres(frame.depth_m), _PNG)[1],
    )


def _decoded(kept: _Kept, alive: Callable[[NDArray], NDArray[np.bool_]]) -> KeyframePacket:
    """Make the offer anew, without the Gaussians that are gone by now."""
    offer = kept.offer
    keyframe, grey = offer.keyframe, offer.keyframe.frame.color.ndim == 2
    flag = cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR
    color = cv2.imdecode(kept.color, flag)
    depth_m = cv2.imdecode(kept.depth, cv2.IMREAD_UNCHANGED).astype(np.float32) / _DEPTH_UNITS
    frame = replace(
        keyframe.frame, color=np.ascontiguousarray(color if grey else color[..., ::-1]),
        depth_m=depth_m,
    )  # fmt: skip
    here = alive(keyframe.ids)
    keyframe = replace(
        keyframe, frame=frame, ids=keyframe.ids[here], means=keyframe.means[here],
        normals=keyframe.normals[here],
    )  # fmt: skip
    return replace(offer, keyframe=keyframe)
