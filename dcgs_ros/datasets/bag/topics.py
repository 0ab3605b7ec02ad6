# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The topics of a recording's RGB-D camera, found by type and name or given by the user."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import parse_qsl

from ...io.images.transports import COLOR_TRANSPORTS, DEPTH_TRANSPORTS, encoding_of
from ...io.ros_images import DEPTH_ENCODINGS
from ..source import SourceError
from .messages import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE
from .recording import first_messages, topic_types
from .streams import Stream, best_pairs, stream_of

# The names of realsense2_camera.
COLOR_TOPIC = '/camera/camera/color/image_raw'
DEPTH_TOPIC = '/camera/camera/aligned_depth_to_color/image_raw'

GROUNDTRUTH_TOPIC = '/groundtruth'  # poses of the colour camera, as PoseStamped
ODOMETRY_TOPIC = '/odom'  # of what is written; read is any Odometry
STATIC_TOPIC = '/tf_static'

_NO_COLOR = {*DEPTH_ENCODINGS} - {'mono16'}  # which is either
_INFO = re.compile(r'_?(camera_?)?info$')
_VIDEO = re.compile('theora|ffmpeg', re.IGNORECASE)
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
    """Find the camera's topics: realsense2_camera's, else the pair that fits best by its names.

    `color` and `depth` are topics, or streams without their transport's suffix, to be used
    instead; where one is given, the other is of the same camera. Of one stream raw images are
    preferred to compressed ones. Raises `SourceError` with the topics of images if there is no
    pair, or if there are several cameras.
    """
    types = topic_types(path)
    streams = _streams(types)
    if color is None and depth is None:
        colors, depths = ([s for s in streams if s.name == n] for n in (COLOR_TOPIC, DEPTH_TOPIC))
    else:
        colors = _given(path, 'color', color, streams, types)
        depths = _given(path, 'depth', depth, streams, types)
    if not (colors and depths):
        streams = [s if s.kind else _by_content(path, s, types) for s in streams]
        colors = colors or [s for s in streams if s.kind != 'depth']
        depths = depths or [s for s in streams if s.kind == 'depth']
    pairs = best_pairs(colors, depths)
    if len(pairs) != 1:
        key = 'depth' if colors and (color is not None or not pairs) else 'color'
        raise _no_topic(path, key, 'not one topic', types)
    info = (_info_of(stream, types) for stream in pairs[0])
    return CameraTopics(*(stream.topic for stream in pairs[0]), *info)


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


def viewer_stream(topic: str) -> str | None:
    """Return a RealSense Viewer image topic's stream, /device_0/sensor_0/Depth_0; else None."""
    return topic.removesuffix(_VIEWER_IMAGE) if topic.endswith(_VIEWER_IMAGE) else None


def _streams(types: dict[str, str]) -> list[Stream]:
    """Return the streams of images, each with the topic of its best transport."""
    topics = [topic for topic, type_ in types.items() if type_ in (IMAGE, COMPRESSED_IMAGE)]
    names = dict.fromkeys(map(stream_of, topics))
    streams = (_with_topic(Stream(name), types) for name in names)
    return [stream for stream in streams if stream.topic]


def _with_topic(stream: Stream, types: dict[str, str]) -> Stream:
    """Return the stream with the topic of its best transport, empty if it has none to read."""
    transports = COLOR_TRANSPORTS if stream.kind in ('color', 'grey') else DEPTH_TRANSPORTS
    for suffix in transports.values():
        topic = f'{stream.name}{suffix}'
        if (type_ := types.get(topic)) in (IMAGE, COMPRESSED_IMAGE):
            return replace(stream, topic=topic, is_compressed=type_ != IMAGE)
    return stream


def _by_content(path: Path | str, stream: Stream, types: dict[str, str]) -> Stream:
    """Return the stream as depth if its first message is, whatever its name says."""
    message = first_messages(path, [stream.topic]).get(stream.topic)
    is_depth = message is not None and encoding_of(message) in _NO_COLOR
    return _with_topic(replace(stream, is_depth=is_depth), types)


def _given(
    path: Path | str, key: str, name: str | None, streams: list[Stream], types: dict[str, str]
) -> list[Stream]:
    """Return the stream, or the one transport of it, that the user names; none if that is None."""
    if name is None:
        return []
    if types.get(name) in (IMAGE, COMPRESSED_IMAGE):
        return [Stream(stream_of(name), name, types[name] != IMAGE, key == 'depth')]
    for stream in streams:
        if stream.name == name:
            return [replace(stream, is_depth=key == 'depth')]
    raise _no_topic(path, key, f'{name} is not there, so no topic', types)


def _no_topic(path: Path | str, key: str, which: str, types: dict[str, str]) -> SourceError:
    """Return the error that lists the topics of images, and those of video, which is not read."""
    have = [
        f'{topic} ({type_}{"" if type_ in (IMAGE, COMPRESSED_IMAGE) else ": not read"})'
        for topic, type_ in sorted(types.items())
        if type_ in (IMAGE, COMPRESSED_IMAGE) or _VIDEO.search(type_)
    ]
    what = 'depth' if key == 'depth' else 'colour'
    return SourceError(
        f'{path}: {which} is the {what} image among {", ".join(have) or "none"}; '
        f'name it: {path}?{key}=TOPIC'
    )


def _info_of(stream: Stream, types: dict[str, str]) -> str | None:
    """Return the topic of the CameraInfo beside a stream, else of the one of that name."""
    viewer = viewer_stream(stream.topic)
    names = [f'{viewer}/info'] if viewer else [stream.name, stream.name.rsplit('/', 1)[0]]
    for name in names:
        if types.get(f'{name}/camera_info') == CAMERA_INFO:
            return f'{name}/camera_info'
    infos = [Stream(_INFO.sub('', t), t) for t, type_ in types.items() if type_ == CAMERA_INFO]
    alike = [info for info in infos if info.describes(stream)]
    alike = [info for info in alike if info.kind] or alike
    return alike[0].topic if len(alike) == 1 else None
