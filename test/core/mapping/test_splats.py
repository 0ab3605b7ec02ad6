# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What the planes of a Gaussian stand for, and the shape of its covariance."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dcgs_ros.core.mapping.splats import PLANES, SH_C0, SplatError, Splats

SHAPE = 2e-5  # float32, relative
COUNT = 200


def random_splats(seed: int, count: int = COUNT) -> Splats:
    planes = np.random.default_rng(seed).normal(size=(len(PLANES), count)).astype(np.float32)
    return Splats(planes)


def covariances(splats: Splats) -> NDArray[np.float64]:
    """Sigma_r (N, 3, 3) = R S^2 R^T by SciPy's rotations."""
    xyzw = np.roll(splats.quats_wxyz.T.astype(np.float64), -1, axis=1)
    R = Rotation.from_quat(xyzw).as_matrix()
    variances = np.exp(2.0 * splats.log_scales.T.astype(np.float64))
    return np.asarray(np.einsum('nij,nj,nkj->nik', R, variances, R))


def test_the_parts_are_views_that_share_out_the_planes_by_name() -> None:
    splats = random_splats(0)
    parts = {
        'means': ('x', 'y', 'z'),
        'log_scales': ('scale_0', 'scale_1', 'scale_2'),
        'quats_wxyz': ('rot_0', 'rot_1', 'rot_2', 'rot_3'),
        'opacity_logits': ('opacity',),
        'sh_dc': ('f_dc_0', 'f_dc_1', 'f_dc_2'),
    }
    assert sum(parts.values(), ()) == PLANES
    for name, planes in parts.items():
        part = getattr(splats, name)
        rows = [PLANES.index(plane) for plane in planes]
        np.testing.assert_array_equal(np.atleast_2d(part), splats.planes[rows])
        assert np.shares_memory(part, splats.planes)
    assert len(splats) == COUNT


def test_the_constant_is_that_of_the_first_spherical_harmonic() -> None:
    assert pytest.approx(0.5 / np.sqrt(np.pi), rel=1e-15) == SH_C0


@pytest.mark.parametrize(
    'planes',
    [
        np.zeros((13, 4), np.float32),
        np.zeros((15, 4), np.float32),
        np.zeros(14, np.float32),
        np.zeros((14, 2, 2), np.float32),
        np.zeros((14, 4)),
        np.zeros((14, 4), np.float16),
        np.zeros((14, 4), np.int32),
    ],
    ids=lambda planes: f'{planes.dtype}{planes.shape}',
)
def test_other_arrays_are_refused_with_what_they_are(planes: NDArray[np.floating]) -> None:
    told = (
        str(planes.dtype) if planes.shape == (14, 4) else r'\(' + ', '.join(map(str, planes.shape))
    )
    with pytest.raises(SplatError, match=told):
        Splats(planes)


def test_normal_and_flatness_are_those_of_the_covariance() -> None:
    """The axis of the least eigenvalue, and lambda3 / lambda2; quaternions of any length."""
    splats = random_splats(1)
    splats.quats_wxyz[...] *= 10.0 ** np.linspace(-5, 5, COUNT)
    values, vectors = np.linalg.eigh(covariances(splats))
    normals, flatness = splats.shape(np.arange(COUNT))
    cosines = np.abs(np.einsum('ni,ni->n', normals, vectors[:, :, 0]))
    distinct = values[:, 0] < 0.9 * values[:, 1]  # else the axis is ill defined
    assert distinct.sum() > COUNT / 2
    np.testing.assert_allclose(cosines[distinct], 1.0, atol=SHAPE)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=SHAPE)
    np.testing.assert_allclose(flatness, values[:, 0] / values[:, 1], rtol=SHAPE)


def test_the_shape_of_some_is_that_of_all_at_their_columns() -> None:
    splats, columns = random_splats(2), np.array([7, 3, 3, 150])
    normals, flatness = splats.shape(np.arange(COUNT))
    some_normals, some_flatness = splats.shape(columns)
    np.testing.assert_array_equal(some_normals, normals[columns])
    np.testing.assert_array_equal(some_flatness, flatness[columns])
    none, nothing = splats.shape(np.empty(0, np.int64))
    assert none.shape == (0, 3) and nothing.shape == (0,)


def test_a_ball_has_flatness_one_and_a_sheet_none() -> None:
    planes = np.zeros((len(PLANES), 2), np.float32)
    planes[6] = 1.0
    planes[5, 1] = -50.0
    normals, flatness = Splats(planes).shape(np.arange(2))
    assert flatness[0] == 1.0 and flatness[1] == pytest.approx(0.0, abs=1e-30)
    np.testing.assert_array_equal(np.abs(normals[1]), [0, 0, 1])


def test_a_quaternion_and_its_negative_are_one_rotation() -> None:
    splats = random_splats(3)
    normals, flatness = splats.shape(np.arange(COUNT))
    splats.quats_wxyz[...] *= -1
    same, as_flat = splats.shape(np.arange(COUNT))
    np.testing.assert_array_equal(same, normals)
    np.testing.assert_array_equal(as_flat, flatness)
