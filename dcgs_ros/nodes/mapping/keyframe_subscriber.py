# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Subscribes to keyframes and joins their messages for the mapping thread."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from rclpy.node import Node

from ...io.ros_images import stamp_ns
from ..messages.keyframes import TOPICS
from ..transport import RELIABLE
from ..work_queue import WorkQueue

_WAITING_KEYFRAMES = 32
_INCOMPLETE = 16  # stamps of which some messages have not come yet


class KeyframeSubscriber:
    """Puts keyframes into a queue, each a message for every topic by its name."""

    def __init__(self, node: Node) -> None:
        """Subscribe to `keyframe/*`."""
        self.queue: WorkQueue[dict[str, Any]] = WorkQueue(_WAITING_KEYFRAMES)
        self._joiner = Joiner(tuple(TOPICS), _INCOMPLETE)
        self._node = node
        self._topics: list[str] = []  # with the namespace
        for name, kind in TOPICS.items():
            on_part = partial(self._on_part, name)
            made = node.create_subscription(kind, f'keyframe/{name}', on_part, RELIABLE)
            self._topics.append(made.topic_name)

    def trackers(self) -> int:
        """Return how many trackers live, as far as discovery knows; killed ones do for a while."""
        return max(self._node.count_publishers(topic) for topic in self._topics)

    def _on_part(self, name: str, message: Any) -> None:
        parts = self._joiner.add(name, stamp_ns(message.header.stamp), message)
        if parts is not None:
            self.queue.put(parts)

    def figures(self) -> dict[str, object]:
        """Return the counts for diagnostics."""
        return {
            'waiting': len(self.queue),
            'dropped': self.queue.dropped,
            'incomplete': self._joiner.dropped,
        }


class Joiner:
    """Joins messages of several topics that carry one stamp, in whatever order they arrive."""

    def __init__(self, names: Sequence[str], capacity: int = 8) -> None:
        """Join one message of each of `names`; let at most `capacity` stamps be incomplete."""
        self._names = frozenset(names)
        self._capacity = capacity
        self._parts: dict[int, dict[str, Any]] = {}
        self.dropped = 0  # stamps that stayed incomplete

    def add(self, name: str, stamp_ns: int, item: Any) -> dict[str, Any] | None:
        """Take a message; return all messages of its stamp, by name, once they are complete."""
        parts = self._parts.setdefault(stamp_ns, {})
        parts[name] = item
        if parts.keys() >= self._names:
            return self._parts.pop(stamp_ns)
        if len(self._parts) > self._capacity:
            del self._parts[next(iter(self._parts))]  # the first to arrive
            self.dropped += 1
        return None
