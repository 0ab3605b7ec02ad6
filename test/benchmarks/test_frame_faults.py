# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Faults as transformations of a sequence: what they leave alone, and what they do."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.frame_faults import FAULTS, Clip, Fault, Faulted, Shot
from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.sensor import SensorNoise
from dcgs_ros.datasets.source import BadFrame

FRAMES, PERIOD_NS, LAG_NS = 60, 100_000_000, 7_000_000
BEGIN = 24  # 40 % of the frames
SMALL = PinholeCamera(96, 64, 80.0, 80.0, 47.5, 31.5)
NOISE = SensorNoise(0.001, 0.001)
HOUR_S = 3600.0
BY_NAME = {fault.name: fault for fault in FAULTS}
CLOCKS = ('one stamp ahead', 'clock ahead', 'clock back', 'stamps reversed')
every_fault = pytest.mark.parametrize('fault', FAULTS, ids=lambda fault: fault.name)


def frame(rng: np.random.Generator, k: int) -> RgbdFrame:
    color = rng.integers(10, 250, (64, 96, 3), np.uint8)
    depth_m = rng.uniform(1.0, 2.0, (64, 96)).astype(np.float32)
    return RgbdFrame(k * PERIOD_NS, k * PERIOD_NS - LAG_NS, color, depth_m)


def shots(seed: int, count: int) -> tuple[Shot, ...]:
    """A camera that moves to the right and turns."""
    rng = np.random.default_rng(seed)
    twist = np.array([0.02, 0.0, 0.0, 0.0, 0.01, 0.0])
    return tuple(Shot(frame(rng, k), 0.1 * k, se3.exp(k * twist), k) for k in range(count))


CLIP = Clip(shots(0, FRAMES), SMALL, NOISE, shots(1, 20))


def digest(sequence: list[Shot]) -> str:
    found = hashlib.sha256()
    for shot in sequence:
        item = shot.item
        found.update(repr((shot.time_s, shot.source, shot.T_world_cam.tolist())).encode())
        if isinstance(item, RgbdFrame):
            found.update(repr((item.stamp_ns, item.depth_stamp_ns)).encode())
            found.update(item.color.tobytes() + item.depth_m.tobytes())
        else:
            found.update(repr(item).encode())
    return found.hexdigest()


def images(shot: Shot) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    assert isinstance(shot.item, RgbdFrame)
    return shot.item.color, shot.item.depth_m


def clean_shot(shot: Shot) -> Shot:
    assert shot.source is not None
    return CLIP.shots[shot.source]


def while_it_lasts(name: str) -> list[Shot]:
    faulted = BY_NAME[name].put_into(CLIP, 0)
    return faulted.shots[faulted.begin : faulted.end]


def gap_s(faulted: Faulted) -> float:
    """The longest time without a frame."""
    return float(np.diff([shot.time_s for shot in faulted.shots]).max())


def test_there_are_at_least_24_kinds_with_a_name_each() -> None:
    assert len(BY_NAME) == len(FAULTS) >= 24


@every_fault
def test_the_same_seed_gives_the_same_bytes_and_the_sequence_is_left_alone(fault: Fault) -> None:
    before = digest([*CLIP.shots, *CLIP.elsewhere])
    assert digest(fault.put_into(CLIP, 3).shots) == digest(fault.put_into(CLIP, 3).shots)
    assert digest([*CLIP.shots, *CLIP.elsewhere]) == before


@pytest.mark.parametrize('name', ['holes', 'salt and pepper', 'lens covered', 'repeated'])
def test_another_seed_gives_other_bytes(name: str) -> None:
    fault = BY_NAME[name]
    assert digest(fault.put_into(CLIP, 3).shots) != digest(fault.put_into(CLIP, 4).shots)


@every_fault
def test_frames_before_and_after_are_those_of_the_sequence(fault: Fault) -> None:
    faulted = fault.put_into(CLIP, 0)
    assert BEGIN <= faulted.begin <= faulted.end < len(faulted.shots)
    for k, shot in enumerate(faulted.shots[: faulted.begin]):
        assert shot is CLIP.shots[k]
    for shot in faulted.shots[faulted.end :]:
        for image, clean in zip(images(shot), images(clean_shot(shot)), strict=True):
            assert image is clean


@every_fault
def test_a_fault_does_something_and_for_as_long_as_it_says(fault: Fault) -> None:
    faulted = fault.put_into(CLIP, 0)
    assert digest(faulted.shots) != digest(list(CLIP.shots))
    for shot in faulted.shots[faulted.begin : faulted.end]:
        begun_s = BEGIN * 0.1
        assert begun_s - 1e-9 <= shot.time_s < begun_s + max(fault.seconds, 0.1) - 1e-9


@every_fault
def test_true_poses_and_times_follow_the_camera(fault: Fault) -> None:
    """Whatever the images and stamps say."""
    faulted = fault.put_into(CLIP, 0)
    assert np.all(np.diff([shot.time_s for shot in faulted.shots]) > 0)
    for shot in faulted.shots:
        if shot.source is not None:
            np.testing.assert_array_equal(shot.T_world_cam, clean_shot(shot).T_world_cam)


@every_fault
def test_stamps_increase_and_follow_the_time_but_where_the_clock_is_the_fault(
    fault: Fault,
) -> None:
    frames = [
        (shot.time_s, shot.item) for shot in fault.put_into(CLIP, 0).shots
        if isinstance(shot.item, RgbdFrame)
    ]  # fmt: skip
    for _, item in frames:
        assert item.depth_stamp_ns == item.stamp_ns - LAG_NS
    follow = all(abs(item.stamp_ns * 1e-9 - time_s) < 1e-6 for time_s, item in frames)
    assert follow is (fault.name not in CLOCKS)


@pytest.mark.parametrize('seconds', ['0.5', '2', '10'])
def test_no_frame_comes_in_a_black_out(seconds: str) -> None:
    faulted = BY_NAME[f'black-out {seconds} s'].put_into(CLIP, 0)
    assert gap_s(faulted) == pytest.approx(float(seconds), abs=0.11)
    assert len(faulted.shots) - faulted.begin >= (FRAMES - BEGIN) // 2


def test_a_gap_in_motion_is_where_the_camera_moves_most() -> None:
    rests = [np.eye(4)] * 30 + [se3.exp(np.full(6, 0.1) * k) for k in range(1, 31)]
    clip = replace(
        CLIP,
        shots=tuple(
            replace(shot, T_world_cam=T) for shot, T in zip(CLIP.shots, rests, strict=True)
        ),
    )
    faulted = BY_NAME['gap in motion'].put_into(clip, 0)
    assert faulted.begin >= 29
    assert gap_s(faulted) == pytest.approx(1.1)


def test_depth_that_is_zero_everywhere_is_refused_as_a_source_does() -> None:
    assert all(isinstance(shot.item, BadFrame) for shot in while_it_lasts('depth zero'))
    for shot in while_it_lasts('depth almost zero'):
        assert np.count_nonzero(images(shot)[1]) == 50


@pytest.mark.parametrize(
    ('name', 'share'),
    [('holes', 0.5), ('dead block', 2 / 3), ('lens covered', 0.05), ('depth not finite', 0.8)],
)
def test_the_share_of_depth_that_is_left(name: str, share: float) -> None:
    for shot in while_it_lasts(name):
        depth_m = images(shot)[1]
        left = np.isfinite(depth_m) & (depth_m > 0)
        assert left.mean() == pytest.approx(share, abs=0.02)


def test_the_share_of_pixels_that_a_fault_changes() -> None:
    for name, which in (('salt and pepper', 0), ('depth outliers', 1)):
        for shot in while_it_lasts(name):
            differ = images(shot)[which] != images(clean_shot(shot))[which]
            assert differ.reshape(64, 96, -1).any(axis=2).mean() == pytest.approx(0.2, abs=0.03)


def test_how_many_frames_are_dropped_and_repeated() -> None:
    assert len(while_it_lasts('5 of 6 dropped')) == 20 // 6
    repeats = 0
    for seed in range(40):
        faulted = BY_NAME['repeated'].put_into(CLIP, seed)
        for before, shot in zip(CLIP.shots[BEGIN - 1 :], faulted.shots[BEGIN:], strict=False):
            repeats += images(shot)[0] is images(before)[0]
    assert repeats / (40 * (FRAMES - BEGIN)) == pytest.approx(0.03, abs=0.01)


def test_frozen_images_are_those_of_the_last_frame() -> None:
    for shot in while_it_lasts('frozen'):
        assert images(shot)[0] is images(CLIP.shots[BEGIN - 1])[0]


def test_depth_and_colour_of_other_frames() -> None:
    for k, shot in enumerate(while_it_lasts('depth late')):
        assert images(shot)[1] is images(CLIP.shots[BEGIN + k - 5])[1]
    for k, shot in enumerate(while_it_lasts('colour of another time')):
        assert images(shot)[0] is images(CLIP.shots[k])[0]


def test_a_wall_stands_still_while_the_camera_moves() -> None:
    """All its points lie in one plane of the world, within the depth's noise."""
    points = []
    for shot in while_it_lasts('bare wall')[:10]:
        depth_m = images(shot)[1]
        rays = np.dstack([SMALL.undistortion_map, np.ones_like(depth_m)])
        points.append(se3.transform(shot.T_world_cam, (rays * depth_m[..., None]).reshape(-1, 3)))
    world = np.concatenate(points)
    normal = np.linalg.svd(world - world.mean(axis=0), full_matrices=False)[2][2]
    off = (world - world.mean(axis=0)) @ normal
    assert off.std() < 2 * NOISE.sigma(1.5)


@pytest.mark.parametrize('name', ['box, fixed', 'box, moving'])
def test_a_box_hides_a_third_of_the_image(name: str) -> None:
    for shot in while_it_lasts(name):
        assert (images(shot)[1] < 0.8).mean() == pytest.approx(1 / 3, abs=0.01)


def test_other_intrinsics_leave_the_principal_point_where_it_is() -> None:
    """And move other pixels away from it by the factor."""
    row = np.arange(96, dtype=np.float32) + 1.0
    clip = replace(
        CLIP,
        shots=tuple(
            replace(shot, item=replace(shot.item, depth_m=np.tile(row, (64, 1))))
            for shot in CLIP.shots
            if isinstance(shot.item, RgbdFrame)
        ),
    )
    faulted = BY_NAME['other intrinsics'].put_into(clip, 0)
    depth_m = images(faulted.shots[faulted.begin])[1]
    seen_at = (depth_m[32] - 1.0 - SMALL.cx) * 1.17 + SMALL.cx
    np.testing.assert_allclose(seen_at, np.arange(96), atol=0.65)


def test_kidnapped_to_the_earlier_place_that_is_farthest_away() -> None:
    faulted = BY_NAME['kidnapped, seen'].put_into(CLIP, 0)
    assert [shot.source for shot in faulted.shots[faulted.begin :]] == list(range(36))


def test_kidnapped_to_another_scene_and_back() -> None:
    faulted = BY_NAME['kidnapped, unseen'].put_into(CLIP, 0)
    foreign = faulted.shots[faulted.begin : faulted.end]
    assert len(foreign) == 15
    for k, shot in enumerate(foreign):
        assert shot.source is None and images(shot)[0] is images(CLIP.elsewhere[k])[0]
        away = shot.T_world_cam[:3, 3] - CLIP.shots[BEGIN].T_world_cam[:3, 3]
        assert np.linalg.norm(away) > 50.0
    assert faulted.shots[faulted.end].source == BEGIN


@pytest.mark.parametrize(
    ('name', 'shifts_s'),
    [
        ('one stamp ahead', [0.0, HOUR_S, 0.0, 0.0]),
        ('clock ahead', [0.0, HOUR_S, HOUR_S, HOUR_S]),
        ('clock back', [0.0, -HOUR_S, -HOUR_S, -HOUR_S]),
        ('stamps reversed', [0.0, 0.4, 0.2, 0.0]),
    ],
)
def test_clocks(name: str, shifts_s: list[float]) -> None:
    faulted = BY_NAME[name].put_into(CLIP, 0)
    for shot, shift_s in zip(faulted.shots[BEGIN - 1 :], shifts_s, strict=False):
        assert isinstance(shot.item, RgbdFrame)
        assert shot.item.stamp_ns * 1e-9 - shot.time_s == pytest.approx(shift_s, abs=1e-6)
