# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The topics of a recording's RGB-D camera, found by type and name or given by the user."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import parse_qsl

from ..source import SourceError
from .messages import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE
from .recording import topic_types

# The names of realsense2_camera.
COLOR_TOPIC = '/camera/camera/color/image_raw'
DEPTH_TOPIC = '/camera/camera/aligned_depth_to_color/image_raw'

GROUNDTRUTH_TOPIC = '/groundtruth'  # poses of the colour camera, as PoseStamped
STATIC_TOPIC = '/tf_static'

_DEPTH_TRANSPORT = '/compressedDepth'
_TRANSPORTS = (
    _DEPTH_TRANSPORT,
    '/compressed',
)  # suffixes of image_transport
_VIEWER_IMAGE = '/image/data'  # end of RealSense Viewer's names of image topics


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
    """Find the camera's topics: realsense2_camera's, or the only ones by type and name.

    `color` and `depth` are topics, or streams without their transport's suffix, to be used
    instead. Of one stream raw images are preferred to compressed ones. Raises `SourceError` with
    the topics of images if there is no candidate, or more than one.
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
    """Split the address of a recording into its path and the topics for colour and depth.

    These follow as `?color=TOPIC&depth=TOPIC`, both or one. Raises `SourceError` for other keys.
    """
    path, mark, query = address.partition('?')
    if not mark or Path(address).exists():
        return Path(address), None, None
    given = dict(parse_qsl(query, keep_blank_values=True))
    if unknown := given.keys() - {'color', 'depth'}:
        raise SourceError(
            f'{address}: {", ".join(sorted(unknown))} is not known; of a recording color=TOPIC '
            'and depth=TOPIC can be given, of any depth_per_metre, sync_slop_s and rate_hz'
        )
    return Path(path), given.get('color'), given.get('depth')


def stream_of(topic: str) -> str:
    """Return the name of an image topic without the suffix of its transport."""
    for suffix in _TRANSPORTS:
        topic = topic.removesuffix(suffix)
    return topic


def viewer_stream(topic: str) -> str | None:
    """Return a RealSense Viewer image topic's stream, /device_0/sensor_0/Depth_0; else None."""
    return topic.removesuffix(_VIEWER_IMAGE) if topic.endswith(_VIEWER_IMAGE) else None


def _streams(types: dict[str, str]) -> dict[str, str]:
    """Return the topic of each stream of images: the raw one if there is one."""
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
    """Return the default, the only candidate with one of the words, the only one, or None."""
    names = list(candidates)
    if default in names:
        return default
    named = [name for name in names if any(word in name.lower() for word in words)]
    for choice in (named, names):
        if len(choice) == 1:
            return choice[0]
    return None
