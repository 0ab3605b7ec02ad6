# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The scenes show what they are for."""

import numpy as np
import pytest

from dcgs_ros.datasets.source import SourceError
from dcgs_ros.datasets.synthetic.raycast import cast
from dcgs_ros.datasets.synthetic.scenes.movers import MOVERS
from dcgs_ros.datasets.synthetic.source import SyntheticSource
from dcgs_ros.datasets.synthetic.textures import build_textures

LUMA = np.array([0.299, 0.587, 0.114], np.float32)


def open_source(address):
    """Open a synthetic address."""
    return SyntheticSource.from_address(f'synthetic:{address}')


def planes_in_view(source, index):
    """Share of the image that the plane with the most pixels takes, by normal and distance."""
    depth = source._see(index).depth_m
    camera = source.camera
    v, u = np.mgrid[0:480:4, 0:640:4]
    z = depth[v, u]
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], -1)
    across, down = points[:-1, 1:] - points[:-1, :-1], points[1:, :-1] - points[:-1, :-1]
    normals = np.cross(across, down)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    middle = normals[normals.shape[0] // 2, normals.shape[1] // 2]
    return (normals @ middle > 0.995).mean()


@pytest.mark.parametrize('seed', range(2))
def test_desk_tilts_fast_to_one_plane_then_to_a_dim_wall(seed):
    """From clutter to tiles alone in under a second; the wall is dark and far behind the board."""
    source = open_source(f'desk?frames=720&seed={seed}')
    pitch = np.rad2deg(np.arcsin(source.groundtruth.T_world_cam[:, 2, 2]))
    rates = np.abs(np.diff(pitch)) * 30
    assert 100 < rates[180:210].max() < 200 and rates[:150].max() < 40
    assert planes_in_view(source, 100) < 0.7 and planes_in_view(source, 225) > 0.97
    desk, wall = (source._see(k) for k in (100, 500))
    assert (wall.radiance @ LUMA).mean() < 0.7 * (desk.radiance @ LUMA).mean()
    near = wall.depth_m < 1.3
    assert 0.1 < near.mean() < 0.7 and np.median(wall.depth_m[~near]) > 1.8


def test_desk_repeats_with_its_cycle():
    """24 s later the same turns come again."""
    poses = open_source('desk?frames=1500').groundtruth.T_world_cam
    for frame in (225, 500):
        assert poses[frame, :3, 2] @ poses[frame + 720, :3, 2] > np.cos(np.deg2rad(35))


def test_floor_of_the_ring_repeats_with_its_period():
    """One period further along, the floor looks the same; with period 0 it does not."""
    camera = open_source('ring').camera
    down = np.eye(4)
    down[:3, :3] = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]).T  # looking at the floor
    for period, low, high in ((0.8, 0.98, 1.0), (0.0, -0.5, 0.5)):
        scene = open_source(f'ring?period={period}')._scenario.scene
        images = []
        for x in (-2.3, -2.3 + 2 * (period or 0.8)):
            down[:3, 3] = x, -5.0, 1.2
            view = cast(scene, build_textures(), camera, down, color=True)
            assert np.median(view.depth_m) == pytest.approx(1.196, abs=1e-3)
            images.append((view.radiance @ LUMA)[100:380, 200:440])
        images = [image - np.mean(image) for image in images]
        assert low < np.corrcoef(images[0].ravel(), images[1].ravel())[0, 1] <= high


@pytest.mark.slow
@pytest.mark.parametrize('address', ['desk', 'corridor', 'ring', 'ring?period=0.6&direction=cw'])
def test_new_scenes_have_depth_and_holes(address):
    """A D435i sees half to two thirds of each, over what comes in 90 s."""
    source = open_source(f'{address}{"&" if "?" in address else "?"}frames=2700')
    assert source.options.sensor == 'd435i_measured'
    holes = [(source._depth(k) == 0).mean() for k in range(40, 2700, 190)]
    assert 0.3 < np.mean(holes) < 0.55


@pytest.mark.parametrize(
    ('address', 'named'),
    [
        ('desk?motion=wheeled', "desk has no motion 'wheeled': handheld"),
        ('ring?motion=flying', 'wheeled or handheld'),
        ('room?period=1', 'room has no period: only ring has'),
        ('corridor?direction=cw', 'corridor has no direction: only ring has'),
        ('ring?direction=up', "unknown direction 'up': one of ccw, cw"),
        ('ring?period=-1', '0.0 to 10.0'),
        ('ring?light=0', '0.01 to 10'),
        ('ring?light=dim', 'number'),
    ],
)
def test_what_a_scene_lacks_is_refused(address, named):
    """With what it has."""
    with pytest.raises(SourceError, match=named):
        open_source(address)


@pytest.mark.parametrize('mover', MOVERS)
def test_a_mover_crosses_the_view_of_the_room_and_leaves_it_as_it_was(mover):
    """It covers a part of the image, at its distance, and moves; the room is the same without."""
    address = 'room?sensor=ideal&speed=0.5'
    source, empty = open_source(f'{address}&mover={mover}'), open_source(address)
    covered = []
    for index in (40, 60, 170):
        with_it, without = (one._see(index).depth_m for one in (source, empty))
        differs = with_it < without - 0.05
        assert (with_it[~differs] > without[~differs] - 0.05).all()
        covered.append(differs)
    assert 0.05 < covered[1].mean() < 0.5
    assert (covered[0] ^ covered[2]).mean() > 0.03
    if mover != 'door':  # that stays, open
        assert not covered[2].any()


def test_a_box_stands_for_two_seconds_and_a_person_walks_a_metre_a_second():
    """So they move, whatever the seed and the speed of the camera are."""
    source = open_source('room?mover=box&seed=1')
    second = 1_000_000_000
    start = next(source.imu()).stamp_ns + second // 10
    centres = [
        source.scene_at(start + round(t * second)).centres[-1] for t in (1.0, 1.7, 3.5, 4.5)
    ]
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    np.testing.assert_allclose(steps, [0.48, 0.0, 0.72], atol=1e-9)
    walker = open_source('room?mover=person&speed=2')
    heads = [walker.scene_at(start + round(t * second)).centres[-1] for t in (1.0, 2.0, 3.0)]
    np.testing.assert_allclose(np.linalg.norm(np.diff(heads, axis=0), axis=1), 1.0, atol=1e-9)
    assert len(walker.scene_at(start + 9 * second).kinds) == len(walker.scene.kinds)


def test_only_the_room_has_movers():
    """Elsewhere walls would be in their way."""
    with pytest.raises(SourceError, match='only room has'):
        open_source('corridor?mover=person')
    with pytest.raises(SourceError, match='person, door, box'):
        open_source('room?mover=cat')
