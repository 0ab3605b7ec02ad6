# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The ray caster against closed forms and a caster without any culling."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.datasets.synthetic.motion.path import poses_of
from dcgs_ros.datasets.synthetic.raycast import BOX, SPHERE, Scene, cast
from dcgs_ros.datasets.synthetic.scenes.builder import SceneBuilder
from dcgs_ros.datasets.synthetic.textures import (
    MIP_LEVELS,
    TEXTURE_NAMES,
    TEXTURE_SIZE,
    build_textures,
)

CAMERA = PinholeCamera(104, 72, 90.0, 90.0, 51.5, 35.5)  # neither side a multiple of the tile
DEPTH_TOLERANCE_M = 2e-5  # single precision at a few metres


def scene_of(kinds, centres, halves, rotations=None):
    """Plain primitives under one lamp."""
    count = len(kinds)
    if rotations is None:
        rotations = np.tile(np.eye(3), (count, 1, 1))
    return Scene(
        kinds=np.array(kinds, np.int64),
        centres=np.array(centres, np.float64),
        halves=np.array(halves, np.float64),
        R_world_local=rotations,
        textures=np.full(count, -1),
        mappings=np.ones((count, 3), np.float32),
        tints=np.ones((count, 3), np.float32),
        lamp=np.array([0, 0, -1], np.float32),
        ambient=0.5,
    )


def rays():
    """Directions (H, W, 3) with z = 1."""
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    x, y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def pose_of(seed, spread=1.0):
    """Some rigid pose (4, 4)."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    pose[:3, 3] = rng.uniform(-spread, spread, 3)
    return pose


def reference_depth(scene, T_world_cam):
    """Nearest hit over all primitives, in double precision and without any culling."""
    directions = rays() @ T_world_cam[:3, :3].T
    nearest = np.full(directions.shape[:2], np.inf)
    for kind, centre, half, R in zip(
        scene.kinds, scene.centres, scene.halves, scene.R_world_local, strict=True
    ):
        o, d = (T_world_cam[:3, 3] - centre) @ R, directions @ R
        if kind == SPHERE:
            a, b, c = (d * d).sum(-1), d @ o, o @ o - half[0] ** 2
            root = np.sqrt(np.maximum(b * b - a * c, 0))
            s = np.where(b * b > a * c, (-b - root) / a, np.inf)
        else:
            ends = np.stack([(-half - o) / d, (half - o) / d])
            enter, leave = ends.min(0).max(-1), ends.max(0).min(-1)
            s = np.where(enter <= leave, np.where(enter > 0, enter, leave), np.inf)
        nearest = np.where((s > 0.05) & (s < nearest), s, nearest)
    return np.where(np.isfinite(nearest), nearest, 0)


@pytest.mark.parametrize('seed', range(3))
def test_depth_of_a_slanted_plane(seed):
    """A box' face is the plane n x = d: depth is d / (n ray)."""
    R = Rotation.from_rotvec(np.random.default_rng(seed).uniform(-0.4, 0.4, 3)).as_matrix()
    scene = scene_of([BOX], [[0, 0, 2.5]], [[9, 9, 0.5]], R[None])
    view = cast(scene, build_textures(), CAMERA, np.eye(4), color=False)
    normal = R[:, 2]
    expected = (normal[2] * 2.5 - 0.5) / (rays() @ normal)
    np.testing.assert_allclose(view.depth_m, expected, atol=DEPTH_TOLERANCE_M)
    cosine = np.abs(rays() @ normal) / np.linalg.norm(rays(), axis=-1)
    np.testing.assert_allclose(view.cosine, cosine, atol=1e-5)


def test_depth_of_a_sphere():
    """|s ray - c| = r, on the near side; nothing beside the silhouette."""
    centre, radius = np.array([0.2, -0.1, 2.0]), 0.5
    scene = scene_of([SPHERE], [centre], [[radius] * 3])
    depth = cast(scene, build_textures(), CAMERA, np.eye(4), color=False).depth_m
    a, b = (rays() ** 2).sum(-1), rays() @ centre
    root = b * b - a * (centre @ centre - radius**2)
    clear = np.abs(root) > 1e-3  # the silhouette itself may fall to either side
    assert np.array_equal((depth > 0)[clear], (root > 0)[clear])
    seen = clear & (root > 0)
    np.testing.assert_allclose(
        depth[seen], ((b - np.sqrt(np.maximum(root, 0))) / a)[seen], atol=DEPTH_TOLERANCE_M
    )


@pytest.mark.parametrize('seed', range(20))
def test_culling_loses_nothing(seed):
    """Boxes and spheres before, beside and behind the camera, in a room or in the open."""
    rng = np.random.default_rng(seed)
    kinds, centres = rng.integers(0, 2, 40), rng.uniform(-3, 3, (40, 3))
    halves = rng.uniform(0.05, 0.6, (40, 3))
    halves[kinds == SPHERE] = halves[kinds == SPHERE, :1]
    apart = np.linalg.norm(centres, axis=1) > 2  # no thing holds the camera
    kinds, centres, halves = kinds[apart], centres[apart], halves[apart]
    if seed % 2:
        kinds = np.append(kinds, BOX)
        centres, halves = np.vstack([centres, np.zeros(3)]), np.vstack([halves, np.full(3, 6.0)])
    rotations = Rotation.random(len(kinds), random_state=seed).as_matrix()
    scene, pose = scene_of(kinds, centres, halves, rotations), pose_of(seed, spread=0.5)
    depth = cast(scene, build_textures(), CAMERA, pose, color=False).depth_m
    agree = np.abs(depth - reference_depth(scene, pose)) < 1e-3
    assert agree.mean() > 0.999  # silhouettes may round to either side


def test_rigid_motion_of_everything_changes_nothing():
    """Depth and light depend on the relative pose only."""
    rng = np.random.default_rng(3)
    rotations = Rotation.random(9, random_state=3).as_matrix()
    scene = scene_of(
        [BOX] * 9, rng.uniform((-1, -1, 2), (1, 1, 4), (9, 3)), np.full((9, 3), 0.4), rotations
    )
    T = pose_of(5)
    moved = Scene(
        **{
            **vars(scene),
            'centres': scene.centres @ T[:3, :3].T + T[:3, 3],
            'R_world_local': T[:3, :3] @ rotations,
            'lamp': (T[:3, :3] @ scene.lamp + T[:3, 3]).astype(np.float32),
        }
    )
    first = cast(scene, build_textures(), CAMERA, np.eye(4), color=True)
    second = cast(moved, build_textures(), CAMERA, T, color=True)
    close = np.abs(first.depth_m - second.depth_m) < 1e-4
    assert close.mean() > 0.999
    assert np.abs(first.radiance - second.radiance)[close].mean() < 0.05


def test_clearance_is_the_distance_to_surfaces():
    """Outside a box, inside it, and from a sphere."""
    scene = scene_of([BOX], [[0, 0, 0]], [[1, 2, 3]])
    np.testing.assert_allclose(scene.clearance(np.array([[2.0, 0, 0], [0.0, 0, 0]])), [1, 1])
    ball = scene_of([SPHERE], [[0, 0, 0]], [[1, 1, 1]])
    np.testing.assert_allclose(ball.clearance(np.array([[0, 0, 3.0]])), [2])


@pytest.mark.parametrize('texture', range(len(TEXTURE_NAMES)))
def test_mip_levels_keep_the_mean(texture):
    """Each level is the box-filtered one below: the mean stays."""
    textures = build_textures()
    means = []
    for level in range(MIP_LEVELS):
        start, size = textures.starts[texture, level], TEXTURE_SIZE >> level
        texels = textures.texels[start : start + size * size]
        means.append([(texels >> shift & 255).mean() for shift in (0, 8, 16)])
    np.testing.assert_allclose(means, np.tile(means[0], (MIP_LEVELS, 1)), atol=0.2)


def test_rolling_rows_find_what_only_they_have_in_front():
    """A post behind a wall's depth for the middle row, and before it for the last, is not lost."""
    turn = np.deg2rad(40.0)
    build = SceneBuilder()
    build.box((0, 0, 0), (9, 9, 9), None)
    build.box((2.46 * np.cos(turn), 2.46 * np.sin(turn), 0), (0.01, 3, 3), None, yaw=turn)
    build.box((2.55, 0.5, 0), (0.04, 0.06, 3), None)
    scene = build.build((0.0, 0.0, 5.0), 0.5)
    zero = np.zeros(CAMERA.height)
    yaws = np.where(np.arange(CAMERA.height) < 64, 0.0, 40.0)  # a tile border
    rows = poses_of(np.stack([zero, zero, zero, yaws, zero, zero]))
    middle = poses_of(np.zeros((6, 1)))[0]
    rolling = cast(scene, build_textures(), CAMERA, middle, color=False, T_world_rows=rows)
    for y in (0, 36, 71):
        alone = cast(scene, build_textures(), CAMERA, rows[y], color=False).depth_m[y]
        np.testing.assert_allclose(rolling.depth_m[y], alone, atol=1e-4)
    assert rolling.depth_m[71].min() < 2.4
