# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Frames of one camera from the messages of any, as their CameraInfo and frames say."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from ...core.camera import PinholeCamera
from ...core.config.presets import RegistrationChoice
from ...core.frame import RgbdFrame
from ...core.lens_camera import Camera
from ...datasets.images.camera_timeline import CameraTimeline, is_another
from ...datasets.images.registration import (
    Registration,
    Stream,
    find_registration,
)
from ...io.images.transports import read_color, read_depth
from ...io.ros_images import MessageError, is_rectified, read_camera, stamp_ns
from .pairing import ImagePair

SomeImage: TypeAlias = Image | CompressedImage

_KEPT = 64  # changes of the intrinsics: two seconds of a camera that focuses

Lookup = Callable[[str, str], 'NDArray[np.float64] | None']


class FrameReader:
    """Rectifies and registers images to one pinhole camera, which changes with the device only.

    `on_info` belongs to one thread, `read` to another.
    """

    def __init__(
        self,
        choice: RegistrationChoice,
        topics: Sequence[str],
        lookup: Lookup,
        tell: Callable[[str], None],
    ) -> None:
        """`topics` are colour's and depth's; `lookup` returns T_parent_child of TF, or None.

        `tell` gets what is decided of depth.
        """
        self._choice, self._topics, self._lookup, self._tell = choice, topics, lookup, tell
        self._cameras = {kind: CameraTimeline(_KEPT) for kind in ('color', 'depth')}
        self._repeated: dict[str, object] = {}
        self._lock = threading.Lock()
        self._registration: Registration | None = None
        self._camera: Camera | None = None  # of colour, when the registration was made
        self._made_for: object = None
        self._told = ''

    def on_info(self, kind: str, info: CameraInfo) -> None:
        """Take the intrinsics of 'color' or 'depth'; raises a `DcgsError` for unusable ones."""
        matrices = info.k.tobytes(), bytes(info.d), info.p.tobytes()
        fields = info.width, info.height, info.distortion_model, *matrices
        if self._repeated.get(kind) == fields:
            return
        topic = self._topics[0 if kind == 'color' else 1]
        camera = read_camera(info, is_rectified(topic))
        self._repeated[kind] = fields
        with self._lock:
            self._cameras[kind].add(stamp_ns(info.header.stamp), camera)

    def read(
        self, pair: ImagePair[SomeImage, SomeImage], depth_per_metre: float | None = None
    ) -> tuple[RgbdFrame, PinholeCamera]:
        """Return the frame of two messages, and its camera; raises a `DcgsError` without one.

        `depth_per_metre` is the value of a depth pixel at one metre; None: as in ROS.
        """
        color, depth = read_color(pair.color), read_depth(pair.depth, depth_per_metre)
        with self._lock:
            color_camera = self._cameras['color'].at(pair.color_ns)
            depth_camera = self._cameras['depth'].at(pair.depth_ns)
        if color_camera is None:
            raise MessageError('no usable camera_info has come yet')
        registration = self._registered(
            color_camera,
            Stream(self._topics[0], pair.color.header.frame_id, _size(color), color_camera),
            Stream(self._topics[1], pair.depth.header.frame_id, _size(depth), depth_camera),
        )
        images = registration(color, depth, color_camera, depth_camera)
        return RgbdFrame(pair.color_ns, pair.depth_ns, *images), registration.camera

    def _registered(self, camera: Camera, color: Stream, depth: Stream) -> Registration:
        """Return how depth comes onto colour; found again where something else comes."""
        last, key = self._registration, self._key(color, depth)
        another = self._camera is None or is_another(camera, self._camera)
        if last is not None and not another and key == self._made_for:
            return last
        found = find_registration(
            self._choice, color, camera, depth, lambda: self._lookup(color.frame, depth.frame)
        )
        if last is not None and not another:
            found = replace(found, camera=last.camera)  # the map is of that camera
        else:
            self._camera = camera
        self._registration, self._made_for = found, key
        if found.reason != self._told:
            self._told = found.reason
            self._tell(f'registration of depth: {found.reason}')
        return found

    @property
    def has_camera(self) -> bool:
        """Whether usable intrinsics of colour have come."""
        return bool(self._repeated.get('color'))

    @staticmethod
    def _key(*streams: Stream) -> object:
        return [(s.frame, s.size, s.camera is None) for s in streams]


def _size(image: NDArray[np.generic]) -> tuple[int, int]:
    return image.shape[1], image.shape[0]
