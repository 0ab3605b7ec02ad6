# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Which topics of a recording are an RGB-D camera's: by type and name, or as they are given."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import parse_qsl

from ..source import SourceError
from .messages import CAMERA_INFO, IMAGE, topic_types

COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'

# What realsense2_camera calls its topics.
COLOR_TOPIC = '/camera/camera/color/image_raw'
DEPTH_TOPIC = '/camera/camera/aligned_depth_to_color/image_raw'

_DEPTH_TRANSPORT = '/compressedDepth'
_TRANSPORTS = (_DEPTH_TRANSPORT, '/compressed')  # what image_transport adds to a stream's name
_VIEWER_IMAGE = '/image/data'  # how RealSense Viewer's names of images end


@dataclass(frozen=True)
class CameraTopics:
    """Topics of one RGB-D camera."""

    color: str
    depth: str
    camera_info: str | None  # beside colour
    depth_info: str | None  # beside depth


def camera_topics(
    path: Path | str, color: str | None = None, depth: str | None = None
) -> CameraTopics:
    """Find the camera: realsense2_camera's names, else what type and name leave but one choice.

    `color` and `depth` are topics, or streams without their transport's suffix, to be taken
    instead. Of one stream raw images are preferred to compressed ones. Raises `SourceError` that
    lists the topics of images where there is no choice, or more than one.
    """
    types = topic_types(path)
    images = [topic for topic, type_ in types.items() if type_ in (IMAGE, COMPRESSED_IMAGE)]
    streams = _streams(types)
    depths = [name for name in streams if 'depth' in name.lower()]
    colors = [name for name in streams if name not in depths]
    if color is None:
        color = _only(colors, COLOR_TOPIC, ('color', 'rgb'))
    if depth is None:
        depth = _only(depths, DEPTH_TOPIC, ('aligned', 'registered'))
    topics = []
    for what, key, name in (('colour', 'color', color), ('depth', 'depth', depth)):
        topic = name if name in images else streams.get(name or '')
        if topic is None:
            have = ', '.join(f'{topic} ({types[topic]})' for topic in sorted(images))
            which = 'not one topic' if name is None else f'{name} is not there, so no topic'
            raise SourceError(
                f'{path}: {which} is the {what} image among {have or "none"}; '
                f'name it: {path}?{key}=TOPIC'
            )
        topics.append(topic)
    return CameraTopics(topics[0], topics[1], *(_info_beside(topic, types) for topic in topics))


def split_topics(address: str) -> tuple[Path, str | None, str | None]:
    """Take `?color=TOPIC&depth=TOPIC`, each or both, off the address of a recording.

    Returns its path and the topics; raises `SourceError` for other keys.
    """
    path, mark, query = address.partition('?')
    if not mark or Path(address).exists():
        return Path(address), None, None
    given = dict(parse_qsl(query, keep_blank_values=True))
    if unknown := given.keys() - {'color', 'depth'}:
        raise SourceError(
            f'{address}: {", ".join(sorted(unknown))} is not known; of a recording color=TOPIC '
            'and depth=TOPIC can be given'
        )
    return Path(path), given.get('color'), given.get('depth')


def stream_of(topic: str) -> str:
    """Name of a topic of images without what tells its compression."""
    for suffix in _TRANSPORTS:
        topic = topic.removesuffix(suffix)
    return topic


def viewer_stream(topic: str) -> str | None:
    """/device_0/sensor_0/Depth_0 of RealSense Viewer's image topics; None of any other topic."""
    return topic.removesuffix(_VIEWER_IMAGE) if topic.endswith(_VIEWER_IMAGE) else None


def _streams(types: dict[str, str]) -> dict[str, str]:
    """Topic that carries each stream of images, as it is rather than compressed."""
    raw = [topic for topic, type_ in types.items() if type_ == IMAGE]
    compressed = [topic for topic, type_ in types.items() if type_ == COMPRESSED_IMAGE]
    lossless = [topic for topic in compressed if topic.endswith(_DEPTH_TRANSPORT)]
    streams: dict[str, str] = {}
    for topic in (*raw, *lossless, *compressed):
        stream = stream_of(topic)
        if topic not in lossless or 'depth' in stream.lower():
            streams.setdefault(stream, topic)
    return streams


def _info_beside(topic: str, types: dict[str, str]) -> str | None:
    viewer = viewer_stream(topic)
    beside = stream_of(topic).rsplit('/', 1)[0] if viewer is None else f'{viewer}/info'
    info = f'{beside}/camera_info'
    return info if types.get(info) == CAMERA_INFO else None


def _only(candidates: Iterable[str], default: str, words: tuple[str, ...]) -> str | None:
    """Choose the default, the only one with one of the words in its name, or the only one."""
    names = list(candidates)
    if default in names:
        return default
    named = [name for name in names if any(word in name.lower() for word in words)]
    for choice in (named, names):
        if len(choice) == 1:
            return choice[0]
    return None
