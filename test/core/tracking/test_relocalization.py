# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A camera is lost where that is so, is found again where it is, and maps nothing in between."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.kernels import jit
from dcgs_ros.core.tracking import tracker as tracking
from dcgs_ros.core.tracking.registration import Registration
from dcgs_ros.core.tracking.relocalization import Relocalizer
from dcgs_ros.core.tracking.result import TrackingState, TrackResult
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.core.tracking.verification import Evidence, Usual
from dcgs_ros.core.tracking.warmup import EVERY_FRAME
from dcgs_ros.datasets.synthetic.source import SyntheticSource

SECOND = 1_000_000_000
NEAR_M, NEAR_RAD = 0.01, np.radians(0.5)  # of the truth
CONFIRMED_AFTER = 5  # frames, the one with which the camera is found included
ROOM = 'synthetic:room?frames=16&sensor=kinect'
OK, LOST, FOUND = TrackingState.OK, TrackingState.LOST, TrackingState.RELOCALISED
NO_KEYFRAMES = {
    'keyframes.translation_m': 100, 'keyframes.rotation_rad': 3.2, 'keyframes.overlap': 0.01,
    'keyframes.landmarks': 0.01,
}  # fmt: skip


@cache
def source_of(address: str) -> SyntheticSource:
    return SyntheticSource.from_address(address)


@cache
def frames_of(address: str) -> tuple[RgbdFrame, ...]:
    return tuple(source_of(address))


def tracker_for(address: str = ROOM, settings: Mapping[str, object] | None = None) -> Tracker:
    source = source_of(address)
    config = override(replace(Config(), sensor=source.sensor), dict(settings or {}))
    return Tracker(source.camera, config)


def eager() -> Tracker:
    """Return a tracker that makes a keyframe of every frame that it may."""
    return tracker_for(settings=EVERY_FRAME)


def shifted(frame: RgbdFrame, by_ns: int) -> RgbdFrame:
    return replace(
        frame, stamp_ns=frame.stamp_ns + by_ns, depth_stamp_ns=frame.depth_stamp_ns + by_ns
    )


def covered(frame: RgbdFrame, k: int = 0) -> RgbdFrame:
    """Something close, a little nearer with each frame."""
    return replace(
        frame,
        color=np.full_like(frame.color, 100 + k),
        depth_m=np.full_like(frame.depth_m, 0.4 - 1e-3 * k),
    )


def states(results: Sequence[TrackResult]) -> list[TrackingState]:
    return [result.state for result in results]


def assert_true(results: Sequence[TrackResult], first: int, address: str = ROOM) -> None:
    """Every pose but of lost frames is near the true motion; `results[0]` is of frame `first`."""
    start, frames = source_of(address).pose(frames_of(address)[0].stamp_ns), frames_of(address)
    for result, frame in zip(results, frames[first:], strict=False):
        if result.state is not LOST:
            true = se3.inverse(start) @ source_of(address).pose(frame.stamp_ns)
            xi = se3.log(se3.inverse(result.T_world_cam) @ true)
            assert np.linalg.norm(xi[:3]) < NEAR_M and np.linalg.norm(xi[3:]) < NEAR_RAD


@pytest.fixture(autouse=True)
def restored_threads() -> Iterator[None]:
    yield
    jit.set_threads(None)


# A loss, and what follows.


def test_what_is_lost_is_found_confirmed_and_only_then_mapped() -> None:
    frames, tracker = frames_of(ROOM), eager()
    before = [tracker.track(frame) for frame in frames[:5]]
    assert all(result.keyframe for result in before[1:])
    ids, viewpoints = tracker.gaussians.ids.copy(), tracker.gaussians.viewpoints.copy()
    lost = [tracker.track(covered(frame, k)) for k, frame in enumerate(frames[5:8])]
    assert states(lost) == [LOST] * 3 and tracker.searching
    found = [tracker.track(frame) for frame in frames[8 : 8 + CONFIRMED_AFTER]]
    assert states(found) == [FOUND] * CONFIRMED_AFTER
    for result in lost + found:
        assert not result.keyframe and not result.keyframes
    for result in lost:
        np.testing.assert_array_equal(result.T_world_cam, before[-1].T_world_cam)
        assert result.landmarks == 0 and np.linalg.eigvalsh(result.covariance)[0] > 0.1**2
    np.testing.assert_array_equal(tracker.gaussians.ids, ids)
    np.testing.assert_array_equal(tracker.gaussians.viewpoints, viewpoints)
    after = [tracker.track(frame) for frame in frames[8 + CONFIRMED_AFTER :]]
    assert states(after) == [OK] * len(after) and all(result.keyframe for result in after)
    assert_true(found + after, first=8)


def test_a_brief_loss_is_looked_for_where_the_camera_was_going() -> None:
    """After three frames the registration finds the place from there, not from the last pose."""
    address = 'synthetic:room?frames=12&sensor=kinect'
    frames, tracker = frames_of(address), tracker_for(address, {'ablation': 'sigma_t'})
    for frame in frames[:5]:
        tracker.track(frame)
    for k, frame in enumerate(frames[5:8]):
        assert tracker.track(covered(frame, k)).state is LOST
    found = [tracker.track(frame) for frame in frames[8:]]
    assert found[0].state is FOUND
    assert_true(found, first=8, address=address)


@pytest.mark.parametrize('elsewhere', ['desk', 'corridor'])
def test_a_camera_that_was_carried_elsewhere_is_lost_until_it_is_back(elsewhere: str) -> None:
    """Before another floor, and between walls that are at right angles too."""
    frames, tracker = frames_of(ROOM), tracker_for()
    other = frames_of(f'synthetic:{elsewhere}?frames=8&sensor=kinect')
    for frame in frames[:8]:
        tracker.track(frame)
    size, last = len(tracker.gaussians), tracker.T_world_cam
    for k, frame in enumerate(other):
        by_ns = frames[7].stamp_ns - frame.stamp_ns + (k + 1) * 33_000_000
        result = tracker.track(shifted(replace(frame, depth_stamp_ns=frame.stamp_ns), by_ns))
        assert result.state is LOST
        np.testing.assert_array_equal(result.T_world_cam, last)
    assert len(tracker.gaussians) == size
    back = [tracker.track(shifted(frame, SECOND)) for frame in frames[8:]]
    assert states(back[:5]) == [FOUND] * 5
    assert_true(back, first=8)


@pytest.mark.parametrize('ablation', ['full', 'sigma_t'])
def test_where_a_direction_is_not_held_the_camera_is_not_found(ablation: str) -> None:
    """It may be anywhere along the plane."""
    address = 'synthetic:plane?frames=10&sensor=ideal'
    frames, tracker = frames_of(address), tracker_for(address, {'ablation': ablation})
    for frame in frames[:5]:
        assert tracker.track(frame).state is not LOST
    tracker.interrupt()
    assert states([tracker.track(frame) for frame in frames[5:]]) == [LOST] * 5


def replaced_evidence(monkeypatch: pytest.MonkeyPatch, **values: float) -> None:
    true_weigh = tracking.weigh

    def weigh(*arguments: object) -> Evidence:
        return replace(true_weigh(*arguments), **values)  # type: ignore[arg-type]

    monkeypatch.setattr(tracking, 'weigh', weigh)


def test_a_doubtful_frame_is_tracked_but_not_mapped(monkeypatch: pytest.MonkeyPatch) -> None:
    frames, tracker = frames_of(ROOM), eager()
    for frame in frames[:5]:
        tracker.track(frame)
    usual, size = tracker._usual, len(tracker.gaussians)
    with monkeypatch.context() as patch:
        replaced_evidence(patch, consistent=0.5)
        doubted = tracker.track(frames[5])
        assert doubted.state is OK and not doubted.keyframe
        assert len(tracker.gaussians) == size and tracker._usual == usual
    after = tracker.track(frames[6])
    assert after.keyframe
    assert_true([doubted, after], first=5)


@pytest.mark.parametrize('doubt', [{'consistent': 0.5}, {'apart': 0.6}])
def test_a_doubtful_frame_does_not_confirm_a_place(
    monkeypatch: pytest.MonkeyPatch, doubt: dict[str, float]
) -> None:
    """Nor does one whose new landmarks begin to say something else than depth."""
    frames, tracker = frames_of(ROOM), tracker_for()
    for frame in frames[:5]:
        tracker.track(frame)
    tracker.interrupt()
    assert tracker.track(frames[5]).state is FOUND
    with monkeypatch.context() as patch:
        replaced_evidence(patch, **doubt)
        doubted = [tracker.track(frame) for frame in frames[6:9]]
    after = [tracker.track(frame) for frame in frames[9:14]]
    assert states(doubted + after) == [FOUND] * 3 + [FOUND] * 4 + [OK]


def test_a_pose_that_is_contradicted_though_right_is_found_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By what depth alone says from there: with new landmarks, and nothing mapped."""
    frames, tracker = frames_of(ROOM), eager()
    for frame in frames[:5]:
        tracker.track(frame)
    size = len(tracker.gaussians)
    with monkeypatch.context() as patch:
        replaced_evidence(patch, chi2_ratio=4.0)
        again = tracker.track(frames[5])
    assert again.state is FOUND and not again.keyframe and again.landmarks > 50
    assert len(tracker.gaussians) == size
    assert_true([again, tracker.track(frames[6])], first=5)


def test_what_a_camera_cannot_have_reached_is_not_taken_for_its_place() -> None:
    """Seven frames' way in a frame's time, by depth alone; after half a second it may be there."""
    frames, tracker = frames_of(ROOM), tracker_for()
    for frame in frames[:8]:
        tracker.track(frame)
    covered_at = shifted(covered(frames[7]), 10_000_000)
    assert tracker.track(covered_at).state is LOST
    jumped = frames[0], frames[1]
    for k, frame in enumerate(jumped):
        stamp_ns = frames[7].stamp_ns + (k + 1) * 20_000_000
        result = tracker.track(shifted(frame, stamp_ns - frame.stamp_ns))
        assert result.state is LOST
    late = shifted(frames[3], SECOND)
    assert tracker.track(late).state is FOUND


# Gaps and clocks.


@pytest.mark.parametrize(('gap_s', 'lost'), [(0.4, False), (0.6, True), (10.0, True)])
def test_over_a_gap_nothing_is_extrapolated(gap_s: float, lost: bool) -> None:
    """The frame after it is looked for in the map, as after a loss, in the core itself."""
    frames, tracker = frames_of(ROOM), tracker_for()
    late_ns = round(gap_s * SECOND) - 33_333_333
    for frame in frames[:6]:
        tracker.track(frame)
    tracker._memory = replace(  # the camera rests, so that a short gap is no jump
        tracker._memory, motion=replace(tracker._memory.motion, twist=np.zeros(6))
    )
    after = [tracker.track(shifted(frame, late_ns)) for frame in frames[6:]]
    assert states(after) == ([FOUND] * 5 if lost else [OK] * 5) + [OK] * (len(after) - 5)
    assert_true(after, first=6)


def test_one_stamp_an_hour_ahead_costs_no_later_frame() -> None:
    frames, tracker = frames_of(ROOM), tracker_for()
    stamped = [shifted(frame, 3600 * SECOND * (k == 6)) for k, frame in enumerate(frames)]
    results = [tracker.track(frame) for frame in stamped]
    assert states(results) == [OK] * 6 + [FOUND] * 6 + [OK] * 4
    assert_true(results, first=0)


def test_a_clock_that_is_set_back_costs_no_frame() -> None:
    frames, tracker = frames_of(ROOM), tracker_for()
    stamped = [shifted(frame, -900 * SECOND * (k >= 6)) for k, frame in enumerate(frames)]
    results = [tracker.track(frame) for frame in stamped]
    assert states(results) == [OK] * 6 + [FOUND] * 5 + [OK] * 5
    assert [result.stamp_ns for result in results] == [frame.stamp_ns for frame in stamped]
    assert_true(results, first=0)


# Frames that come twice.


@pytest.mark.parametrize('at', [2, 6])
def test_a_repeated_frame_is_lost_and_changes_nothing(at: int) -> None:
    """The next one is tracked bit by bit as if it had not come."""
    frames, one, other = frames_of(ROOM), tracker_for(), tracker_for()
    for frame in frames[:at]:
        one.track(frame)
        other.track(frame)
    for k in range(2):
        repeated = one.track(shifted(frames[at - 1], (k + 1) * 10_000_000))
        assert repeated.state is LOST and not one.searching and not repeated.keyframe
        np.testing.assert_array_equal(repeated.T_world_cam, one.T_world_cam)
    for frame in frames[at:]:
        with_it, without = one.track(frame), other.track(frame)
        assert with_it.T_world_cam.tobytes() == without.T_world_cam.tobytes()
        assert with_it.covariance.tobytes() == without.covariance.tobytes()
        assert with_it.state is OK and with_it.landmarks == without.landmarks


def test_frozen_images_are_lost_for_as_long_as_they_last() -> None:
    """For more than half a second, after which the camera is looked for in the map."""
    frames, tracker = frames_of(ROOM), tracker_for()
    for frame in frames[:6]:
        tracker.track(frame)
    frozen = [shifted(frames[5], k * 33_333_333) for k in range(1, 21)]
    assert states([tracker.track(frame) for frame in frozen]) == [LOST] * 20
    after = [tracker.track(shifted(frame, 20 * 33_333_333)) for frame in frames[6:]]
    assert states(after[:6]) == [FOUND] * 5 + [OK]
    assert_true(after, first=6)


def test_where_colour_comes_twice_depth_alone_carries_on() -> None:
    """Landmarks stay where they are in the image that KLT goes on from; none is dropped."""
    frames, tracker = frames_of(ROOM), tracker_for(settings=NO_KEYFRAMES)
    results = [tracker.track(frame) for frame in frames[:6]]
    pixels, image = tracker.landmarks.pixels.copy(), tracker._memory.image
    for frame in frames[6:8]:
        results.append(tracker.track(replace(frame, color=frames[5].color)))
        np.testing.assert_array_equal(tracker.landmarks.pixels, pixels)
        assert tracker._memory.image is image and tracker._memory.last is not image
        assert results[-1].inliers > 1000
    results.append(tracker.track(frames[8]))
    assert tracker._memory.image is tracker._memory.last
    assert len(tracker.landmarks) > 0.8 * len(pixels)
    moved = np.linalg.norm(results[8].T_world_cam[:3, 3] - results[5].T_world_cam[:3, 3])
    assert moved > 2 * NEAR_M  # it would show if the pose stood still with the image
    assert states(results) == [OK] * 9
    assert_true(results, first=0)


# Landmarks that do not run out.


def anchors(tracker: Tracker) -> set[bytes]:
    return {point.tobytes() for point in tracker.landmarks.targets.points}


def test_landmarks_are_replenished_between_keyframes() -> None:
    address = 'synthetic:room?frames=12&sensor=kinect&speed=3'
    tracker = tracker_for(address, NO_KEYFRAMES)
    results, at_first = [], set[bytes]()
    for k, frame in enumerate(frames_of(address)):
        results.append(tracker.track(frame))
        at_first = anchors(tracker) if k == 1 else at_first
    assert not any(result.keyframe for result in results[1:])
    assert len(anchors(tracker) - at_first) > 50
    assert min(result.landmarks for result in results) > 100
    assert_true(results, first=0, address=address)


def test_a_side_of_the_image_that_has_lost_its_landmarks_gets_new_ones() -> None:
    """Though there are enough of them in all."""
    frames, tracker = (
        frames_of(ROOM),
        tracker_for(settings=NO_KEYFRAMES | {'landmarks.replenish': 0.1}),
    )
    for frame in frames[:3]:
        tracker.track(frame)
    landmarks = tracker.landmarks
    left = landmarks.pixels[:, 0] < 200
    assert 30 < np.count_nonzero(left) < 0.7 * len(left)
    tracker._memory = replace(tracker._memory, landmarks=landmarks[~left])
    tracker.track(frames[3])
    again = np.count_nonzero(tracker.landmarks.pixels[:, 0] < 200)
    assert again > 0.4 * np.count_nonzero(left)


# The search itself.


def poses(n: int) -> list[NDArray[np.float64]]:
    return [se3.exp(np.array([k, 0, 0, 0, 0, 0], np.float64)) for k in range(n)]


def test_the_last_pose_is_tried_always_and_the_visited_ones_in_turn() -> None:
    """The newest first."""
    last, visited = se3.exp(np.ones(6)), poses(5)
    search = Relocalizer(last, visited, Usual())
    tried = [search._some() for _ in range(5)]
    assert all(starts[0] is last and len(starts) == 3 for starts in tried)
    order = [int(T[0, 3]) for starts in tried for T in starts[1:]]
    assert order == [4, 3, 2, 1, 0, 4, 3, 2, 1, 0]
    assert [len(Relocalizer(last, poses(n), Usual())._some()) for n in (0, 1)] == [1, 2]


def fit(overlap: float, chi2: float = 1.0) -> Registration:
    return cast(Registration, SimpleNamespace(overlap=overlap, median_chi2=chi2))


USUAL = Usual(overlap=0.9, chi2=0.5, agreement=0.95)


@pytest.mark.parametrize(
    ('found', 'agreement', 'accepted'),
    [
        (fit(0.80, 0.9), 0.85, True),
        (fit(0.72, 0.9), 0.85, False),  # explains too little of what is usual
        (fit(0.80, 1.1), 0.85, False),  # fits worse than is usual
        (fit(0.80, 0.9), 0.80, False),  # looks through what the map has
    ],
)
def test_a_place_has_to_fit_nearly_as_well_as_is_usual(
    found: Registration, agreement: float, accepted: bool
) -> None:
    search = Relocalizer(np.eye(4), [], USUAL)
    assert search.accepts(found, agreement) == accepted


def searching_for(frames: int) -> Relocalizer:
    search = Relocalizer(np.eye(4), [], USUAL)
    for _ in range(frames):
        assert not search.accepts(fit(0.1), 1.0)
    return search


def test_the_longer_it_is_looked_for_the_less_it_has_to_explain_down_to_a_limit() -> None:
    """It may look through no more of the map, and fit no worse, however long that takes."""
    assert not searching_for(0).accepts(fit(0.66), 1.0)
    assert searching_for(40).accepts(fit(0.66), 1.0)
    for found, agreement in ((fit(0.6), 1.0), (fit(0.9), 0.8), (fit(0.9, 1.1), 1.0)):
        assert not searching_for(1000).accepts(found, agreement)
