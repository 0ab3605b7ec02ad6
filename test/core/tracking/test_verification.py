# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What contradicts an estimate, what makes it doubtful, and what neither does."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from tracked_room import SEEN, SOURCE, frames, tracker  # type: ignore[import-not-found]

from dcgs_ros.core import se3
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.tracking.estimator import Estimate, Memory, estimate
from dcgs_ros.core.tracking.verification import Evidence, Usual, is_repetition, weigh

FINE = Evidence(1.0, 1.0, 1.0, 1.0, 1.0, 100)
FEW, MANY = 30, 100  # landmarks


def evidence(
    jump: float = 1.0,
    overlap: float = 1.0,
    agreement: float = 1.0,
    chi2: float = 1.0,
    consistent: float = 0.7,
    landmarks: int = FEW,
) -> Evidence:
    return Evidence(jump, overlap, agreement, chi2, consistent, landmarks)


# What is made of the evidence.


def test_an_ordinary_frame_is_believed() -> None:
    assert not FINE.contradicts and not FINE.doubtful and not FINE.misfits


@pytest.mark.parametrize('consistent', [0.7, 1.0])
@pytest.mark.parametrize('landmarks', [FEW, MANY])
def test_a_rise_of_the_residuals_suffices(landmarks: int, consistent: float) -> None:
    """However many landmarks agree."""
    seen = [
        evidence(chi2=chi2, consistent=consistent, landmarks=landmarks) for chi2 in (3.5, 2.0, 1.5)
    ]
    assert [e.contradicts for e in seen] == [True, False, False]
    assert [e.doubtful for e in seen] == [True, True, False]


@pytest.mark.parametrize(
    ('landmarks', 'consistent', 'confirmed'),
    [(FEW, 1.0, False), (MANY, 0.7, False), (MANY, 1.0, True)],
)
def test_a_jump_suffices_unless_many_landmarks_confirm_it(
    landmarks: int, consistent: float, confirmed: bool
) -> None:
    """A knock is such a jump; nothing is mapped with it all the same."""
    seen = [
        evidence(jump=jump, consistent=consistent, landmarks=landmarks) for jump in (6.5, 4.0, 2.5)
    ]
    assert [e.contradicts for e in seen] == [not confirmed, False, False]
    assert [e.doubtful for e in seen] == [True, True, False]


@pytest.mark.parametrize('landmarks', [FEW, MANY])
def test_depth_and_landmarks_that_are_far_apart_suffice(landmarks: int) -> None:
    """However many landmarks agree: the pose went with them."""
    seen = [
        replace(evidence(consistent=1.0, landmarks=landmarks), apart=apart)
        for apart in (1.1, 0.8, 0.6, 0.4)
    ]
    assert [e.contradicts for e in seen] == [True, False, False, False]
    assert [e.doubtful for e in seen] == [True, True, False, False]
    assert [e.confirms for e in seen] == [False, False, False, True]


def test_what_is_not_mapped_yet_lowers_the_overlap_but_not_the_agreement() -> None:
    turned, elsewhere = evidence(overlap=0.3), evidence(overlap=0.3, agreement=0.5)
    looked_through = evidence(agreement=0.5)  # at an overlap as before: something moved aside
    assert [e.misfits for e in (turned, elsewhere, looked_through)] == [False, True, False]
    assert [e.doubtful for e in (turned, elsewhere, looked_through)] == [False, True, False]
    assert not any(e.contradicts for e in (turned, elsewhere, looked_through))


@pytest.mark.parametrize(
    ('first', 'second'),
    [('jump', 'agreement'), ('jump', 'consistent'), ('agreement', 'consistent')],
)
def test_two_doubts_contradict_and_one_does_not(first: str, second: str) -> None:
    for names, contradicts in (((first,), False), ((second,), False), ((first, second), True)):
        found = evidence(
            jump=4.0 if 'jump' in names else 1.0,
            overlap=0.6,
            agreement=0.5 if 'agreement' in names else 1.0,
            consistent=0.1 if 'consistent' in names else 0.7,
        )
        assert found.contradicts == contradicts and found.doubtful


def test_landmarks_alone_do_not_contradict() -> None:
    """Things move and turn before a camera; but nothing is mapped by such a frame."""
    for consistent, doubtful in ((0.0, True), (0.5, True), (0.7, False)):
        found = evidence(consistent=consistent, landmarks=MANY)
        assert not found.contradicts and found.doubtful == doubtful


def test_many_landmarks_that_agree_outweigh_a_doubt() -> None:
    two = evidence(jump=4.0, overlap=0.6, agreement=0.5, consistent=0.9)
    assert replace(two, landmarks=FEW).contradicts
    assert not replace(two, landmarks=MANY).contradicts
    assert replace(two, landmarks=MANY, consistent=0.7).contradicts
    assert replace(two, landmarks=MANY).doubtful


# What the evidence is, of a frame that was tracked in the room.


@cache
def found() -> Estimate:
    made = tracker()
    return estimate(frames()[SEEN], made._memory, made.gaussians, made.camera, made.config)


def weighed(
    estimated: Estimate | None = None,
    memory: Memory | None = None,
    usual: Usual | None = None,
    uncertain: float = 0.0,
    config: Config | None = None,
) -> Evidence:
    made = tracker()
    return weigh(
        estimated or found(), memory or made._memory, usual or made._usual,
        uncertain * np.eye(6), made.gaussians, made.camera, config or made.config,
    )  # fmt: skip


def at(T_world_cam: NDArray[np.float64]) -> Estimate:
    """Return the estimate at another pose."""
    registered = replace(found().registered, T_world_cam=T_world_cam)
    return replace(found(), registered=registered)


def test_a_good_estimate_is_believed() -> None:
    seen = weighed()
    assert not seen.contradicts and not seen.doubtful
    assert seen.overlap_ratio == pytest.approx(1.0, abs=0.15)
    assert seen.chi2_ratio == pytest.approx(1.0, abs=0.3)
    assert seen.consistent > 0.9 and seen.landmarks == len(found().landmarks)


@pytest.mark.parametrize('sigmas', [0.0, 2.0, 7.0])
@pytest.mark.parametrize('axis', range(6))
def test_a_jump_is_counted_in_sigmas_of_the_prediction(sigmas: float, axis: int) -> None:
    prior = tracker()._memory.motion.prior(frames()[SEEN].stamp_ns)
    xi = np.zeros(6)
    xi[axis] = sigmas * (prior.sigma_m if axis < 3 else prior.sigma_rad)
    there = at(prior.T_world_cam @ se3.exp(xi))
    assert weighed(there).jump_sigmas == pytest.approx(sigmas, abs=1e-6)
    variance = np.square(prior.sigma_m if axis < 3 else prior.sigma_rad)
    doubted = weighed(there, uncertain=3.0 * variance)  # the poses are as uncertain as that
    assert doubted.jump_sigmas == pytest.approx(0.5 * sigmas, abs=1e-6)


def test_ratios_are_to_the_last_overlap_and_to_the_usual_residuals() -> None:
    usual, memory = replace(tracker()._usual, chi2=2.0), tracker()._memory
    half = weighed(
        memory=replace(memory, overlap=2.0 * memory.overlap),
        usual=replace(usual, chi2=0.5 * usual.chi2),
    )
    assert half.overlap_ratio == pytest.approx(0.5 * weighed().overlap_ratio)
    whole = weighed(usual=usual)
    assert half.chi2_ratio == pytest.approx(2.0 * whole.chi2_ratio)
    assert whole.chi2_ratio == pytest.approx(found().registration.median_chi2 / usual.chi2)


def test_residuals_that_noise_would_leave_are_none_to_speak_of() -> None:
    """Rendered depth fits to a thousandth of its sigma; ten thousandths are no contradiction."""
    perfect = weighed(usual=replace(tracker()._usual, chi2=1e-3))
    assert perfect.chi2_ratio == pytest.approx(found().registration.median_chi2 / 0.2)


def test_the_agreement_is_asked_for_only_where_the_overlap_falls() -> None:
    """Half a metre farther back the frame looks through what the map has."""
    memory = tracker()._memory
    fallen = replace(memory, overlap=1.5)
    there = found().registered.T_world_cam
    away = there @ se3.exp(np.array([0.0, 0.0, -0.5, 0.0, 0.0, 0.0]))
    assert weighed(at(away)).agreement_ratio == 1.0
    assert weighed(memory=fallen).agreement_ratio > 0.9
    wrong = weighed(at(away), memory=fallen)
    assert wrong.agreement_ratio < 0.6 and wrong.misfits
    rough = replace(tracker()._usual, agreement=0.5 * tracker()._usual.agreement)
    assert weighed(at(away), fallen, rough).agreement_ratio == pytest.approx(
        2.0 * wrong.agreement_ratio
    )


@pytest.mark.parametrize('share', [0.0, 0.3, 1.0])
def test_the_share_of_consistent_landmarks_is_counted(share: float) -> None:
    image = found().image
    assert image is not None
    shift = np.zeros((len(image.points), 3), np.float32)
    moved = np.random.default_rng(0).random(len(shift)) < share
    shift[moved] = [0.0, 0.3, 0.0]
    targets = replace(image.targets, points=image.targets.points + shift)
    off = replace(found(), image=replace(image, targets=targets))
    assert weighed(off).consistent == pytest.approx(1.0 - np.mean(moved), abs=0.05)


def landmarks_moved(xi: NDArray[np.float64]) -> Estimate:
    """Return the estimate with landmarks that say that the camera is moved by `xi` (6,)."""
    registration, T = found().registration, found().registered.T_world_cam
    assert registration.image is not None
    targets = registration.image.targets
    points = se3.transform(T @ se3.exp(xi) @ se3.inverse(T), targets.points).astype(np.float32)
    image = replace(registration.image, targets=replace(targets, points=points))
    return replace(found(), registration=registration.beside(image))


@pytest.mark.parametrize('axis', range(6))
def test_how_far_landmarks_are_apart_from_depth_is_told(axis: int) -> None:
    """As a share of what makes a pose degenerate, of depth's bias, and of what is claimed.

    To the side, where depth holds the pose least, the predicted motion takes a part of it.
    """
    config = tracker().config
    limit = (config.registration.degenerate_m, config.registration.degenerate_rad)[axis // 3]
    seen = [weighed(landmarks_moved(sign * 1.5 * limit * np.eye(6)[axis])) for sign in (1.0, -1.0)]
    assert np.mean([e.apart for e in seen]) == pytest.approx(1.5, abs=0.25)
    there = landmarks_moved(1.5 * limit * np.eye(6)[axis])
    doubted = weighed(there, uncertain=3.0 * limit**2)  # the poses are as uncertain as that
    assert doubted.apart < 0.6 * seen[0].apart
    biased = replace(config, sensor=replace(config.sensor, depth_bias=0.02))
    if axis < 3:
        assert weighed(there, config=biased).apart < 0.7 * seen[0].apart
    else:
        assert weighed(there, config=biased).apart == pytest.approx(seen[0].apart)


def test_landmarks_that_draw_the_pose_away_from_depth_contradict_it() -> None:
    """Colour that is not of the depth camera moves otherwise; the pose and the motion follow it.

    Nothing else speaks against that.
    """
    made = tracker()
    T = made.T_world_cam
    away = T @ se3.exp(np.array([0, 0, 0, 0, 0.06, 0])) @ se3.inverse(T)
    memory = made._memory.moved(np.repeat(away[None], made.keyframes, axis=0), away)
    drawn = weighed(
        estimate(frames()[SEEN], memory, made.gaussians, made.camera, made.config), memory
    )
    assert drawn.consistent > 0.9 and drawn.contradicts
    assert not replace(drawn, apart=0.0).contradicts


def test_without_landmarks_none_are_apart_from_depth() -> None:
    alone = replace(found(), registration=replace(found().registration, image=None))
    assert weighed(alone).apart == 0.0


def test_without_depth_only_the_motion_and_the_landmarks_speak() -> None:
    """Nor is what is usual learnt from such a frame."""
    registration = found().registration
    keep = np.zeros(len(registration.depth.points), bool)
    depth = replace(
        registration.depth, points=registration.depth.points[keep],
        covariances=registration.depth.covariances[keep],
        targets=registration.depth.targets[keep],
    )  # fmt: skip
    blind = replace(found(), registration=replace(
        registration, depth=depth, inliers=0, median_chi2=np.inf
    ))  # fmt: skip
    seen = weighed(blind)
    assert (seen.overlap_ratio, seen.agreement_ratio, seen.chi2_ratio) == (1.0, 1.0, 1.0)
    images = replace(blind, registration=replace(blind.registration, image=None))
    assert weighed(images).consistent == 1.0


def test_what_is_usual_settles_on_what_is_seen() -> None:
    """The first frame counts whole, later ones for what an average over ten of them gives."""
    registration = found().registration
    usual = Usual().with_frame(registration)
    assert usual.overlap == pytest.approx(registration.overlap)
    assert usual.chi2 == pytest.approx(registration.median_chi2)
    fewer = replace(registration, inliers=registration.inliers // 2)
    for k in range(1, 60):
        usual = usual.with_frame(fewer)
        if k == 1:
            between = 0.5 * (registration.overlap + fewer.overlap)
            assert usual.overlap == pytest.approx(between)
    assert usual.overlap == pytest.approx(fewer.overlap, rel=0.01)
    before = usual.overlap
    outlier = usual.with_frame(registration)
    assert outlier.overlap - before == pytest.approx(0.1 * (registration.overlap - before))


def test_the_usual_agreement_is_that_of_the_last_keyframes() -> None:
    usual = Usual()
    assert usual.with_keyframe(1.0) == usual
    assert usual.with_keyframe(0.6).agreement == pytest.approx(0.8)
    for _ in range(20):
        usual = usual.with_keyframe(0.7)
    assert usual.agreement == pytest.approx(0.7, abs=1e-4)
    assert (usual.overlap, usual.chi2) == (Usual().overlap, Usual().chi2)


def test_the_first_keyframe_has_no_map_to_agree_with() -> None:
    assert tracker()._usual.agreement > 0.9
    assert tracker()._usual.frames == SEEN - 1


# Frames that say nothing new.


def test_a_repetition_is_bit_by_bit_the_same() -> None:
    frame = frames()[0]
    depth_m = frame.depth_m.copy()
    depth_m[:20] = np.nan
    frame = replace(frame, depth_m=depth_m)
    later = replace(frame, stamp_ns=frame.stamp_ns + 33_000_000, depth_m=depth_m.copy())
    assert is_repetition(later, frame)
    color, nearer = frame.color.copy(), depth_m.copy()
    color[-1, -1, -1] ^= 1
    nearer[-1, -1] = np.nextafter(nearer[-1, -1], np.float32(0))
    assert not is_repetition(replace(later, color=color), frame)
    assert not is_repetition(replace(later, depth_m=nearer), frame)
    assert not is_repetition(frames()[1], frames()[0])
    grey = frame.color[..., 0]
    assert is_repetition(replace(frame, color=grey.copy()), replace(frame, color=grey))
    assert not is_repetition(replace(frame, color=grey), frame)


def test_a_few_landmarks_are_no_dissent() -> None:
    """Four corners of noise on a wall disagree with anything."""
    handful = evidence(jump=4.0, consistent=0.0, landmarks=4)
    assert not handful.contradicts
    assert replace(handful, landmarks=FEW).contradicts


def test_landmarks_that_vanish_at_once_are_a_doubt_like_dissent() -> None:
    """A cut to another view leaves few; so does a dark image, where the map still fits."""
    cut = replace(evidence(overlap=0.6, agreement=0.5, landmarks=4), kept=0.05)
    assert cut.contradicts
    assert not replace(cut, kept=0.5).contradicts
    assert not replace(cut, overlap_ratio=1.0).contradicts


def test_the_share_of_landmarks_that_are_kept_is_told() -> None:
    memory = tracker()._memory
    assert weighed(found()).kept == pytest.approx(len(found().landmarks) / len(memory.landmarks))
    assert weighed(replace(found(), fresh=False)).kept == 1.0


def test_depth_that_comes_again_is_of_when_it_was_taken() -> None:
    """As new it would say that a camera that goes on stands still."""
    made, last, frame = deepcopy(tracker()), frames()[SEEN - 1], frames()[SEEN]
    made.track(replace(frame, depth_m=last.depth_m.copy()))
    first, now = (SOURCE.pose(one.stamp_ns) for one in (frames()[0], frame))
    off = se3.log(se3.inverse(made.T_world_cam) @ se3.inverse(first) @ now)
    assert np.linalg.norm(off[:3]) < 0.0035  # as new it ends at 0.0044
