# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A camera whose intrinsics change while it records, as a phone's do."""

from __future__ import annotations

from bisect import bisect_right

from ...core.errors import FrameError
from ...core.lens_camera import Camera
from .resampling import moved_px

_REWOUND_NS = 1_000_000_000  # a stamp farther back is of another clock, not disorder
_ANOTHER = 0.1  # share of the image's width by which the pixels of another camera are moved


class CameraTimeline:
    """The cameras of an image stream by stamp, one for each change."""

    def __init__(self, kept: int | None = None) -> None:
        """Keep the last `kept` changes of a live camera, whose clock may be set back, or all."""
        self._kept = kept
        self._stamps_ns: list[int] = []
        self._cameras: list[Camera] = []

    def add(self, stamp_ns: int, camera: Camera) -> None:
        """Add what holds from a stamp on; stamps are nearly in order."""
        live = self._kept is not None and self._stamps_ns
        if live and stamp_ns < self._stamps_ns[-1] - _REWOUND_NS:
            self._stamps_ns, self._cameras = [], []
        at = bisect_right(self._stamps_ns, stamp_ns)
        if at and self._cameras[at - 1] == camera:
            return
        self._stamps_ns.insert(at, stamp_ns)
        self._cameras.insert(at, camera)
        if self._kept is not None and len(self._cameras) > self._kept:
            del self._stamps_ns[0], self._cameras[0]

    def at(self, stamp_ns: int) -> Camera | None:
        """Return what holds at a stamp: the last one before, else the first; None without any."""
        if not self._cameras:
            return None
        return self._cameras[max(bisect_right(self._stamps_ns, stamp_ns) - 1, 0)]


def is_another(now: Camera, before: Camera) -> bool:
    """Return whether these cannot be intrinsics of one camera: of another size, or far apart."""
    if (now.width, now.height) != (before.width, before.height):
        return True
    return now != before and moved_px(now, before) > _ANOTHER * before.width


def check_same(now: Camera, before: Camera) -> None:
    """Raise `FrameError` where an image is of another camera than the ones before."""
    if is_another(now, before):
        raise FrameError(
            f'it is of another camera: {now.width}x{now.height}, fx {now.fx:.1f}, not '
            f'{before.width}x{before.height}, fx {before.fx:.1f}'
        )
