# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""CameraInfo of a recording: the first usable one, and how it changes."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from ...core.camera import CameraError
from ...core.errors import DcgsError
from ...core.lens_camera import Camera
from ...io.ros_images import MessageError, is_rectified, read_camera
from ..images.camera_timeline import CameraTimeline
from .messages import RawMessage, decode, read_header
from .recording import raw_messages
from .recovery.losses import DamagedError

_AFTER_STAMP = 12  # byte of a message that begins with a header


def first_camera(
    path: Path | str, topic: str | None, images: str
) -> tuple[Camera | None, DcgsError | None]:
    """Return an image topic's camera by the first usable CameraInfo, or None and what was wrong.

    Drivers send intrinsics of zero until they have read the calibration.
    """
    first_error: DcgsError | None = None
    with suppress(DamagedError):  # reported with the frames
        for message in raw_messages(path, [topic] if topic else []):
            try:
                info = decode(message.cdr, message.type)
                return read_camera(info, is_rectified(images)), None
            except (MessageError, CameraError) as error:
                first_error = first_error or error
    return None, first_error


class InfoReader:
    """Reads the CameraInfo of a topic, each of which mostly repeats the last one."""

    def __init__(self, rectified: bool) -> None:
        """Begin; `rectified` images have a camera of their own."""
        self.timeline, self._rectified = CameraTimeline(), rectified
        self._last = b''

    def read(self, message: RawMessage) -> None:
        """Add a message; one without usable intrinsics changes nothing."""
        if message.cdr[_AFTER_STAMP:] == self._last:
            return
        self._last = message.cdr[_AFTER_STAMP:]
        with suppress(MessageError, CameraError):
            camera = read_camera(decode(message.cdr, message.type), self._rectified)
            self.timeline.add(read_header(message.cdr)[0], camera)
