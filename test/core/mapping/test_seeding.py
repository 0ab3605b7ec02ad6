# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What new Gaussians look like, and where the map lacks some."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.config.stages import MappingConfig
from dcgs_ros.core.kernels.workers import Workers
from dcgs_ros.core.mapping.exposure import Exposure
from dcgs_ros.core.mapping.rectification import Images
from dcgs_ros.core.mapping.seeding import Surface, discs, lacking
from dcgs_ros.core.mapping.splats import SH_C0, Splats
from dcgs_ros.core.render.cpu import CpuRenderer
from dcgs_ros.core.render.renderer import Rendering, View

FLOAT32 = 2e-6
METRES = 2e-3  # depth is kept in half millimetres
PLANE_M = 4e-3  # of a point from the slanted plane, depth being rounded
NORMAL = np.cos(np.radians(3.0))
UNIT_M = 5e-4
WIDTH, HEIGHT, STRIDE = 84, 60, 6
CONFIG = MappingConfig(spawn_stride_px=STRIDE)
NONE = Exposure(np.ones(3, np.float32), np.zeros(3, np.float32))
POSE = se3.exp(np.array([0.3, -0.5, 1.0, 0.4, -0.2, 0.9]))
VIEW = View(WIDTH, HEIGHT, 70.0, 75.0, 40.0, 31.0, POSE)
NOTHING = Surface(
    np.empty((0, 3), np.float32), np.empty((0, 3), np.float32), np.empty(0, np.bool_)
)
EVERYWHERE = np.ones((HEIGHT, WIDTH), np.bool_)


def images(depth_m: NDArray[np.floating] | float, color: NDArray[np.uint8] | int = 128) -> Images:
    depth = np.broadcast_to(np.asarray(depth_m), (HEIGHT, WIDTH))
    full = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    full[...] = color
    return Images(full, np.round(depth / UNIT_M).astype(np.uint16))


def rendering(
    transmittance: NDArray[np.floating] | float, depth_m: NDArray[np.floating] | float = 0.0
) -> Rendering:
    """What the map shows at half the resolution, its depth where it is opaque."""
    planes = np.zeros((5, HEIGHT // 2, WIDTH // 2), np.float32)
    planes[4] = transmittance
    planes[3] = depth_m * (1 - planes[4])
    return Rendering(planes)


def lacks(
    seen: Images, shown: Rendering, valid: NDArray[np.bool_] = EVERYWHERE,
    spawned: Surface = NOTHING, config: MappingConfig = CONFIG, view: View = VIEW,
) -> Surface:  # fmt: skip
    return lacking(seen, shown, 2, valid, spawned, view, config)


def in_camera(points: NDArray[np.floating], view: View = VIEW) -> NDArray[np.float64]:
    T = np.linalg.inv(view.T_world_cam)
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def pixels(points: NDArray[np.floating], view: View = VIEW) -> NDArray[np.float64]:
    p = in_camera(points, view)
    return p[:, :2] / p[:, 2:] * (view.fx, view.fy) + (view.cx, view.cy)


def at(
    u: NDArray[np.floating],
    v: NDArray[np.floating],
    z: NDArray[np.floating] | float,
    view: View = VIEW,
) -> NDArray[np.float32]:
    """World points of pixels at depths."""
    p = np.stack([(u - view.cx) / view.fx * z, (v - view.cy) / view.fy * z, z + 0.0 * u], axis=1)
    return (p @ view.T_world_cam[:3, :3].T + view.T_world_cam[:3, 3]).astype(np.float32)


def surface(
    points: NDArray[np.floating], normals: NDArray[np.floating], measured: bool = True
) -> Surface:
    return Surface(
        points.astype(np.float32), normals.astype(np.float32), np.full(len(points), measured)
    )


def grid() -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    v, u = np.mgrid[STRIDE // 2 : HEIGHT : STRIDE, STRIDE // 2 : WIDTH : STRIDE]
    return u.ravel(), v.ravel()


def third_axes(splats: Splats) -> NDArray[np.float64]:
    w, x, y, z = splats.quats_wxyz.astype(np.float64)
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)


def plane(view: View = VIEW) -> tuple[NDArray[np.floating], NDArray[np.floating], float]:
    """Depth (H, W) of a slanted plane, its normal in the world, towards us, and n . X there."""
    normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    v, u = np.mgrid[: view.height, : view.width]
    rays = np.stack([(u - view.cx) / view.fx, (v - view.cy) / view.fy, np.ones(u.shape)], -1)
    depth_m = -1.5 / (rays @ normal)
    R, t = view.T_world_cam[:3, :3], view.T_world_cam[:3, 3]
    return depth_m, R @ normal, float(-1.5 + R @ normal @ t)


directions = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)
normals = directions.filter(lambda d: bool(np.linalg.norm(d) > 1e-3)).map(
    lambda d: d / np.linalg.norm(d)
)


@settings(max_examples=200, deadline=None)
@given(normals)
def test_the_third_axis_is_the_normal(normal: NDArray[np.floating]) -> None:
    points = at(np.array([20.0]), np.array([10.0]), 1.0)
    made = discs(surface(points, normal[None]), 5, images(1.0), VIEW, NONE, CONFIG)
    limit = 1e-3 if normal[2] < -0.99 else 1e-5  # 1 + z loses digits near half a turn
    np.testing.assert_allclose(third_axes(made)[0], normal, atol=limit)
    assert np.linalg.norm(made.quats_wxyz[:, 0]) == pytest.approx(1.0, abs=FLOAT32)


@pytest.mark.parametrize('tilt', [0.0, 1e-8, -1e-8, 1e-7, 1e-5, 1e-4, 1e-3])
@pytest.mark.parametrize('z', [-1.0, 1.0])
def test_a_normal_along_the_axis_is_no_exception(z: float, tilt: float) -> None:
    """Half a turn from (0, 0, 1) the shortest one is not defined, and nearly so beside it."""
    normal = np.array([[tilt, -0.5 * tilt, z]])
    normal /= np.linalg.norm(normal)
    points = at(np.array([20.0]), np.array([10.0]), 1.0)
    made = discs(surface(points, normal), 5, images(1.0), VIEW, NONE, CONFIG)
    assert np.isfinite(made.planes).all()
    np.testing.assert_allclose(third_axes(made), normal, atol=1e-3)


def test_discs_lie_where_the_points_are_as_opaque_as_configured() -> None:
    u, v = grid()
    points = at(u, v, 1.5)
    facing = np.tile(-POSE[:3, 2], (len(u), 1))
    for measured, opacity in ((True, CONFIG.spawn_opacity), (False, CONFIG.fill_opacity)):
        config = replace(CONFIG, fill_opacity=0.3)
        opacity = opacity if measured else 0.3
        made = discs(surface(points, facing, measured), 6, images(1.5), VIEW, NONE, config)
        np.testing.assert_array_equal(made.means.T, points)
        np.testing.assert_allclose(1 / (1 + np.exp(-made.opacity_logits)), opacity, atol=FLOAT32)


@pytest.mark.parametrize('spacing', [3.0, 7.0])
@pytest.mark.parametrize('z', [0.5, 4.0])
def test_sigma_is_the_spacing_at_the_points_depth(z: float, spacing: float) -> None:
    """Facing the camera: spawn_scale * spacing * z / f, and flatter by spawn_flatness."""
    points = at(np.array([VIEW.cx]), np.array([VIEW.cy]), z)
    made = discs(surface(points, -POSE[None, :3, 2]), spacing, images(z), VIEW, NONE, CONFIG)
    sigma = CONFIG.spawn_scale * spacing * z / (0.5 * (VIEW.fx + VIEW.fy))
    expected = np.log([sigma, sigma, CONFIG.spawn_flatness * sigma])
    np.testing.assert_allclose(made.log_scales[:, 0], expected, atol=1e-5)


def test_discs_seen_at_an_angle_are_wider_but_not_without_end() -> None:
    """By the root of the foreshortening, whichever side the normal is on."""
    points = at(np.full(5, VIEW.cx), np.full(5, VIEW.cy), 1.0)
    cosines = np.array([1.0, 0.5, 0.31, 0.1, 0.0])
    turned = np.outer(cosines, -POSE[:3, 2]) + np.outer(np.sqrt(1 - cosines**2), POSE[:3, 0])
    for side in (1, -1):
        made = discs(surface(points, side * turned), 5, images(1.0), VIEW, NONE, CONFIG)
        ratio = np.exp(made.log_scales[0] - made.log_scales[0, 0])
        np.testing.assert_allclose(ratio[:3], cosines[:3] ** -0.5, rtol=1e-4)
        np.testing.assert_allclose(ratio[3:], 0.3**-0.5, rtol=1e-4)


def test_a_disc_shows_the_image_around_it_once_exposed() -> None:
    color = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    color[:, :42] = (200, 100, 50)
    color[:, 42:] = (20, 240, 130)
    u, v = np.array([20.2, 60.4, 41.5]), np.array([30.0, 29.6, 10.0])
    exposure = Exposure(
        np.array([1.2, 0.8, 1.0], np.float32), np.array([0.1, 0, -0.1], np.float32)
    )
    made = discs(
        surface(at(u, v, 1.0), np.tile(-POSE[:3, 2], (3, 1))), 5, images(1.0, color), VIEW,
        exposure, CONFIG,
    )  # fmt: skip
    shown = exposure.gain[:, None] * (0.5 + SH_C0 * made.sh_dc) + exposure.offset[:, None]
    np.testing.assert_allclose(shown[:, 0], color[0, 0] / 255, atol=FLOAT32)
    np.testing.assert_allclose(shown[:, 1], color[0, -1] / 255, atol=FLOAT32)
    between = np.sort([color[0, 0] / 255, color[0, -1] / 255], axis=0)
    assert ((shown[:, 2] > between[0]) & (shown[:, 2] < between[1])).all()


def test_points_beyond_the_border_take_the_color_at_it() -> None:
    color = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    color[:, -20:], color[-20:] = 255, 255
    points = at(np.array([WIDTH + 5.0, 10.0, -9.0]), np.array([20.0, HEIGHT + 30.0, 5.0]), 1.0)
    made = discs(
        surface(points, np.tile(-POSE[:3, 2], (3, 1))), 3, images(1.0, color), VIEW, NONE, CONFIG
    )
    np.testing.assert_allclose(0.5 + SH_C0 * made.sh_dc[0], [1, 1, 0], atol=FLOAT32)


def test_discs_on_nothing_are_none() -> None:
    made = discs(NOTHING, 5, images(1.0), VIEW, NONE, CONFIG)
    assert made.planes.shape == (14, 0)


def test_discs_on_a_plane_show_that_plane() -> None:
    """Rendered from where they were seen they leave no holes, and their depth is the plane's."""
    depth_m, _, _ = plane()
    found = lacks(images(depth_m), rendering(1.0))
    made = discs(found, STRIDE, images(depth_m, 200), VIEW, NONE, CONFIG)
    seen = CpuRenderer(Workers(1)).render(made.planes, VIEW)
    inner = np.s_[STRIDE:-STRIDE, STRIDE:-STRIDE]
    T = seen.transmittance[inner]
    assert np.median(T) < 0.2 and T.max() < 0.5
    shown_m = seen.depth[inner] / (1 - T)
    assert np.abs(shown_m / depth_m[inner] - 1).max() < 0.03


def test_where_the_map_shows_everything_nothing_is_lacking() -> None:
    assert not len(lacks(images(1.5), rendering(0.0, 1.5)).points)
    just_enough = CONFIG.spawn_transmittance - 0.01
    assert not len(lacks(images(1.5), rendering(just_enough, 1.5)).points)


def test_where_the_map_shows_nothing_each_cell_of_the_grid_gets_a_point() -> None:
    depth_m, normal, offset = plane()
    found = lacks(images(depth_m), rendering(1.0))
    u, v = grid()
    np.testing.assert_allclose(pixels(found.points), np.stack([u, v], axis=1), atol=1e-3)
    np.testing.assert_allclose(found.points @ normal, offset, atol=PLANE_M)
    assert (found.normals @ normal > NORMAL).all()
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1, atol=FLOAT32)
    assert found.measured.all()
    assert found.points.dtype == found.normals.dtype == np.float32


def test_only_the_uncovered_part_lacks_any() -> None:
    through = np.zeros((HEIGHT // 2, WIDTH // 2))
    through[:, : WIDTH // 4] = 1.0
    found = lacks(images(1.5), rendering(through, 1.5))
    assert 0 < len(found.points) and (pixels(found.points)[:, 0] < WIDTH // 2).all()


def test_something_before_what_the_map_shows_is_lacking() -> None:
    """Not what is nearer by the noise only, nor what is farther: that is hidden."""
    for z, lacking_ in ((0.8, True), (1.46, False), (1.5, False), (3.0, False)):
        found = lacks(images(z), rendering(0.1, 1.5))
        assert (len(found.points) > 0) == lacking_, z


def test_pixels_that_do_not_count_spawn_nothing() -> None:
    valid = EVERYWHERE.copy()
    valid[:30] = False
    found = lacks(images(1.5), rendering(1.0), valid)
    assert 0 < len(found.points) and (pixels(found.points)[:, 1] > 29).all()


def test_cells_that_the_tracker_spawned_in_get_no_other() -> None:
    u, v = grid()
    rng = np.random.default_rng(1)
    taken = rng.random(len(u)) < 0.4
    inside = rng.uniform(-STRIDE / 2 + 0.01, STRIDE / 2 - 0.01, (2, taken.sum()))
    points = at(u[taken] + inside[0], v[taken] + inside[1], 0.9)
    spawned = surface(points, np.tile(-POSE[:3, 2], (len(points), 1)))
    found = lacks(images(1.5), rendering(1.0), spawned=spawned)
    expected = np.stack([u, v], axis=1)[~taken]
    np.testing.assert_allclose(pixels(found.points), expected, atol=1e-3)


def test_spawned_points_outside_the_image_take_no_cell() -> None:
    points = at(np.array([-20.0, 500.0, 40.0]), np.array([30.0, 30.0, -70.0]), 1.0)
    spawned = surface(points, np.tile(-POSE[:3, 2], (3, 1)))
    found = lacks(images(1.5), rendering(1.0), spawned=spawned)
    assert len(found.points) == len(grid()[0])


def test_holes_get_the_depth_beside_them_and_face_the_camera() -> None:
    depth_m = np.full((HEIGHT, WIDTH), 1.0)
    depth_m[:, WIDTH // 2 :] = 2.0
    hole = np.zeros((HEIGHT, WIDTH), np.bool_)
    hole[20:44, 10:30] = hole[20:44, 60:76] = True
    found = lacks(images(np.where(hole, 0.0, depth_m)), rendering(1.0))
    u, v = np.round(pixels(found.points)).astype(int).T
    assert len(u) == len(grid()[0])
    np.testing.assert_array_equal(found.measured, ~hole[v, u])
    np.testing.assert_allclose(in_camera(found.points)[:, 2], depth_m[v, u], atol=METRES)
    filled = ~found.measured
    towards = POSE[:3, 3] - found.points[filled]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    np.testing.assert_allclose(found.normals[filled], towards, atol=1e-5)


def test_an_image_without_any_depth_spawns_nothing() -> None:
    assert not len(lacks(images(0.0), rendering(1.0)).points)


def test_a_few_pixels_of_depth_are_enough_to_fill_the_others() -> None:
    depth_m = np.zeros((HEIGHT, WIDTH))
    depth_m[1::4, 2::4] = 1.3
    found = lacks(images(depth_m), rendering(1.0))
    assert len(found.points) == len(grid()[0])


def test_points_at_an_edge_face_the_camera() -> None:
    depth_m = np.full((HEIGHT, WIDTH), 1.0)
    depth_m[:, 40:] = 2.0
    found = lacks(images(depth_m), rendering(1.0))
    near_edge = np.abs(pixels(found.points)[:, 0] - 39.5) < 3
    assert near_edge.any()
    towards = POSE[:3, 3] - found.points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    np.testing.assert_allclose(found.normals[near_edge], towards[near_edge], atol=1e-5)


@pytest.mark.parametrize('stride', [1, 2, 3, 5, 64])
@pytest.mark.parametrize('size', [(16, 16), (17, 16), (31, 33), (83, 61)])
def test_any_stride_fits_any_image(stride: int, size: tuple[int, int]) -> None:
    width, height = size
    view = replace(VIEW, width=width, height=height)
    seen = Images(
        np.zeros((height, width, 3), np.uint8), np.full((height, width), 2000, np.uint16)
    )
    shown = Rendering(np.ones((5, height // 2, width // 2), np.float32))
    valid = np.ones((height, width), np.bool_)
    config = replace(CONFIG, spawn_stride_px=stride)
    found = lacks(seen, shown, valid, config=config, view=view)
    assert len(found.points) == (width // stride) * (height // stride)
    np.testing.assert_allclose(in_camera(found.points)[:, 2], 1.0, atol=METRES)
