# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The contents of a recording, from one pass over it: pairs of images, ground truth, losses."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.camera import CameraError
from ...core.trajectory import Trajectory
from ...io.ros_images import MessageError, read_camera
from ...io.trajectory import format_stamp_ns
from ..images.association import MAX_PAIR_GAP_NS, associate_stamps
from ..images.camera_timeline import CameraTimeline
from ..source import BadFrame, SourceError
from .extrinsics import read_transform
from .messages import POSE, RawMessage, decode, read_header
from .recording import raw_messages
from .recovery.losses import DamagedError
from .topics import GROUNDTRUTH_TOPIC, CameraTopics

_AFTER_STAMP = 12  # byte of a message that begins with a header
_MAX_STEP_BACK_NS = 1_000_000_000  # of stamps; a larger step means another recording


@dataclass(frozen=True)
class RecordingContents:
    """What a recording holds, without the images themselves."""

    pairs: list[tuple[int, int]]  # stamps of colour and depth, by colour
    groundtruth: Trajectory | None
    lost: list[BadFrame]  # unreadable messages, and what else of a damaged recording is lost
    cameras: dict[str, CameraTimeline]  # by topic of their CameraInfo


def read_contents(path: Path | str, topics: CameraTopics) -> RecordingContents:
    """Read the headers of the images, their CameraInfo, and the ground truth's poses.

    Raises `SourceError` if no colour and depth image are a pair, or stamps step back by more than
    a second.
    """
    stamps: dict[str, list[int]] = {topics.color: [], topics.depth: []}
    infos = {topic: _InfoReader() for topic in (topics.camera_info, topics.depth_info) if topic}
    poses: dict[int, NDArray[np.float64]] = {}
    lost = []
    number = 0
    try:
        for number, message in enumerate(
            raw_messages(path, (*stamps, *infos, GROUNDTRUTH_TOPIC), heads=True), 1
        ):
            try:
                if message.topic in stamps:
                    _add_stamp(stamps[message.topic], read_header(message.cdr)[0])
                elif message.topic in infos:
                    infos[message.topic].read(message)
                elif message.type == POSE:
                    poses.setdefault(*_read_pose(message))
            except MessageError as error:
                lost.append(BadFrame(f'message {number} ({message.topic})', str(error)))
            except SourceError as error:
                where = f'{message.topic}, message {len(stamps[message.topic]) + 1}'
                raise SourceError(f'{path}: {where}: {error}') from error
    except DamagedError as error:
        lost.append(BadFrame('end of the recording', str(error)))
    pairs = _paired(path, stamps[topics.color], stamps[topics.depth], lost)
    cameras = {topic: reader.timeline for topic, reader in infos.items()}
    return RecordingContents(pairs, _trajectory(poses), lost, cameras)


class _InfoReader:
    """Reads the CameraInfo of a topic, each of which mostly repeats the last one."""

    def __init__(self) -> None:
        """Begin."""
        self.timeline = CameraTimeline()
        self._last = b''

    def read(self, message: RawMessage) -> None:
        """Add a message; one without usable intrinsics changes nothing."""
        if message.cdr[_AFTER_STAMP:] == self._last:
            return
        self._last = message.cdr[_AFTER_STAMP:]
        with suppress(MessageError, CameraError):
            camera = read_camera(decode(message.cdr, message.type))
            self.timeline.add(read_header(message.cdr)[0], camera)


def _add_stamp(stamps: list[int], stamp_ns: int) -> None:
    if stamps and stamp_ns < stamps[-1] - _MAX_STEP_BACK_NS:
        raise SourceError(
            f'its stamp {format_stamp_ns(stamp_ns)} is before {format_stamp_ns(stamps[-1])}: '
            'these are several recordings in one'
        )
    stamps.append(stamp_ns)


def _read_pose(message: RawMessage) -> tuple[int, NDArray[np.float64]]:
    pose = decode(message.cdr, message.type).pose
    return read_header(message.cdr)[0], read_transform(pose.position, pose.orientation)


def _trajectory(poses: dict[int, NDArray[np.float64]]) -> Trajectory | None:
    if not poses:
        return None
    stamps = sorted(poses)
    return Trajectory(np.array(stamps, np.int64), np.stack([poses[stamp] for stamp in stamps]))


def _paired(
    path: Path | str, color_ns: list[int], depth_ns: list[int], lost: list[BadFrame]
) -> list[tuple[int, int]]:
    """Pair the stamps; a repeated one counts once."""
    color, depth = (np.unique(np.array(values, np.int64)) for values in (color_ns, depth_ns))
    pairs = associate_stamps(color, depth, MAX_PAIR_GAP_NS)
    if not pairs:
        spans = [_span(stamps) for stamps in (color, depth)]
        damage = f'; {lost[-1].name}: {lost[-1].reason}' if lost else ''
        raise SourceError(
            f'{path}: none of {len(color)} colour images has a depth image within '
            f'{MAX_PAIR_GAP_NS / 1e6:.0f} ms: colour {spans[0]}, depth {spans[1]}{damage}'
        )
    return [(int(color[i]), int(depth[j])) for i, j in pairs]


def _span(stamps: NDArray[np.int64]) -> str:
    if not len(stamps):
        return 'none'
    return f'{format_stamp_ns(stamps[0])} to {format_stamp_ns(stamps[-1])} s'
