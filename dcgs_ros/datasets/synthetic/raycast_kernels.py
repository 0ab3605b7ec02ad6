# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Kernels of the ray caster, all in one file, as Numba's cache does not track other files.

Scalars are float32; a ray is (x/z, y/z, 1), so a hit's distance along it is its depth in metres.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

BOX, SPHERE = 0, 1
_TILE = 16  # pixels; a multiple of the vector width, small enough to cull well
NEAR_M = 0.05
FAR = np.float32(1e9)
_BACKGROUND = np.float32(20.0)  # grey level where a ray meets nothing
_PLAIN = np.float32(190.0)  # grey level of surfaces without a texture


@njit(cache=True, nogil=True, fastmath=True, inline='always')
def _box_slab(o, d, half):
    """Return where a ray o + s d, scalars of one axis, enters and leaves -half to half."""
    d = d if abs(d) > np.float32(1e-9) else np.float32(1e-9)
    inverse = np.float32(1.0) / d
    first = (-half - o) * inverse
    second = (half - o) * inverse
    return min(first, second), max(first, second)


@njit(cache=True, nogil=True, fastmath=True)
def _meet_box(row_x, dy, o, R, half, prim, best, hit):
    """Update the nearest hits of one row of a tile with a box, without branches, to vectorise.

    `row_x` (W,) and `dy` are the rays' x/z and y/z; `o` (3,) is the camera centre, `R` (3, 3) the
    rotation from the camera, `half` (3,) the half extents, in the box' frame and metres. `best`
    (W,) depth and `hit` (W,) primitive index are written where the box, number `prim`, is nearer.
    """
    zero, near = np.float32(0.0), np.float32(NEAR_M)
    o0, o1, o2 = o[0], o[1], o[2]
    h0, h1, h2 = half[0], half[1], half[2]
    a0, a1, a2 = R[0, 0], R[1, 0], R[2, 0]
    b0, b1, b2 = R[0, 1] * dy + R[0, 2], R[1, 1] * dy + R[1, 2], R[2, 1] * dy + R[2, 2]
    for k in range(row_x.shape[0]):
        dx = row_x[k]
        in0, out0 = _box_slab(o0, a0 * dx + b0, h0)
        in1, out1 = _box_slab(o1, a1 * dx + b1, h1)
        in2, out2 = _box_slab(o2, a2 * dx + b2, h2)
        enter = max(in0, max(in1, in2))
        leave = min(out0, min(out1, out2))
        s = enter if enter > zero else leave
        closer = (enter <= leave) & (s > near) & (s < best[k])
        best[k] = s if closer else best[k]
        hit[k] = prim if closer else hit[k]


@njit(cache=True, nogil=True, fastmath=True)
def _meet_sphere(row_x, dy, o, R, radius, prim, best, hit):
    """Update the nearest hits of one row of a tile with a sphere of `radius` metres.

    All else is as in `_meet_box`: `row_x` (W,), `o` (3,), `R` (3, 3); writes `best` (W,) and
    `hit` (W,).
    """
    c = o[0] * o[0] + o[1] * o[1] + o[2] * o[2] - radius * radius
    for k in range(row_x.shape[0]):
        d0 = R[0, 0] * row_x[k] + R[0, 1] * dy + R[0, 2]
        d1 = R[1, 0] * row_x[k] + R[1, 1] * dy + R[1, 2]
        d2 = R[2, 0] * row_x[k] + R[2, 1] * dy + R[2, 2]
        a = d0 * d0 + d1 * d1 + d2 * d2
        b = o[0] * d0 + o[1] * d1 + o[2] * d2
        root = b * b - a * c
        if root > 0:
            s = (-b - math.sqrt(root)) / a
            if s > np.float32(NEAR_M) and s < best[k]:
                best[k] = s
                hit[k] = prim


@njit(cache=True, nogil=True, fastmath=True)
def _surface(kind, ray, point, half):
    """Return a hit's normal (3) towards the camera, texture coordinates in metres, and face.

    `ray`, `point` and `half` are tuples of three, in the primitive's frame; metres.
    """
    p0, p1, p2 = point
    zero, one = np.float32(0.0), np.float32(1.0)
    if kind == SPHERE:
        r = half[0]
        lift = max(-one, min(one, p2 / r))
        return (p0 / r, p1 / r, p2 / r), math.atan2(p1, p0) * r, math.asin(lift) * r, 0
    # The face is the one whose plane the hit lies in, up to rounding.
    e0, e1, e2 = abs(abs(p0) - half[0]), abs(abs(p1) - half[1]), abs(abs(p2) - half[2])
    if e0 <= e1 and e0 <= e2:
        return (-one if ray[0] > 0 else one, zero, zero), p1, p2, 1 if p0 > 0 else 2
    if e1 <= e2:
        return (zero, -one if ray[1] > 0 else one, zero), p0, p2, 3 if p1 > 0 else 4
    return (zero, zero, -one if ray[2] > 0 else one), p0, p1, 5 if p2 > 0 else 6


@njit(cache=True, nogil=True)
def _lanes(texels, index, weight):
    """Return red, green and blue of a texel, 21 bits each of one word, times a 13-bit weight.

    `texels` (M,) is `Textures.texels`.
    """
    rgb = np.uint64(texels[index])
    red = rgb & np.uint64(0xFF)
    green = (rgb & np.uint64(0xFF00)) << np.uint64(13)
    blue = (rgb & np.uint64(0xFF0000)) << np.uint64(26)
    return (red | green | blue) * np.uint64(weight)


@njit(cache=True, nogil=True, fastmath=True)
def _sample(texels, start, size, u, v):
    """Return the bilinear, wrapped sample (3) at (u, v) repeats, to 1/64 texel.

    `texels` (M,) is `Textures.texels`, of which one level of `size` x `size` begins at `start`.
    Computed in integers, for speed.
    """
    # Rounding towards zero, cheaper than down, errs by 1/64 texel at most.
    x = int(u * np.float32(64 * size)) - 32
    y = int(v * np.float32(64 * size)) - 32
    fx, fy = x & 63, y & 63
    x0, y0 = (x >> 6) & (size - 1), (y >> 6) & (size - 1)
    x1, y1 = (x0 + 1) & (size - 1), (y0 + 1) & (size - 1)
    row0, row1 = start + y0 * size, start + y1 * size
    total = (
        _lanes(texels, row0 + x0, (64 - fx) * (64 - fy))
        + _lanes(texels, row0 + x1, fx * (64 - fy))
        + _lanes(texels, row1 + x0, (64 - fx) * fy)
        + _lanes(texels, row1 + x1, fx * fy)
    )
    lane, scale = np.uint64(0x1FFFFF), np.float32(1 / 4096)
    return (
        np.float32(np.int64(total & lane)) * scale,
        np.float32(np.int64((total >> np.uint64(21)) & lane)) * scale,
        np.float32(np.int64(total >> np.uint64(42))) * scale,
    )


@njit(cache=True, nogil=True, fastmath=True)
def _paint(texels, starts, texture, size, u, v, footprint):
    """Return the trilinear sample (3) at (u, v) repeats for a pixel of `footprint` repeats.

    `texels` (M,), `starts` (textures, levels) and `size` are those of `Textures`.
    """
    texel = max(np.float32(1.0), footprint * np.float32(size))
    level = min(np.float32(math.log2(texel)), np.float32(starts.shape[1] - 1.001))
    k = int(level)
    r0, g0, b0 = _sample(texels, starts[texture, k], size >> k, u, v)
    r1, g1, b1 = _sample(texels, starts[texture, k + 1], size >> (k + 1), u, v)
    blend = level - np.float32(k)
    return r0 + blend * (r1 - r0), g0 + blend * (g1 - g0), b0 + blend * (b1 - b0)


@njit(cache=True, nogil=True, fastmath=True)
def _light(normal, point, lamp, ambient):
    """Return ambient light plus Lambert's law for a lamp at finite distance.

    `normal`, `point` and `lamp` are tuples of three, in the primitive's frame; metres.
    """
    l0, l1, l2 = lamp[0] - point[0], lamp[1] - point[1], lamp[2] - point[2]
    square = l0 * l0 + l1 * l1 + l2 * l2
    facing = max(np.float32(0.0), normal[0] * l0 + normal[1] * l1 + normal[2] * l2)
    falloff = np.float32(4.0) / ((np.float32(2.0) + square) * math.sqrt(square))
    return ambient + (np.float32(1.0) - ambient) * facing * falloff


@njit(cache=True, nogil=True, fastmath=True)
def _place_row(turn, offset, o, R, row_o, row_R):
    """Write a row's `row_o` (3,) and `row_R` (3, 3), which are to it what `o` and `R` are.

    `turn` (3, 3) and `offset` (3,) map the row's camera to the camera of `o` and `R`.
    """
    for i in range(3):
        row_o[i] = o[i] + R[i, 0] * offset[0] + R[i, 1] * offset[1] + R[i, 2] * offset[2]
        for j in range(3):
            row_R[i, j] = R[i, 0] * turn[0, j] + R[i, 1] * turn[1, j] + R[i, 2] * turn[2, j]


@njit(cache=True, nogil=True, fastmath=True)
def _trace_tile(prims, rows, row_x, row_y, x0, y0):
    """Return depth (h, w), metres, and index (h, w) of the nearest primitive of a tile's pixels.

    `prims` is a `Primitives`, `rows` a `RowMotion` or None; `row_x` (w,) and `row_y` (h,) are the
    pixels' x/z and y/z, and the tile begins at pixel (x0, y0). Where nothing is hit, depth is
    `FAR` and the index -1.
    """
    best = np.full((row_y.shape[0], row_x.shape[0]), FAR, np.float32)
    hit = np.full(best.shape, -1, np.int32)
    x1, y1 = x0 + row_x.shape[0], y0 + row_y.shape[0]
    farthest = FAR
    row_o, row_R = np.empty(3, np.float32), np.empty((3, 3), np.float32)
    for p in range(prims.kinds.shape[0]):
        if prims.nearest[p] > farthest:
            break
        box = prims.bounds[p]
        if box[0] >= x1 or box[1] < x0 or box[2] >= y1 or box[3] < y0:
            continue
        o, R, half = prims.origins[p], prims.rotations[p], prims.halves[p]
        for k in range(row_y.shape[0]):
            if rows is not None:
                turn, offset = rows.turns[y0 + k], rows.offsets[y0 + k]
                _place_row(turn, offset, prims.origins[p], prims.rotations[p], row_o, row_R)
                o, R = row_o, row_R
            if prims.kinds[p] == SPHERE:
                _meet_sphere(row_x, row_y[k], o, R, half[0], p, best[k], hit[k])
            else:
                _meet_box(row_x, row_y[k], o, R, half, p, best[k], hit[k])
        farthest = best.max()
    return best, hit


@njit(cache=True, nogil=True, fastmath=True)
def _shade_tile(
    prims,  # `Primitives`
    rows,  # `RowMotion` or None
    textures,  # `Textures`
    best,  # (h, w) depth, as `_trace_tile` returns it
    hit,  # (h, w) index
    row_x,  # (w,) the pixels' x/z
    row_y,  # (h,) the pixels' y/z
    y0,  # first row
    pixel,  # extent of a pixel at depth 1
    ambient,  # share of the light
    depth,  # (h, w) out, metres
    cosine,  # (h, w) out
    radiance,  # (h, w, 3) out; empty: not wanted
):
    """Write `depth`, `cosine` and `radiance` of a tile's pixels."""
    # Arrays are read here and only numbers passed on, as passing tuples of arrays is slow.
    R, o, h, lamps = prims.rotations, prims.origins, prims.halves, prims.lamps
    mappings, tints = prims.mappings, prims.tints
    texels, starts, size = textures.texels, textures.starts, textures.size
    for y in range(row_y.shape[0]):
        for x in range(row_x.shape[0]):
            p, s, dx, dy = hit[y, x], best[y, x], row_x[x], row_y[y]
            if p < 0:
                depth[y, x] = cosine[y, x] = 0
                if radiance.shape[0]:
                    radiance[y, x, 0] = radiance[y, x, 1] = radiance[y, x, 2] = _BACKGROUND
                continue
            o0, o1, o2 = o[p, 0], o[p, 1], o[p, 2]
            d0, d1, d2 = dx, dy, np.float32(1.0)
            if rows is not None:
                T, t = rows.turns, rows.offsets
                k = y0 + y
                d0 = T[k, 0, 0] * dx + T[k, 0, 1] * dy + T[k, 0, 2]
                d1 = T[k, 1, 0] * dx + T[k, 1, 1] * dy + T[k, 1, 2]
                d2 = T[k, 2, 0] * dx + T[k, 2, 1] * dy + T[k, 2, 2]
                o0 += R[p, 0, 0] * t[k, 0] + R[p, 0, 1] * t[k, 1] + R[p, 0, 2] * t[k, 2]
                o1 += R[p, 1, 0] * t[k, 0] + R[p, 1, 1] * t[k, 1] + R[p, 1, 2] * t[k, 2]
                o2 += R[p, 2, 0] * t[k, 0] + R[p, 2, 1] * t[k, 1] + R[p, 2, 2] * t[k, 2]
            ray = (
                R[p, 0, 0] * d0 + R[p, 0, 1] * d1 + R[p, 0, 2] * d2,
                R[p, 1, 0] * d0 + R[p, 1, 1] * d1 + R[p, 1, 2] * d2,
                R[p, 2, 0] * d0 + R[p, 2, 1] * d1 + R[p, 2, 2] * d2,
            )
            point = (o0 + s * ray[0], o1 + s * ray[1], o2 + s * ray[2])
            half = (h[p, 0], h[p, 1], h[p, 2])
            normal, u, v, face = _surface(prims.kinds[p], ray, point, half)
            slant = abs(normal[0] * ray[0] + normal[1] * ray[1] + normal[2] * ray[2])
            slant /= math.sqrt(np.float32(1.0) + dx * dx + dy * dy)
            depth[y, x] = s
            cosine[y, x] = slant
            if radiance.shape[0]:
                r = g = b = _PLAIN
                k = prims.textures[p]
                if k >= 0:
                    repeats, part = mappings[p, 0], np.float32(face)
                    # Each face shows another part of the texture.
                    u = u * repeats + mappings[p, 1] + np.float32(0.173) * part
                    v = v * repeats + mappings[p, 2] + np.float32(0.311) * part
                    footprint = s * pixel * repeats / max(np.float32(0.2), slant)
                    r, g, b = _paint(texels, starts, k, size, u, v, footprint)
                light = _light(normal, point, (lamps[p, 0], lamps[p, 1], lamps[p, 2]), ambient)
                radiance[y, x, 0] = light * tints[p, 0] * r
                radiance[y, x, 1] = light * tints[p, 1] * g
                radiance[y, x, 2] = light * tints[p, 2] * b


@njit(cache=True, nogil=True, fastmath=True)
def _cast_tile(tile, prims, rows, rays, pixel, ambient, textures, planes):
    """Write the pixels of one tile; the arguments are those of `cast_tiles`."""
    (ray_x, ray_y), (depth, cosine, radiance) = rays, planes
    height, width = depth.shape
    columns = (width + _TILE - 1) // _TILE
    x0, y0 = (tile % columns) * _TILE, (tile // columns) * _TILE
    x1, y1 = min(x0 + _TILE, width), min(y0 + _TILE, height)
    row_x, row_y = ray_x[x0:x1], ray_y[y0:y1]
    best, hit = _trace_tile(prims, rows, row_x, row_y, x0, y0)
    _shade_tile(
        prims,
        rows,
        textures,
        best,
        hit,
        row_x,
        row_y,
        y0,
        pixel,
        ambient,
        depth[y0:y1, x0:x1],
        cosine[y0:y1, x0:x1],
        radiance[y0:y1, x0:x1],
    )


@njit(cache=True, nogil=True, fastmath=True, parallel=True)
def cast_tiles(
    prims,  # `Primitives`
    rays,  # (W,), (H,) float32, x/z of each column and y/z of each row
    pixel,  # extent of a pixel at depth 1
    ambient,  # share of the light
    textures,  # `Textures`
    planes,  # depth, cosine, radiance of `SceneView`, out; radiance (0, 0, 3): not wanted
):
    """Write `planes` (H, W[, 3]) by tiles, for locality and culling."""
    height, width = planes[0].shape
    for tile in prange(((width + _TILE - 1) // _TILE) * ((height + _TILE - 1) // _TILE)):
        _cast_tile(tile, prims, None, rays, pixel, ambient, textures, planes)


@njit(cache=True, nogil=True, fastmath=True, parallel=True)
def cast_rolling_tiles(prims, rows, rays, pixel, ambient, textures, planes):
    """Do as `cast_tiles`, with each row's own camera: `rows` is a `RowMotion`."""
    height, width = planes[0].shape
    for tile in prange(((width + _TILE - 1) // _TILE) * ((height + _TILE - 1) // _TILE)):
        _cast_tile(tile, prims, rows, rays, pixel, ambient, textures, planes)
