# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The contents of a recording, from one pass over it: pairs of images, ground truth, losses."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core.trajectory import Trajectory
from ...io.ros_images import MessageError, is_rectified
from ..images.association import pair_stamps
from ..images.camera_timeline import CameraTimeline
from ..images.indexed_frames import stamp_of_index
from ..images.stamps import OrderedStamps, order_stamps
from ..options import AS_STORED, SourceOptions
from ..source import BadFrame, SourceError
from .camera_info import InfoReader
from .extrinsics import read_transform
from .messages import POSE, RawMessage, decode, read_header
from .recording import raw_messages
from .recovery.losses import DamagedError
from .topics import GROUNDTRUTH_TOPIC, CameraTopics


class RecordedImage(NamedTuple):
    """An image of a topic: the stamp in its header, and how many before it have the same."""

    header_ns: int
    earlier: int


class RecordedPair(NamedTuple):
    """Colour and depth of a frame: their stamps, as ordered, and which images these are."""

    color_ns: int
    depth_ns: int
    color: RecordedImage
    depth: RecordedImage


@dataclass(frozen=True)
class RecordingContents:
    """What a recording holds, without the images themselves."""

    pairs: list[RecordedPair]  # by colour's stamp
    groundtruth: Trajectory | None
    lost: list[BadFrame]  # unreadable messages, and what else of a damaged recording is lost
    notes: tuple[str, ...]  # what was left out, or changed of the stamps
    cameras: dict[str, CameraTimeline]  # by topic of their CameraInfo


def read_contents(
    path: Path | str, topics: CameraTopics, options: SourceOptions = AS_STORED
) -> RecordingContents:
    """Read the headers of the images, their CameraInfo, and the ground truth's poses.

    Raises `SourceError` if no colour and depth image are a pair, or stamps are missing.
    """
    stamps: dict[str, list[int]] = {topics.color: [], topics.depth: []}
    images = {topics.camera_info: topics.color, topics.depth_info: topics.depth}
    infos = {topic: InfoReader(is_rectified(name)) for topic, name in images.items() if topic}
    poses: dict[int, NDArray[np.float64]] = {}
    lost = []
    number = 0
    try:
        for number, message in enumerate(
            raw_messages(path, (*stamps, *infos, GROUNDTRUTH_TOPIC), heads=True), 1
        ):
            try:
                if message.topic in stamps:
                    stamps[message.topic].append(read_header(message.cdr)[0])
                elif message.topic in infos:
                    infos[message.topic].read(message)
                elif message.type == POSE:
                    poses.setdefault(*_read_pose(message))
            except MessageError as error:
                lost.append(BadFrame(f'message {number} ({message.topic})', str(error)))
    except DamagedError as error:
        lost.append(BadFrame('end of the recording', str(error)))
    color, depth = topics.color, topics.depth
    try:
        pairs, notes = _paired(str(path), color, stamps[color], depth, stamps[depth], options)
    except SourceError as error:
        damage = f'; {lost[-1].name}: {lost[-1].reason}' if lost else ''
        raise SourceError(f'{error}{damage}') from None
    cameras = {topic: reader.timeline for topic, reader in infos.items()}
    return RecordingContents(pairs, _trajectory(poses), lost, notes, cameras)


def _read_pose(message: RawMessage) -> tuple[int, NDArray[np.float64]]:
    pose = decode(message.cdr, message.type).pose
    return read_header(message.cdr)[0], read_transform(pose.position, pose.orientation)


def _trajectory(poses: dict[int, NDArray[np.float64]]) -> Trajectory | None:
    if not poses:
        return None
    stamps = sorted(poses)
    return Trajectory(np.array(stamps, np.int64), np.stack([poses[stamp] for stamp in stamps]))


def _paired(
    path: str,
    color_topic: str,
    color_ns: list[int],
    depth_topic: str,
    depth_ns: list[int],
    options: SourceOptions,
) -> tuple[list[RecordedPair], tuple[str, ...]]:
    """Pair the images by their stamps, or in their order at a rate; a repeated one counts once."""
    colors, depths = _identified(color_ns), _identified(depth_ns)
    notes: tuple[str, ...] = ()
    if options.rate_hz is not None:
        if len(colors) != len(depths):
            note = f'{path}: {len(colors)} colour and {len(depths)} depth images, paired by order'
            notes = (note,)
        stamps = (stamp_of_index(k, options.rate_hz) for k in range(len(colors)))
        frames = zip(stamps, colors, depths, strict=False)
        return [RecordedPair(stamp, stamp, *images) for stamp, *images in frames], notes
    first = _ordered(f'{path}: {color_topic}', color_ns)
    second = _ordered(f'{path}: {depth_topic}', depth_ns, first.shifts_ns)
    matched, unpaired = pair_stamps(first.stamps_ns, second.stamps_ns, options.sync_slop_s, path)
    pairs = [
        RecordedPair(
            int(first.stamps_ns[i]),
            int(second.stamps_ns[j]),
            colors[first.images[i]],
            depths[second.images[j]],
        )
        for i, j in matched
    ]
    return pairs, (*first.notes, *second.notes, *unpaired)


def _identified(stamps_ns: list[int]) -> list[RecordedImage]:
    seen: Counter[int] = Counter()
    images = []
    for stamp_ns in stamps_ns:
        images.append(RecordedImage(stamp_ns, seen[stamp_ns]))
        seen[stamp_ns] += 1
    return images


def _ordered(name: str, stamps_ns: list[int], shifts_ns: tuple[int, ...] = ()) -> OrderedStamps:
    array = np.array(stamps_ns, np.int64)
    return order_stamps(array, name, lambda k: f'message {k + 1}', shifts_ns)
