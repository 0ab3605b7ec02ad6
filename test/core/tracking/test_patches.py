# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Patches are found where they are, as their surface is seen now, and nowhere else."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.tracking.patches import SIDE, Patches, cut

PINHOLE = PinholeCamera(320, 240, 262.0, 262.0, 159.5, 119.5)
DISTORTED = PinholeCamera(
    320, 240, 258.6, 258.2, 159.3, 127.6, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
)
STILL = np.eye(4)
WALL_M = 1.5
FACING = np.array([0.0, 0.0, -1.0])
ALIGNED_PX = 0.05
SHIFTED_PX = 0.1  # with an image that OpenCV shifts in steps of 1/32 pixel and rounds
SEEN_PX = 0.15  # between an image and another view of it, both interpolated and rounded
REACH_PX = 5.0
ALIKE, UNLIKE = 0.97, 0.6  # correlation with the same place, and with another
PLACES = np.array([[x, y] for x in range(60, 280, 20) for y in range(50, 200, 20)], np.float32)


def texture(seed: int, size: tuple[int, int] = (240, 320)) -> NDArray[np.uint8]:
    """Smooth noise: every place is unlike every other."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=size), (0, 0), 2.5)
    return np.clip(120 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)


def lifted(camera: PinholeCamera, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
    """The points of a facing wall (N, 3)."""
    rays = camera.undistort(np.asarray(pixels, np.float32)).astype(np.float64)
    return np.column_stack([rays, np.ones(len(pixels))]) * WALL_M


def of(
    image: NDArray[np.uint8],
    pixels: NDArray[np.float32] = PLACES,
    camera: PinholeCamera = PINHOLE,
    T_world_cam: NDArray[np.float64] = STILL,
) -> Patches:
    points = lifted(camera, pixels)
    return cut(image, pixels, points[:, 2], np.tile(FACING, (len(pixels), 1)), T_world_cam, camera)


def view(
    image: NDArray[np.uint8], T_wall_cam: NDArray[np.float64], camera: PinholeCamera = PINHOLE
) -> NDArray[np.uint8]:
    """How a camera sees the wall that `image` shows to one at the origin."""
    rays = np.concatenate([camera.undistortion_map, np.ones((240, 320, 1), np.float32)], axis=2)
    turned = rays.astype(np.float64).reshape(-1, 3) @ T_wall_cam[:3, :3].T
    scale = (WALL_M - T_wall_cam[2, 3]) / turned[:, 2]
    source = camera.project(turned * scale[:, None] + T_wall_cam[:3, 3]).reshape(240, 320, 2)
    return cv2.remap(  # type: ignore[no-any-return]
        image, source.astype(np.float32), None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )


def seen_from(
    points: NDArray[np.float64], T_world_cam: NDArray[np.float64]
) -> NDArray[np.float64]:
    return np.asarray(se3.transform(se3.inverse(T_world_cam), points), np.float64)


@pytest.mark.parametrize('shift', [(0.0, 0.0), (0.4, -0.3), (-1.3, 0.8), (1.5, -1.5)])
def test_a_shift_of_parts_of_a_pixel_is_found(shift: tuple[float, float]) -> None:
    image = texture(1)
    matrix = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]]])
    grey = cv2.warpAffine(image, matrix, (320, 240), flags=cv2.INTER_CUBIC).astype(np.uint8)
    at, correlation = of(image).aligned(
        grey, PLACES, lifted(PINHOLE, PLACES), STILL, PINHOLE, REACH_PX
    )
    errors = np.linalg.norm(at - PLACES - np.array(shift), axis=1)
    assert np.median(errors) < SHIFTED_PX
    assert np.mean((errors < 3 * SHIFTED_PX) & (correlation > ALIKE)) > 0.85


def test_a_search_ends_beyond_its_reach() -> None:
    image = texture(1)
    matrix = np.array([[1.0, 0.0, 2.5], [0.0, 1.0, 0.0]])
    grey = cv2.warpAffine(image, matrix, (320, 240), flags=cv2.INTER_CUBIC).astype(np.uint8)
    points = lifted(PINHOLE, PLACES)
    arrived, _ = of(image).aligned(grey, PLACES, points, STILL, PINHOLE, 4.0)
    ended, _ = of(image).aligned(grey, PLACES, points, STILL, PINHOLE, 0.5)
    assert np.median(np.abs(arrived - PLACES - [2.5, 0.0])) < SHIFTED_PX
    assert np.median(ended[:, 0] - PLACES[:, 0]) < 2.5 - SHIFTED_PX
    assert np.all(np.abs(ended - PLACES).max(axis=1)[arrived[:, 0] > PLACES[:, 0] + 2.0] > 0.5)


@pytest.mark.parametrize(('gain', 'offset'), [(1.0, 30.0), (0.5, 0.0), (0.4, 90.0), (1.3, -40.0)])
def test_light_and_exposure_do_not_matter(gain: float, offset: float) -> None:
    image = texture(2)
    grey = np.clip(np.round(gain * image.astype(float) + offset), 0, 255).astype(np.uint8)
    start = PLACES + np.array([0.8, -0.6], np.float32)
    at, correlation = of(image).aligned(
        grey, start, lifted(PINHOLE, PLACES), STILL, PINHOLE, REACH_PX
    )
    errors = np.linalg.norm(at - PLACES, axis=1)
    assert np.mean((errors < 2 * ALIGNED_PX) & (correlation > ALIKE)) > 0.9


@pytest.mark.parametrize('camera', [PINHOLE, DISTORTED], ids=['pinhole', 'distorted'])
@pytest.mark.parametrize(
    'twist',
    [
        (0, 0, 0, 0, 0, 0.7),  # about the optical axis
        (0, 0, 0.5, 0, 0, 0),  # nearer
        (0, 0, -0.7, 0, 0, 0),  # farther
        (0.7, 0, 0.1, 0, -0.5, 0.2),  # from the side
    ],
    ids=['rolled', 'nearer', 'farther', 'aside'],
)
@pytest.mark.parametrize('born', [STILL, se3.exp(np.array([0.4, -0.3, 0.2, 0.3, -0.8, 0.5]))])
def test_a_patch_is_warped_as_the_pose_says(
    camera: PinholeCamera, twist: tuple[float, ...], born: NDArray[np.float64]
) -> None:
    """Wherever the world's axes are; a patch that is not warped is not found."""
    image, T = texture(3), se3.exp(np.array(twist, np.float64))
    points = lifted(camera, PLACES)
    seen = seen_from(points, T)
    pixels = camera.project(seen).astype(np.float32)
    kept = np.all((pixels > 20) & (pixels < (300, 220)), axis=1)
    patches, start = of(image, camera=camera, T_world_cam=born)[kept], pixels[kept] + 0.5
    grey = view(image, T, camera)
    at, correlation = patches.aligned(grey, start, seen[kept], born @ T, camera, REACH_PX)
    errors = np.linalg.norm(at - pixels[kept], axis=1)
    assert kept.sum() > 15
    assert np.median(errors) < SEEN_PX
    assert np.mean((errors < 3 * SEEN_PX) & (correlation > 0.9)) > 0.85
    _, unwarped = patches.aligned(grey, start, points[kept], born, camera, REACH_PX)
    assert np.median(correlation) > np.median(unwarped) + 0.03


@pytest.mark.parametrize('axis', [0, 1])
def test_a_search_ends_where_it_has_gone_too_far(axis: int) -> None:
    """It ends beyond its reach, so that it shows: not at the place, and not where it began."""
    image = texture(10)
    start = PLACES.copy()
    start[:, axis] += 1.6
    patches, points = of(image), lifted(PINHOLE, PLACES)
    far, _ = patches.aligned(image, start, points, STILL, PINHOLE, REACH_PX)
    near, _ = patches.aligned(image, start, points, STILL, PINHOLE, 0.5)
    reached = np.linalg.norm(far - PLACES, axis=1) < ALIGNED_PX
    assert np.mean(reached) > 0.7
    moved = np.abs(near - start).max(axis=1)[reached]
    assert (moved > 0.5).all()
    steps = np.abs(far - near)[reached].max(axis=1)
    assert np.median(steps) > ALIGNED_PX  # it did not go on to the end


def test_another_texture_does_not_correlate() -> None:
    patches, points = of(texture(4)), lifted(PINHOLE, PLACES)
    for grey in (texture(5), 255 - texture(4)):
        _, correlation = patches.aligned(grey, PLACES, points, STILL, PINHOLE, REACH_PX)
        assert np.mean(correlation > UNLIKE) < 0.3
        assert (np.abs(correlation) <= 1.0 + 1e-6).all()


def test_what_reaches_out_of_the_image_is_not_aligned() -> None:
    """A patch that is seen twice as large does so sooner."""
    image = texture(6)
    edge = np.array([[3, 120], [316, 120], [160, 3], [160, 236], [-5, 9], [np.nan, 9]], np.float32)
    near = np.array([[9, 120], [310, 120], [160, 9], [160, 230], [9, 9], [310, 230]], np.float32)
    for pixels, expected in ((edge, False), (near, True)):
        points = lifted(PINHOLE, np.nan_to_num(pixels))
        facing = np.tile(FACING, (len(pixels), 1))
        patches = cut(image, np.nan_to_num(pixels), points[:, 2], facing, STILL, PINHOLE)
        _, correlation = patches.aligned(image, pixels, points, STILL, PINHOLE, REACH_PX)
        assert ((correlation > ALIKE) == expected).all()
        assert expected or (correlation == -1.0).all()
        closer = points * 0.4
        _, correlation = patches.aligned(image, pixels, closer, STILL, PINHOLE, REACH_PX)
        assert (correlation == -1.0).all()


def test_what_has_no_texture_is_not_aligned() -> None:
    flat = np.full((240, 320), 90, np.uint8)
    edge = flat.copy()
    speck = flat.copy()
    speck[118:120, 159:161] += 1  # rounding makes as much
    edge[:, 160:] = 180  # one direction is not held
    edge = cv2.GaussianBlur(edge, (5, 5), 1.0).astype(np.uint8)
    pixels = np.array([[160.0, 120.0]], np.float32)
    for image in (flat, speck, edge):
        at, correlation = of(image, pixels).aligned(
            texture(7), pixels, lifted(PINHOLE, pixels), STILL, PINHOLE, REACH_PX
        )
        assert correlation.tolist() == [-1.0]
        np.testing.assert_array_equal(at, pixels)


def test_a_step_in_the_patch_is_a_pixel_on_its_surface() -> None:
    """Slanted by 40 degrees, in a world with other axes; a grazing one is taken as facing."""
    born = se3.exp(np.array([0.4, -0.3, 0.2, 0.3, -0.8, 0.5]))
    places = PLACES[np.abs(PLACES[:, 0] - 160) < 50]
    points = lifted(PINHOLE, places)
    slanted = np.array([np.sin(0.7), 0.0, -np.cos(0.7)])
    grazing = np.array([1.0, 0.0, -0.05])
    for normal in (slanted, grazing / np.linalg.norm(grazing)):
        normals = np.tile(normal, (len(places), 1))
        patches = cut(texture(8), places, points[:, 2], normals, born, PINHOLE)
        tangents = patches.steps.astype(np.float64) @ born[:3, :3]
        for k, step in enumerate(np.eye(2)):
            there = points + tangents[:, k]
            np.testing.assert_allclose(PINHOLE.project(there), places + step, atol=1e-3)
        if normal is slanted:
            np.testing.assert_allclose(tangents @ normal, 0.0, atol=1e-6)
        else:
            assert np.linalg.norm(tangents, axis=2).max() < 1.2 * WALL_M / PINHOLE.fx


def test_patches_are_chosen_and_joined() -> None:
    patches = of(texture(9))
    first, rest = patches[np.arange(3)], patches[np.arange(len(PLACES)) >= 3]
    both = first.joined(rest)
    np.testing.assert_array_equal(both.grey, patches.grey)
    np.testing.assert_array_equal(both.steps, patches.steps)
    none = Patches.none()
    assert none.grey.shape == (0, SIDE, SIDE) and none.joined(first).grey.shape == first.grey.shape
