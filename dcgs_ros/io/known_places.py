# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The places of a map file: features of its keyframes' images, by which they are known again."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ..core.backend.features import Features, extract
from ..core.backend.places import Places
from ..core.camera import PinholeCamera
from ..core.config.stages import Config
from ..core.frame import RgbdFrame
from ..core.keyframe import Keyframe, Odometry
from ..core.sensor import SensorNoise
from .saved_tracker import SavedTracker

VIEW_DEPTH_UNIT_M = 5e-4  # of the 16 bits in which the mapper keeps depth


@dataclass(frozen=True)
class KnownView:
    """A keyframe as a map file has it; its images, undistorted, are empty if they were dropped."""

    keyframe: int  # the tracker's number
    color_jpeg: bytes
    depth_png: bytes
    features: Features | None = None  # None: of an older file


def features_of(
    views: Iterable[KnownView], camera: PinholeCamera, sensor: SensorNoise
) -> list[tuple[int, Features]]:
    """Return the features of each keyframe that are known, or that its images show.

    The images were made with a `camera`.
    """
    found = []
    for view in views:
        features = view.features or extracted(view.color_jpeg, view.depth_png, camera, sensor)
        if features is not None:
            found.append((view.keyframe, features))
    return found


def extracted(
    color_jpeg: bytes, depth_png: bytes, camera: PinholeCamera, sensor: SensorNoise
) -> Features | None:
    """Return the features of a view's images; None where they are no images of the `camera`."""
    frame = _decoded(color_jpeg, depth_png)
    if frame is None or frame.depth_m.shape != (camera.height, camera.width):
        return None
    return extract(frame, replace(camera, distortion=()), sensor)


def keyframes_of(views: Iterable[KnownView], tracker: SavedTracker) -> Iterator[Keyframe]:
    """Yield the keyframes that have images, as a back end takes them: without Gaussians."""
    none = np.empty((0, 3), np.float32)
    for view in views:
        k = view.keyframe
        frame, odometry = _decoded(view.color_jpeg, view.depth_png), tracker.odometry(k)
        if frame is None:
            continue
        if odometry is None:
            apart = np.empty((0, 4, 4))
            no_hosts = np.empty(0, np.int32)
            odometry = Odometry(k, 0, no_hosts, apart, np.empty((0, 6, 6)), np.zeros((6, 6)))
        T = tracker.poses[k]
        yield Keyframe(frame, T, np.eye(4), np.empty(0, np.int64), none, none, odometry)


def places_of(
    features: Sequence[tuple[int, Features]], camera: PinholeCamera, config: Config
) -> Places | None:
    """Return what recognises the places for another `camera`; None where there are none."""
    if not features:
        return None
    places = Places(camera, config)
    for keyframe, known in features:
        places.add(keyframe, known)
    return places


def _decoded(color_jpeg: bytes, depth_png: bytes) -> RgbdFrame | None:
    """Return the images as a frame without a stamp; None where they are no images."""
    buffers = [np.frombuffer(data, np.uint8) for data in (color_jpeg, depth_png)]
    if not all(map(len, buffers)):
        return None
    try:
        color = cv2.imdecode(buffers[0], cv2.IMREAD_COLOR)
        depth = cv2.imdecode(buffers[1], cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    if color is None or depth is None or depth.dtype != np.uint16 or depth.ndim != 2:
        return None
    if color.shape[:2] != depth.shape:
        return None
    depth_m = depth * np.float32(VIEW_DEPTH_UNIT_M)
    return RgbdFrame(0, 0, np.ascontiguousarray(color[..., ::-1]), depth_m)
