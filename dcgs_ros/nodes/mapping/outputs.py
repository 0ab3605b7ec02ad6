# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Publishes the map, its changes, its keyframes, and views of it."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import Image, PointCloud2

from ...core.config.nodes import MapperNodeSettings
from ...core.keyframe import MapUpdate
from ...core.mapping.mapper import Mapper
from ...core.render.renderer import Rendering
from ..messages.clouds import MAP_GAUSSIAN, write_cloud
from ..messages.images import header, write_color, write_depth
from ..messages.keyframes import write_answer
from ..messages.map_rows import keyframe_rows, map_rows
from ..messages.maps import UPDATES_KEPT, changes
from ..transport import RELIABLE, latched

_MIN_OPACITY = 1e-3  # of a rendered pixel, to divide depth by
_SOLID = 0.5  # transmittance below which a pixel has depth


class MapOutputs:
    """Publishes from the mapping thread.

    The map's stamp is that of its newest keyframe and never goes back: an update applies to a map
    with an older stamp.
    """

    def __init__(self, node: Node, settings: MapperNodeSettings) -> None:
        """Advertise the topics."""
        self._settings = settings
        self.world = settings.map_frame  # frame that the map is in
        advertise = node.create_publisher
        self._map = advertise(PointCloud2, 'gaussian_map', latched(1))
        self._updates = advertise(PointCloud2, 'gaussian_map_updates', latched(UPDATES_KEPT))
        self._received = advertise(PointCloud2, 'keyframe/received', latched(1))
        self._answers = advertise(PointCloud2, 'keyframe/answer', RELIABLE)
        self._color = advertise(Image, 'render/color', RELIABLE)
        self._depth = advertise(Image, 'render/depth', RELIABLE)
        self._rows = np.zeros(0, MAP_GAUSSIAN)  # as last published
        self.stamp_ns = 0  # of the map
        self._since_whole = UPDATES_KEPT  # updates: the first map is due at once
        self._whole_stamp_ns = -1
        now = time.monotonic()
        self._update_s = self._whole_s = self._render_s = now

    def update_when_due(self, mapper: Mapper | None) -> None:
        """Publish the map's changes at their rate."""
        rate_hz = self._settings.update_rate_hz
        if rate_hz <= 0 or mapper is None or time.monotonic() < self._update_s:
            return
        self._update_s = time.monotonic() + 1.0 / rate_hz
        self.update(mapper)

    def update(self, mapper: Mapper | None) -> None:
        """Publish the changes since the last call, and the whole map when it is due."""
        rows = np.zeros(0, MAP_GAUSSIAN) if mapper is None else map_rows(mapper)
        changed = changes(self._rows, rows)
        if len(changed):
            self.stamp_ns = max(_newest_ns(mapper), self.stamp_ns + 1)
            self._updates.publish(self._cloud(changed))
            self._rows = rows
            self._since_whole += 1
        self._publish_whole_when_due()

    def _publish_whole_when_due(self) -> None:
        """Publish the whole map, if it changed, at its rate or before updates are forgotten."""
        rate_hz = self._settings.map_rate_hz
        due = rate_hz > 0 and time.monotonic() >= self._whole_s
        if self.stamp_ns != self._whole_stamp_ns and (due or self._since_whole >= UPDATES_KEPT):
            self._map.publish(self._cloud(self._rows))
            self._whole_stamp_ns, self._since_whole = self.stamp_ns, 0
            self._whole_s = time.monotonic() + (1.0 / rate_hz if rate_hz > 0 else 0.0)

    def _cloud(self, rows: NDArray[Any]) -> PointCloud2:
        return write_cloud(rows, header(self.stamp_ns, self.world))

    def keyframes(self, mapper: Mapper | None) -> None:
        """Publish which keyframes there are; the tracker sends what is not among them."""
        views, submaps = ([], []) if mapper is None else (mapper.views, mapper.submaps)
        rows = keyframe_rows(views, submaps)
        in_world = header(_newest_ns(mapper), self.world)
        self._received.publish(write_cloud(rows, in_world))

    def answer(self, update: MapUpdate, stamp_ns: int) -> None:
        """Publish for the tracker what became of its Gaussians."""
        self._answers.publish(write_answer(update, stamp_ns, self.world))

    def render_due(self) -> bool:
        """Return whether a view is due and subscribed to."""
        rate_hz = self._settings.render_rate_hz
        if rate_hz <= 0 or time.monotonic() < self._render_s:
            return False
        self._render_s = time.monotonic() + 1.0 / rate_hz
        subscribers = self._color.get_subscription_count() + self._depth.get_subscription_count()
        return subscribers > 0

    def rendering(self, rendering: Rendering, stamp_ns: int, camera_frame: str) -> None:
        """Publish a view in the camera's frame."""
        in_camera = header(stamp_ns, camera_frame)
        color = np.rint(255.0 * rendering.color.clip(0.0, 1.0)).astype(np.uint8)
        self._color.publish(write_color(np.ascontiguousarray(color.transpose(1, 2, 0)), in_camera))
        opacity = np.maximum(1.0 - rendering.transmittance, _MIN_OPACITY)
        solid = rendering.transmittance < _SOLID
        depth_m = np.where(solid, rendering.depth / opacity, 0.0).astype(np.float32)
        self._depth.publish(write_depth(depth_m, in_camera))


def _newest_ns(mapper: Mapper | None) -> int:
    """Return the stamp of the newest keyframe; 0 without one."""
    views = [] if mapper is None else mapper.views
    return max((view.stamp_ns for view in views), default=0)
