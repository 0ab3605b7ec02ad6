# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Streams of images, told apart by the words in their names, as camera drivers choose them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

from ...io.images.transports import COLOR_TRANSPORTS, DEPTH_TRANSPORTS

_SUFFIXES = sorted({*COLOR_TRANSPORTS.values(), *DEPTH_TRANSPORTS.values()} - {''})
_WORD = re.compile(r'colou?r_?map|depth|colou?r|rgb(?!d)|image|[a-z]+|\d+')
# depth_to_rgb, aligned_depth_to_color, rgb_to_depth: what it is, and whose pixels it has
_REGISTERED_TO = re.compile(
    r'(?:_to_|(?<=depth)2|(?<=rgb)2|(?<=color)2)(depth|colou?r|rgb|ir|infra|left)(?![a-z])\d?'
)

_COLOR = {'color', 'colour', 'rgb'}
_GREY = {'mono', 'gray', 'grey', 'ir', 'infra', 'infrared', 'fisheye', 'thermal'}
_REGISTERED = {'aligned', 'registered'}
_ODD = {  # made of images, and no image of a camera
    'colormap', 'color_map', 'colourmap', 'confidence', 'debug', 'detections', 'disparity',
    'keyframe', 'label', 'labels', 'mask', 'normals', 'overlay', 'render', 'segmentation',
    'semantic',
}  # fmt: skip
_RESOLUTIONS = ('qhd', 'hd', 'sd')  # kinect2_bridge's, the one to track first
_OF_NO_CAMERA = {
    *_COLOR, *_GREY, *_REGISTERED, 'depth', 'hw', 'sw', 'image', 'img', 'map', 'raw', 'rect',
    'rectified', 'compressed', 'zstd', 'data',
}  # fmt: skip


@dataclass(frozen=True)
class Stream:
    """A stream of images, or their CameraInfo: a name without the suffix of a transport."""

    name: str
    topic: str = ''  # of the transport to read
    is_compressed: bool = False
    is_depth: bool = False  # as its messages say, where the name does not

    @cached_property
    def words(self) -> frozenset[str]:
        """The words of the name, numbers apart, without the camera it is registered to."""
        spaced = re.sub(r'(?<=[a-z])(?=[A-Z])', '_', self.name).lower()
        return frozenset(_WORD.findall(_REGISTERED_TO.sub('', spaced)))

    @cached_property
    def registered_to(self) -> str:
        """Whose pixels it has, if the name says so: color, depth or another; else empty."""
        found = _REGISTERED_TO.search(self.name.lower())
        target = '' if found is None else found[1]
        return 'color' if target in _COLOR else target

    @cached_property
    def kind(self) -> str:
        """Return depth, color or grey; empty where neither name nor messages tell."""
        if self.is_depth or 'depth' in self.words:
            return 'depth'
        if self.words & _GREY:
            return 'grey'
        return 'color' if self.words & _COLOR else ''

    @cached_property
    def camera(self) -> frozenset[str]:
        """The words that name the camera."""
        shared = {'stereo'} if self.kind == 'depth' else set()
        return self.words - _OF_NO_CAMERA - shared

    @property
    def is_registered(self) -> bool:
        """Return whether the name says that depth is registered to colour."""
        return self.registered_to == 'color' or bool(self.words & _REGISTERED)

    @property
    def is_odd(self) -> bool:
        """Return whether it is no image of a camera, as far as the name says."""
        one_eye = self.kind == 'depth' or 'left' in self.words or 'right' in self.words
        return bool(self.words & _ODD) or ('stereo' in self.words and not one_eye)

    def describes(self, images: Stream) -> bool:
        """Return whether this, a CameraInfo's, has the words of a stream of images."""
        same = self.kind == images.kind and self.is_registered == images.is_registered
        return self.camera == images.camera and (same or not self.kind)


def stream_of(topic: str) -> str:
    """Return the name of an image topic without the suffix of its transport."""
    return next((topic.removesuffix(s) for s in _SUFFIXES if topic.endswith(s)), topic)


def best_pairs(colors: Iterable[Stream], depths: Iterable[Stream]) -> list[tuple[Stream, Stream]]:
    """Return the best pair of colour and depth of each camera that may be meant.

    Pairs of one camera share most words; of these depth that is registered to colour comes first.
    """
    pairs = [(color, depth) for color in colors for depth in depths if color != depth]
    nearest = min(map(_strangeness, pairs), default=None)
    best: dict[frozenset[str], tuple[Stream, Stream]] = {}
    for pair in sorted(pairs, key=_preference):
        if _strangeness(pair) == nearest:
            camera = (pair[0].camera & pair[1].camera) - {*_RESOLUTIONS}
            best.setdefault(camera, pair)
    return list(best.values())


def _strangeness(pair: tuple[Stream, Stream]) -> tuple[float, ...]:
    """Return how little two streams belong together: equal for two cameras as good."""
    color, depth = pair
    apart = color.camera ^ depth.camera
    target = depth.registered_to.rstrip('0123456789')
    to_another = target not in ('', 'color', *color.words) or (
        color.registered_to == 'depth' and depth.registered_to != ''
    )
    return (
        color.is_odd + depth.is_odd,
        to_another,
        color.kind == 'grey',
        len(apart),
    )


def _preference(pair: tuple[Stream, Stream]) -> tuple[object, ...]:
    """Return what sorts the pairs of one camera, the best one first."""
    color, depth = pair
    resolution = next((k for k, word in enumerate(_RESOLUTIONS) if word in color.words), 0)
    return (
        color.kind != 'color',
        0 if depth.is_registered else 1 if color.registered_to == 'depth' else 2,
        color.is_compressed + depth.is_compressed,
        _form(color, depth),
        resolution,
        len(color.name) + len(depth.name),
        color.name,
        depth.name,
    )


def _form(color: Stream, depth: Stream) -> int:
    """Return 0 where both are rectified or both raw, most where one is each."""
    forms = [stream.words & {'rect', 'raw'} for stream in (color, depth)]
    if all(forms):
        return 3 * forms[0].isdisjoint(forms[1])
    return 1 if 'rect' in forms[0] else 2
