# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""ICL-NUIM folders: depth first, frame numbers for stamps, mirrored ground truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import folders  # type: ignore[import-not-found]
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.sensor import SensorNoise
from dcgs_ros.datasets.camera_presets import PRESETS
from dcgs_ros.datasets.icl_nuim import is_icl_nuim, mirrored, open_icl_nuim
from dcgs_ros.datasets.images.indexed_frames import stamp_of_index
from dcgs_ros.datasets.source import SourceError

SMALL = '60,61,31.5,23.5'  # intrinsics of the 64x48 images
FLOAT32_STEP = 1e-6  # metres, at a few metres
PIXEL_TOLERANCE = 1e-9
TRUTH = '1 0 0 -2.25 0 0 0 1\n2 0.1 0.2 -2.25 0.6 0 0 0.8\n4 0 0 0 0 0.6 0 0.8\n'


@pytest.fixture
def living_room(tmp_path: Path) -> Path:
    return folders.write_icl_nuim(tmp_path / 'living_room_traj2_frei_png', range(5), TRUTH)


def test_frames_are_what_was_written(living_room: Path) -> None:
    assert is_icl_nuim(living_room)
    source = open_icl_nuim(living_room, SMALL)
    assert source.sensor == PRESETS['icl_nuim'].sensor
    for k, frame in enumerate(folders.good_frames(source)):
        assert frame.stamp_ns == frame.depth_stamp_ns == stamp_of_index(k)
        np.testing.assert_array_equal(frame.color, folders.color_of(k))
        np.testing.assert_allclose(frame.depth_m, 1 + 0.1 * k, atol=FLOAT32_STEP)


def test_truth_goes_with_the_frames_of_its_numbers(living_room: Path) -> None:
    truth = open_icl_nuim(living_room).groundtruth
    assert truth is not None
    assert truth.stamps_ns.tolist() == [stamp_of_index(1), stamp_of_index(2), stamp_of_index(4)]
    np.testing.assert_allclose(truth.T_world_cam[0, :3, 3], [0, 0, -2.25])
    np.testing.assert_allclose(truth.T_world_cam[1, :3, 3], [0.1, -0.2, -2.25])  # y down


def project(
    points_world: NDArray[np.float64], T_world_cam: NDArray[np.float64], fy: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return pixels (N, 2) and depths (N,) of points (N, 3)."""
    p = (points_world - T_world_cam[:3, 3]) @ T_world_cam[:3, :3]
    z = p[:, 2]
    return np.stack([481.2 * p[:, 0] / z + 319.5, fy * p[:, 1] / z + 239.5], axis=1), z


TWISTS = st.lists(st.floats(-2, 2), min_size=6, max_size=6).map(np.array)


@given(TWISTS, st.integers(0, 2**32 - 1))
def test_the_mirrored_camera_sees_the_mirrored_world_as_before(
    twist: NDArray[np.float64], seed: int
) -> None:
    T_world_cam = se3.exp(twist)
    rng = np.random.default_rng(seed)
    p_cam = np.column_stack([rng.uniform(-1, 1, (20, 2)), rng.uniform(1, 4, 20)])
    points = p_cam @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
    pixels, depths = project(points, T_world_cam, -480.0)
    again, depths_again = project(points * [1, -1, 1], mirrored(T_world_cam), 480.0)
    np.testing.assert_allclose(again, pixels, atol=1e3 * PIXEL_TOLERANCE)
    np.testing.assert_allclose(depths_again, depths, atol=PIXEL_TOLERANCE)


@given(TWISTS)
def test_mirroring_keeps_rotations_and_undoes_itself(twist: NDArray[np.float64]) -> None:
    T = se3.exp(twist)
    assert np.linalg.det(mirrored(T)[:3, :3]) == pytest.approx(1)
    np.testing.assert_array_equal(mirrored(mirrored(T)), T)


def test_the_noisy_variant_has_a_kinects_noise(tmp_path: Path) -> None:
    folder = folders.write_icl_nuim(tmp_path / 'living_room_traj0n_frei_png', [0], None)
    source = open_icl_nuim(folder)
    assert source.sensor == SensorNoise.structured_light()
    assert source.camera == PRESETS['icl_nuim'].camera
    assert source.groundtruth is None


def test_no_tum_folder_is_one(tmp_path: Path, tum_folder: Callable[..., Path]) -> None:
    folder = tum_folder()
    assert not is_icl_nuim(folder)
    (folder / 'associations.txt').write_text('100.0 rgb/0.png 100.005 depth/0.png\n')
    assert not is_icl_nuim(folder)
    assert not is_icl_nuim(tmp_path / 'traj0_frei_png')


def test_the_truth_tells_it_under_any_name(living_room: Path) -> None:
    other = living_room.rename(living_room.parent / 'kitchen')
    assert is_icl_nuim(other)
    (other / 'associations.txt').unlink()
    assert not is_icl_nuim(other)


def test_a_given_truth_is_mirrored_only_if_it_is_icl_nuims(living_room: Path) -> None:
    own = (living_room / 'livingRoom2.gt.freiburg').rename(living_room.parent / 'x.gt.freiburg')
    other = own.with_name('other.txt')
    other.write_text(TRUTH)
    native, seconds = (
        open_icl_nuim(living_room, SMALL, path).groundtruth for path in (own, other)
    )
    assert native is not None
    assert seconds is not None
    assert seconds.stamps_ns.tolist() == [1_000_000_000, 2_000_000_000, 4_000_000_000]
    np.testing.assert_array_equal(native.T_world_cam, mirrored(seconds.T_world_cam))


def test_two_truths_are_one_too_many(living_room: Path) -> None:
    (living_room / 'traj2.gt.freiburg').write_text(TRUTH)
    with pytest.raises(SourceError, match=r'which of livingRoom2\.gt\.freiburg, traj2\.gt'):
        open_icl_nuim(living_room)


def test_rows_may_be_in_any_order_and_repeated(living_room: Path) -> None:
    path = living_room / 'associations.txt'
    before = open_icl_nuim(living_room, SMALL).pairs
    rows = path.read_text().splitlines()
    path.write_text('\n'.join([*reversed(rows), rows[0]]))
    assert list(open_icl_nuim(living_room, SMALL).pairs) == list(before)


@pytest.mark.parametrize(
    ('line', 'reason'),
    [
        ('5 depth/5.png', 'txt:6: 2 columns'),
        ('5 ../5.png 5 rgb/5.png', 'txt:6: .*leads out'),
        ('5 depth/\0.png 5 rgb/5.png', 'txt:6: .*not a path'),
        ('5.5 depth/5.png 6 rgb/5.png', 'txt: 5.5 is not a frame number'),
        ('1e300 depth/5.png 6 rgb/5.png', 'txt:6: .*no usable time'),
    ],
)
def test_a_bad_row_is_named(living_room: Path, line: str, reason: str) -> None:
    with (living_room / 'associations.txt').open('a') as file:
        file.write(line + '\n')
    with pytest.raises(SourceError, match=reason):
        open_icl_nuim(living_room)


def test_no_mutant_of_its_files_does_harm(living_room: Path) -> None:
    for name in ('associations.txt', 'livingRoom2.gt.freiburg'):
        path = living_room / name
        whole = path.read_bytes()
        damaged = folders.mutants(whole, 200, seed=3)
        folders.survives(path, damaged, lambda: open_icl_nuim(living_room, SMALL))
        path.write_bytes(whole)
