# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Faults of a camera and of its surroundings, put into a sequence: pure, and seeded.

A fault begins 40 % into the sequence and lasts a given time; the frames before and after it are
the sequence's own. What the pipeline would refuse to read is a `BadFrame`, as a source yields it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.errors import FrameError
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.sensor import SensorNoise
from dcgs_ros.datasets.source import BadFrame

from . import image_faults
from .covisibility import share_seen
from .image_faults import Change, Images, Window

_BEGIN = 0.4  # of the sequence
_MOTION_UNTIL = 0.7  # of the sequence: where a gap in motion begins at the latest
_RAD_PER_M = 1.0  # how much turning counts as much as a metre
_HOUR_NS = 3600 * 10**9
_SEEN, _SEEN_EVERY = 0.6, 6  # share of a view, that one of every so many frames has seen
_FAR_M = 100.0  # from the sequence to a place that it does not show


@dataclass(frozen=True)
class Shot:
    """What the pipeline is given, and what is true of it."""

    item: RgbdFrame | BadFrame
    time_s: float  # true time at which it was taken, whatever its stamps say
    T_world_cam: NDArray[np.float64]  # (4, 4) true pose at that time
    source: int | None  # the sequence's frame with that pose; None: a place that it does not show


@dataclass(frozen=True)
class Clip:
    """A sequence without fault, and some frames of another place."""

    shots: tuple[Shot, ...]
    camera: PinholeCamera
    sensor: SensorNoise
    elsewhere: tuple[Shot, ...]

    def frame(self, index: int) -> RgbdFrame:
        """Return a frame of the sequence."""
        item = self.shots[index].item
        assert isinstance(item, RgbdFrame)
        return item

    @property
    def times_s(self) -> NDArray[np.float64]:
        """(N,) of the shots."""
        return np.array([shot.time_s for shot in self.shots])

    def seen_before(self, shots: Sequence[Shot], begin: int) -> NDArray[np.bool_]:
        """Return (N,) whether the places of shots were seen before the frame `begin`."""
        frames = range(0, begin, _SEEN_EVERY)
        earlier = [(self.frame(k), self.shots[k].T_world_cam) for k in frames]
        return np.array(
            [
                shot.source is not None
                and share_seen(
                    (self.frame(shot.source), shot.T_world_cam), earlier, self.camera
                ) >= _SEEN
                for shot in shots
            ]
        )  # fmt: skip

    def begin(self) -> int:
        """Return where faults begin."""
        return round(_BEGIN * len(self.shots))

    def after(self, index: int, seconds: float) -> int:
        """Return the first frame that is `seconds` later than another; the last one at most."""
        times = self.times_s
        return min(int(np.searchsorted(times, times[index] + seconds - 1e-3)), len(times) - 1)


@dataclass(frozen=True)
class Faulted:
    """A sequence with a fault, in the order in which its frames arrive."""

    shots: list[Shot]
    begin: int  # the first one that the fault affects
    end: int  # the first one after it


Transform = Callable[[Clip, float, int], Faulted]  # of so many seconds, with a seed


@dataclass(frozen=True)
class Fault:
    """A kind of fault."""

    name: str
    what: str
    seconds: float  # how long it lasts; 0: an instant
    transform: Transform
    degenerate_detects: bool = True  # False: no direction of the pose is known

    def put_into(self, clip: Clip, seed: int) -> Faulted:
        """Return the sequence with the fault; the same seed gives the same bytes."""
        return self.transform(clip, self.seconds, seed)

    @property
    def detected_by(self) -> frozenset[str]:
        """States of a frame that tell of the fault."""
        states = {'refused', 'lost', 'relocalised'}
        return frozenset(states | {'degenerate'} if self.degenerate_detects else states)


def delayed(shots: Sequence[Shot], seconds: float) -> list[Shot]:
    """Return shots that were taken, and are stamped, `seconds` later."""
    shift_ns = round(seconds * 1e9)
    return [replace(stamped_later(shot, shift_ns), time_s=shot.time_s + seconds) for shot in shots]


def stamped_later(shot: Shot, shift_ns: int) -> Shot:
    """Return a shot with other stamps, taken when it was."""
    if isinstance(shot.item, BadFrame) or not shift_ns:
        return shot
    frame = shot.item
    stamps = (frame.stamp_ns + shift_ns, frame.depth_stamp_ns + shift_ns)
    return replace(shot, item=replace(frame, stamp_ns=stamps[0], depth_stamp_ns=stamps[1]))


def changed(change: Change) -> Transform:
    """Return the fault that changes the images and keeps the stamps."""

    def transform(clip: Clip, seconds: float, seed: int) -> Faulted:
        begin = clip.begin()
        end = clip.after(begin, seconds)
        window = _window(clip, begin, end)
        shots = list(clip.shots)
        for k in range(begin, end):
            rng = np.random.default_rng((seed, k))
            shots[k] = replace(shots[k], item=_with_images(clip.frame(k), change(window, k, rng)))
        return Faulted(shots, begin, end)

    return transform


def _window(clip: Clip, begin: int, end: int) -> Window:
    frames = [clip.frame(k) for k in range(len(clip.shots))]
    images = [Images(frame.color, frame.depth_m) for frame in frames]
    poses = [shot.T_world_cam for shot in clip.shots]
    return Window(images, poses, clip.times_s, clip.camera, clip.sensor, begin, end)


def _with_images(frame: RgbdFrame, images: Images) -> RgbdFrame | BadFrame:
    """Return a frame with other images, or what a source makes of one that it cannot read."""
    try:
        return replace(frame, color=images.color, depth_m=images.depth_m)
    except FrameError as error:
        return BadFrame(f'frame of {frame.stamp_ns}', str(error))


def cut_out(clip: Clip, begin: int, seconds: float) -> Faulted:
    """Leave frames out, so that none comes for `seconds`.

    Half of what is left of the sequence stays; where that is not long enough, it comes later.
    """
    end = min(clip.after(begin, seconds), (begin + len(clip.shots)) // 2)
    times = clip.times_s
    late_s = max(0.0, seconds - (times[end] - times[begin]))
    return Faulted([*clip.shots[:begin], *delayed(clip.shots[end:], late_s)], begin, begin)


def blackout(clip: Clip, seconds: float, seed: int) -> Faulted:
    """Leave out the frames of `seconds`."""
    return cut_out(clip, clip.begin(), seconds)


def gap_in_motion(clip: Clip, seconds: float, seed: int) -> Faulted:
    """Leave out the frames of `seconds` where the camera moves the most."""
    first, last = clip.begin(), round(_MOTION_UNTIL * len(clip.shots))
    moved = [
        _distance(clip.shots[k], clip.shots[clip.after(k, seconds)]) for k in range(first, last)
    ]
    return cut_out(clip, first + int(np.argmax(moved)), seconds)


def _distance(a: Shot, b: Shot) -> float:
    xi = se3.log(se3.inverse(a.T_world_cam) @ b.T_world_cam)
    return float(np.linalg.norm(xi[:3]) + np.linalg.norm(xi[3:]) / _RAD_PER_M)


def drop_most(kept: int) -> Transform:
    """Return the fault of which one frame in `kept` is left."""

    def transform(clip: Clip, seconds: float, seed: int) -> Faulted:
        begin = clip.begin()
        end = clip.after(begin, seconds)
        left = clip.shots[begin + kept - 1 : end : kept]
        shots = [*clip.shots[:begin], *left, *clip.shots[end:]]
        return Faulted(shots, begin, begin + len(left))

    return transform


def repeat_some(share: float) -> Transform:
    """Return the fault in which a share of the frames repeats the images of those before."""

    def transform(clip: Clip, seconds: float, seed: int) -> Faulted:
        begin = clip.begin()
        end = clip.after(begin, seconds)
        repeats = begin + np.flatnonzero(np.random.default_rng(seed).random(end - begin) < share)
        shots = list(clip.shots)
        for k in repeats.tolist():
            last = clip.frame(k - 1)
            images = Images(last.color, last.depth_m)
            shots[k] = replace(shots[k], item=_with_images(clip.frame(k), images))
        return Faulted(shots, begin, end)

    return transform


def kidnapped_to_seen(clip: Clip, seconds: float, seed: int) -> Faulted:
    """Cut to the earlier frame that is farthest away, and go on from there."""
    begin, shots = clip.begin(), clip.shots
    there = int(np.argmax([_distance(shots[begin], shot) for shot in shots[:begin]]))
    later_s = shots[begin].time_s - shots[there].time_s
    follow = delayed(shots[there : there + len(shots) - begin], later_s)
    return Faulted([*shots[:begin], *follow], begin, begin)


def kidnapped_and_back(clip: Clip, seconds: float, seed: int) -> Faulted:
    """Cut to another scene for a while, then go on where the camera was."""
    begin, shots = clip.begin(), clip.shots
    end_s = clip.elsewhere[0].time_s + seconds
    there = [shot for shot in clip.elsewhere if shot.time_s < end_s]
    move, start_ns = np.eye(4), clip.frame(begin).stamp_ns
    move[0, 3] = _FAR_M
    foreign = []
    for shot in there:
        later_s = shot.time_s - there[0].time_s
        assert isinstance(shot.item, RgbdFrame)
        shift_ns = start_ns + round(later_s * 1e9) - shot.item.stamp_ns
        time_s = shots[begin].time_s + later_s
        foreign.append(
            replace(
                stamped_later(shot, shift_ns), time_s=time_s,
                T_world_cam=move @ shot.T_world_cam, source=None,
            )
        )  # fmt: skip
    after = delayed(shots[begin:], seconds)
    return Faulted([*shots[:begin], *foreign, *after], begin, begin + len(foreign))


def one_stamp_ahead(clip: Clip, seconds: float, seed: int) -> Faulted:
    """Stamp one frame an hour ahead."""
    begin, shots = clip.begin(), list(clip.shots)
    shots[begin] = stamped_later(shots[begin], _HOUR_NS)
    return Faulted(shots, begin, begin + 1)


def clock_jumps(jump_ns: int) -> Transform:
    """Return the fault that stamps all further frames later, or earlier."""

    def transform(clip: Clip, seconds: float, seed: int) -> Faulted:
        begin, shots = clip.begin(), clip.shots
        after = [stamped_later(shot, jump_ns) for shot in shots[begin:]]
        return Faulted([*shots[:begin], *after], begin, begin)

    return transform


def stamps_reversed(clip: Clip, seconds: float, seed: int) -> Faulted:
    """Stamp the frames of a while in reverse order."""
    begin, shots = clip.begin(), list(clip.shots)
    end = clip.after(begin, seconds)
    for k in range(begin, end):
        other = clip.frame(begin + end - 1 - k)
        shots[k] = stamped_later(clip.shots[k], other.stamp_ns - clip.frame(k).stamp_ns)
    return Faulted(shots, begin, end)


FAULTS = (
    Fault('black-out 0.5 s', 'no frames', 0.5, blackout),
    Fault('black-out 2 s', 'no frames', 2.0, blackout),
    Fault('black-out 10 s', 'no frames', 10.0, blackout),
    Fault('gap in motion', 'no frames for 1 s where the camera moves most', 1.0, gap_in_motion),
    Fault('lens covered', 'black colour, depth of 5 % noise near the camera', 2.0,
          changed(image_faults.lens_covered), degenerate_detects=False),
    Fault('colour black', 'black colour, depth as usual', 2.0,
          changed(image_faults.color_black)),
    Fault('depth zero', 'colour as usual', 2.0, changed(image_faults.depth_zero)),
    Fault('depth almost zero', '50 pixels have depth', 2.0,
          changed(image_faults.depth_almost_zero)),
    Fault('depth x1.1', 'a wrong scale', 2.0, changed(image_faults.depth_scaled(1.1))),
    Fault('depth / 5', 'a wrong unit', 2.0, changed(image_faults.depth_scaled(0.2))),
    Fault('holes', 'half of the depth is missing, in patches', 2.0,
          changed(image_faults.holes)),
    Fault('depth not finite', 'a fifth of the depth is NaN, infinite or negative', 2.0,
          changed(image_faults.depth_not_finite)),
    Fault('salt and pepper', 'a fifth of the colours are black or white', 2.0,
          changed(image_faults.salt_and_pepper)),
    Fault('depth outliers', 'a fifth of the depths are arbitrary', 2.0,
          changed(image_faults.depth_outliers)),
    Fault('dead block', 'a third of the image has no depth', 2.0,
          changed(image_faults.dead_block)),
    Fault('stuck block', 'a third of the depth image does not change', 2.0,
          changed(image_faults.stuck_block)),
    Fault('frozen', 'the same images under new stamps', 2.0,
          changed(image_faults.frozen), degenerate_detects=False),
    Fault('repeated', '3 % of the frames repeat the images before, to the end', 1e3,
          repeat_some(0.03)),
    Fault('5 of 6 dropped', 'every sixth frame arrives', 2.0, drop_most(6)),
    Fault('blur', 'of 25 pixels', 2.0, changed(image_faults.blurred)),
    Fault('exposure x0.3', 'darker', 2.0, changed(image_faults.exposed(0.3))),
    Fault('exposure x3', 'brighter', 2.0, changed(image_faults.exposed(3.0))),
    Fault('bare wall', 'a wall without texture hides the scene', 2.0,
          changed(image_faults.wall(textured=False))),
    Fault('one plane', 'a wall with texture hides the scene', 2.0,
          changed(image_faults.wall(textured=True))),
    Fault('box, fixed', 'a near box over a third of the image moves with the camera', 2.0,
          changed(image_faults.box(moving=False))),
    Fault('box, moving', 'a near box over a third of the image goes to and fro', 2.0,
          changed(image_faults.box(moving=True))),
    Fault('kidnapped, seen', 'a cut to a place seen before', 0.0, kidnapped_to_seen,
          degenerate_detects=False),
    Fault('kidnapped, unseen', 'a cut to another scene, and back', 1.5, kidnapped_and_back,
          degenerate_detects=False),
    Fault('one stamp ahead', 'one frame is stamped an hour ahead', 0.0, one_stamp_ahead),
    Fault('clock ahead', 'the clock is set an hour ahead', 0.0, clock_jumps(_HOUR_NS)),
    Fault('clock back', 'the clock is set back an hour', 0.0, clock_jumps(-_HOUR_NS)),
    Fault('stamps reversed', 'the stamps of half a second in reverse order', 0.5,
          stamps_reversed),
    Fault('other intrinsics', 'a focal length 17 % longer', 2.0,
          changed(image_faults.zoomed(1.17))),
    Fault('depth late', 'by 5 frames', 2.0, changed(image_faults.depth_late(5))),
    Fault('colour of another time', 'from the beginning of the sequence', 2.0,
          changed(image_faults.color_of_the_beginning)),
    Fault('mirrored', 'the colour image', 2.0, changed(image_faults.color_mirrored)),
)  # fmt: skip
