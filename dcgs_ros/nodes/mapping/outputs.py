# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What the mapper publishes: the map, its changes, its keyframes, views of it."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import Image, PointCloud2

from ...core.config.nodes import MapperNodeSettings
from ...core.keyframe import MapUpdate
from ...core.mapping.mapper import Mapper
from ...core.render.renderer import Rendering
from ..messages.clouds import MAP_GAUSSIAN, write_cloud
from ..messages.keyframes import write_answer
from ..messages.maps import UPDATES_KEPT, keyframe_rows, map_rows
from ..messages.standard import header, write_color, write_depth
from ..tracking.map_mirror import changes
from ..transport import RELIABLE, latched

_OPTICAL = 'camera_color_optical_frame'


class MapOutputs:
    """Publishes from the mapping thread.

    The map's stamp is that of its newest keyframe and only grows: an update applies to what is
    older.
    """

    def __init__(self, node: Node, settings: MapperNodeSettings) -> None:
        """Advertise the topics."""
        self._settings = settings
        advertise = node.create_publisher
        self._map = advertise(PointCloud2, 'gaussian_map', latched(1))
        self._updates = advertise(PointCloud2, 'gaussian_map_updates', latched(UPDATES_KEPT))
        self._keyframes = advertise(PointCloud2, '~/keyframes', latched(1))
        self._answers = advertise(PointCloud2, 'keyframe/answer', RELIABLE)
        self._color = advertise(Image, 'render/color', RELIABLE)
        self._depth = advertise(Image, 'render/depth', RELIABLE)
        self._rows = np.zeros(0, MAP_GAUSSIAN)  # as published last
        self._stamp_ns = 0
        self._since_whole = UPDATES_KEPT  # updates; who comes late needs a first whole map
        self._whole_stamp_ns = -1
        now = time.monotonic()
        self._update_s = self._whole_s = self._render_s = now

    def update_when_due(self, mapper: Mapper | None) -> None:
        """Publish what changed, and now and then the whole map."""
        rate_hz = self._settings.update_rate_hz
        if rate_hz <= 0 or mapper is None or time.monotonic() < self._update_s:
            return
        self._update_s = time.monotonic() + 1.0 / rate_hz
        self.update(mapper)

    def update(self, mapper: Mapper | None) -> None:
        """Publish the changes since the last time; the whole map where one is due."""
        rows = np.zeros(0, MAP_GAUSSIAN) if mapper is None else map_rows(mapper)
        news = changes(self._rows, rows)
        if len(news):
            self._stamp_ns = max(_newest_ns(mapper), self._stamp_ns + 1)
            self._updates.publish(self._cloud(news))
            self._rows = rows
            self._since_whole += 1
        self._whole()

    def _whole(self) -> None:
        """Publish the whole map, if it changed, when it is due or updates get too many."""
        rate_hz = self._settings.map_rate_hz
        due = rate_hz > 0 and time.monotonic() >= self._whole_s
        if self._stamp_ns != self._whole_stamp_ns and (due or self._since_whole >= UPDATES_KEPT):
            self._map.publish(self._cloud(self._rows))
            self._whole_stamp_ns, self._since_whole = self._stamp_ns, 0
            self._whole_s = time.monotonic() + (1.0 / rate_hz if rate_hz > 0 else 0.0)

    def _cloud(self, rows: NDArray) -> PointCloud2:
        return write_cloud(rows, header(self._stamp_ns, self._settings.odom_frame))

    def keyframes(self, mapper: Mapper | None) -> None:
        """Tell which keyframes there are; the tracker offers what is not among them."""
        rows = keyframe_rows([] if mapper is None else mapper.views)
        placed = header(_newest_ns(mapper), self._settings.odom_frame)
        self._keyframes.publish(write_cloud(rows, placed))

    def answer(self, update: MapUpdate, stamp_ns: int) -> None:
        """Tell the tracker what became of its Gaussians."""
        cloud = write_answer(update, stamp_ns, self._settings.odom_frame)
        self._answers.publish(cloud)

    def render_due(self) -> bool:
        """Tell whether it is time for a view, and somebody looks."""
        rate_hz = self._settings.render_rate_hz
        if rate_hz <= 0 or time.monotonic() < self._render_s:
            return False
        self._render_s = time.monotonic() + 1.0 / rate_hz
        looked_at = self._color.get_subscription_count() + self._depth.get_subscription_count()
        return looked_at > 0

    def rendering(self, rendering: Rendering, stamp_ns: int) -> None:
        """Publish a view, in the camera's frame."""
        placed = header(stamp_ns, _OPTICAL)
        color = np.rint(255.0 * rendering.color.clip(0.0, 1.0)).astype(np.uint8)
        self._color.publish(write_color(np.ascontiguousarray(color.transpose(1, 2, 0)), placed))
        shown = np.maximum(1.0 - rendering.transmittance, 1e-3)
        solid = rendering.transmittance < 0.5
        depth_m = np.where(solid, rendering.depth / shown, 0.0).astype(np.float32)
        self._depth.publish(write_depth(depth_m, placed))


def _newest_ns(mapper: Mapper | None) -> int:
    """Stamp of the newest keyframe; 0 without one."""
    views = [] if mapper is None else mapper.views
    return max((view.stamp_ns for view in views), default=0)
