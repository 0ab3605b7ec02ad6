# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Vectors of floats in emitted code against numpy; the same on CPUs that have less."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray
from scenes import scene  # type: ignore[import-not-found]

from dcgs_ros.core.kernels.workers import Workers
from dcgs_ros.core.render import simd
from dcgs_ros.core.render.cpu import CpuRenderer
from dcgs_ros.core.render.simd import LANES, Vector

ROUNDING = 2e-7  # relative, float32: flags let LLVM contract and reorder
EXP2 = {4: 4e-6, 6: 2e-7}  # relative, as documented
LOG2 = 3.5e-7  # absolute, besides the rounding of the result
OTHER_CPU = 1e-5  # relative L2 of images and gradients
LANE_NUMBERS = [0.25 * k - 1.0 for k in range(LANES)]

# What is done in emitted code with two vectors x and y, all in one kernel: compiling it costs.
EXPRESSIONS: dict[str, Callable[[Any, Vector, Vector], Vector]] = {
    'x + y': lambda b, x, y: x + y,
    'x - y': lambda b, x, y: x - y,
    'x * y': lambda b, x, y: x * y,
    'x / y': lambda b, x, y: x / y,
    '-x': lambda b, x, y: -x,
    '2 + x': lambda b, x, y: 2.0 + x,
    'x - 2': lambda b, x, y: x - 2.0,
    '2 - x': lambda b, x, y: 2.0 - x,
    '2 * x': lambda b, x, y: 2.0 * x,
    'x / 2': lambda b, x, y: x / 2.0,
    '2 / x': lambda b, x, y: 2.0 / x,
    'x > y': lambda b, x, y: simd.select(x > y, 1.0, 0.0, b),
    'x >= y': lambda b, x, y: simd.select(x >= y, 1.0, 0.0, b),
    'x < y': lambda b, x, y: simd.select(x < y, 1.0, 0.0, b),
    'x <= y': lambda b, x, y: simd.select(x <= y, 1.0, 0.0, b),
    'x > 0.5': lambda b, x, y: simd.select(x > 0.5, x, y, b),
    'all': lambda b, x, y: simd.select(
        simd.both(x > 0.0, y > 0.0, x < y, x < 0.5, builder=b), 1.0, 0.0, b
    ),
    'minimum': lambda b, x, y: simd.minimum(x, y),
    'maximum': lambda b, x, y: simd.maximum(x, y),
    'minimum(x, 0.5)': lambda b, x, y: simd.minimum(x, 0.5),
    'sqrt': lambda b, x, y: simd.sqrt(x),
    'exp': lambda b, x, y: simd.exp(x),
    'exp2 4': lambda b, x, y: simd.exp2(x, 4),
    'exp2 6': lambda b, x, y: simd.exp2(x, 6),
    'log2': lambda b, x, y: simd.log2(x),
    'lanes': lambda b, x, y: simd.constant(b, LANE_NUMBERS),
    'everywhere': lambda b, x, y: simd.constant(b, 0.1),
    'accumulated': lambda b, x, y: _accumulated(b, [x, y, x * y]),
    'sums of 1': lambda b, x, y: simd.sums([x]),
    'sums of 3': lambda b, x, y: simd.sums([x, y, x * y]),
    'sums of 16': lambda b, x, y: simd.sums([x * float(k) + y for k in range(LANES)]),
}


def _accumulated(builder: Any, vectors: list[Vector]) -> Vector:
    accumulator = simd.Accumulator(builder)
    for vector in vectors:
        accumulator.add(vector)
    return accumulator.total


@intrinsic
def emitted(typing: Any, inputs: Any, out: Any) -> Any:
    """Apply all of EXPRESSIONS to inputs (2 LANES,), and put a scalar into every lane last."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        base = simd.pointer(context, builder, signature.args[0], arguments[0])
        to = simd.pointer(context, builder, signature.args[1], arguments[1])
        x, y = (simd.load(builder, base, simd.index(k * LANES)) for k in range(2))
        results = [expression(builder, x, y) for expression in EXPRESSIONS.values()]
        results.append(simd.scalar_at(builder, base, 3))
        for k, result in enumerate(results):
            simd.store(builder, to, simd.index(k * LANES), result)
        return context.get_dummy_value()

    return types.void(inputs, out), emit


@numba.njit
def evaluate(inputs, out):
    for k in range(inputs.shape[0]):
        emitted(inputs[k], out[k])


def results(
    x: NDArray[np.floating], y: NDArray[np.floating] | None = None
) -> dict[str, NDArray[np.float32]]:
    """Evaluate the expressions at x and y (N,), filled up with the last ones; by name."""
    rows = -(-len(x) // LANES)
    inputs = np.empty((rows, 2, LANES), np.float32)
    for k, values in enumerate((x, x if y is None else y)):
        values = np.asarray(values, np.float32)
        inputs[:, k] = np.pad(values, (0, rows * LANES - len(x)), mode='edge').reshape(rows, LANES)
    out = np.empty((rows, (len(EXPRESSIONS) + 1) * LANES), np.float32)
    evaluate(inputs.reshape(rows, 2 * LANES), out)
    names = [*EXPRESSIONS, 'scalar']
    return {
        name: out[:, k * LANES : (k + 1) * LANES].ravel()[: len(x)] for k, name in enumerate(names)
    }


def pairs(count: int, seed: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Numbers of all signs and sizes, some of them equal."""
    rng = np.random.default_rng(seed)
    x, y = (rng.normal(size=(2, count)) * 10.0 ** rng.uniform(-6, 6, (2, count))).astype('f4')
    y[::5] = x[::5]
    return x, y


def test_arithmetic_is_numpys() -> None:
    x, y = pairs(4000, seed=0)
    found = results(x, y)
    expected = {
        'x + y': x + y, 'x - y': x - y, 'x * y': x * y, 'x / y': x / y, '-x': -x, '2 + x': 2 + x,
        'x - 2': x - 2, '2 - x': 2 - x, '2 * x': 2 * x, 'x / 2': x / 2, '2 / x': 2 / x,
    }  # fmt: skip
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, rtol=ROUNDING, err_msg=name)


def test_comparisons_choose_lane_by_lane() -> None:
    x, y = pairs(4000, seed=1)
    found = results(x, y)
    expected = {
        'x > y': x > y, 'x >= y': x >= y, 'x < y': x < y, 'x <= y': x <= y,
        'x > 0.5': np.where(x > 0.5, x, y), 'all': (x > 0) & (y > 0) & (x < y) & (x < 0.5),
        'minimum': np.minimum(x, y), 'maximum': np.maximum(x, y),
        'minimum(x, 0.5)': np.minimum(x, np.float32(0.5)),
    }  # fmt: skip
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)


def test_no_comparison_holds_for_nan_and_limits_take_its_place() -> None:
    x = np.full(LANES, np.nan, np.float32)
    y = np.linspace(-2, 2, LANES, dtype=np.float32)
    found = results(x, y)
    for name in ('x > y', 'x >= y', 'x < y', 'x <= y', 'all'):
        assert not found[name].any(), name
    for name in ('minimum', 'maximum', 'x > 0.5'):
        np.testing.assert_array_equal(found[name], y, err_msg=name)
    found = results(y, x)
    for name in ('x > y', 'x >= y', 'x < y', 'x <= y', 'all'):
        assert not found[name].any(), name


def test_infinities_are_ordinary_numbers() -> None:
    x = np.array([np.inf, -np.inf] * 8, np.float32)
    found = results(x, np.zeros(LANES))
    np.testing.assert_array_equal(found['maximum'], np.maximum(x, 0))
    np.testing.assert_array_equal(found['minimum'], np.minimum(x, 0))
    np.testing.assert_array_equal(found['2 / x'], 0)


def test_constants_and_scalars_fill_their_lanes() -> None:
    x = np.arange(3 * LANES, dtype=np.float32)
    found = results(x)
    np.testing.assert_array_equal(found['lanes'], np.tile(np.array(LANE_NUMBERS, np.float32), 3))
    np.testing.assert_array_equal(found['everywhere'], np.float32(0.1))
    np.testing.assert_array_equal(found['scalar'], np.repeat(x[3::LANES], LANES))


def test_square_roots_are_numpys() -> None:
    x = np.concatenate([np.geomspace(1e-38, 1e38, 20_000), [0.0, np.inf]]).astype(np.float32)
    np.testing.assert_allclose(results(x)['sqrt'], np.sqrt(x), rtol=ROUNDING)
    assert np.isnan(results(np.full(LANES, -1.0))['sqrt']).all()


@pytest.mark.parametrize('degree', [4, 6])
def test_powers_of_two_are_as_exact_as_documented(degree: int) -> None:
    near_halves = np.arange(-125, 125)[:, None] + 0.5 + np.array([-1e-6, 0, 1e-6])
    x = np.concatenate([
        np.linspace(-125.99, 125.99, 200_000), near_halves.ravel(), np.arange(-125, 126),
        np.linspace(-1, 1, 20_000),
    ]).astype(np.float32)  # fmt: skip
    expected = np.exp2(x.astype(np.float64))
    assert np.abs(results(x)[f'exp2 {degree}'] / expected - 1).max() < EXP2[degree]


def test_exponentials_are_numpys_and_held_within_their_limits() -> None:
    x = np.linspace(-83, 83, 200_000).astype(np.float32)
    error = np.abs(results(x)['exp'] / np.exp(x.astype(np.float64)) - 1)
    # The exponent is rounded once, and the error of a power is relative to that of its exponent.
    assert (error < EXP2[6] + np.finfo(np.float32).eps * np.abs(x)).all()
    beyond = np.array([84.0, 100.0, 1e10, np.inf], np.float32)
    np.testing.assert_allclose(results(beyond)['exp'], 2.0**120, rtol=EXP2[6])
    np.testing.assert_allclose(results(-beyond)['exp'], 2.0**-120, rtol=EXP2[6])


def test_logarithms_are_as_exact_as_documented() -> None:
    x = np.concatenate([
        np.geomspace(1.2e-38, 3.4e38, 200_000), np.linspace(0.5, 2.5, 100_000),
        2.0 ** np.arange(-126, 128), 0.75 * 2.0 ** np.arange(-126, 128),
        1.0 + np.geomspace(1e-7, 1e-3, 1000),
    ]).astype(np.float32)  # fmt: skip
    x = x[x >= np.finfo(np.float32).tiny]
    expected = np.log2(x.astype(np.float64))
    error = np.abs(results(x)['log2'] - expected)
    assert (error < LOG2 + np.spacing(np.abs(expected).astype(np.float32))).all(), error.max()
    assert not results(np.ones(LANES))['log2'].any()


@pytest.mark.parametrize('count', [1, 3, LANES])
def test_lane_k_of_the_sums_is_the_kth_vectors(count: int) -> None:
    rng = np.random.default_rng(2)
    x, y = rng.uniform(1, 2, (2, 10, LANES)).astype(np.float32)
    vectors = {1: [x], 3: [x, y, x * y], LANES: [k * x + y for k in range(LANES)]}[count]
    expected = np.zeros((10, LANES))
    expected[:, :count] = np.stack([v.astype(np.float64).sum(axis=1) for v in vectors], axis=1)
    found = results(x.ravel(), y.ravel())[f'sums of {count}'].reshape(10, LANES)
    np.testing.assert_allclose(found, expected, rtol=4 * ROUNDING)


def test_an_accumulator_adds_up_lane_by_lane() -> None:
    x, y = pairs(1000, seed=3)
    exact = x.astype(np.float64)
    expected = exact + y + exact * y
    size = np.abs(exact) + np.abs(y) + np.abs(exact * y)
    assert (np.abs(results(x, y)['accumulated'] - expected) <= 2 * ROUNDING * size).all()


SCENES = ('ordinary', 'border', 'saturated')  # which float32 is enough for
RENDER_IN_ANOTHER_PROCESS = """
import sys
import numpy as np
sys.path.insert(0, sys.argv[1])
from test_simd import rendered
from dcgs_ros.core.render import tiles
np.savez(sys.argv[2], *rendered())
for kernel in (tiles.project_all, tiles.blend_tiles, tiles.blend_tiles_backward, tiles.chain_all):
    for signature in kernel.signatures:
        print(kernel.inspect_asm(signature))
"""


def rendered() -> list[NDArray[np.floating]]:
    """Images of a few scenes, and gradients by mean, scale, rotation, opacity, colour, pose."""
    found: list[NDArray[np.floating]] = []
    renderer = CpuRenderer(Workers(1))
    for name in SCENES:
        made = scene(name, 1)
        image = renderer.render(made.planes, made.view).planes
        upstream = np.random.default_rng(4).normal(size=image.shape).astype(np.float32)
        gradients = renderer.backward(upstream)
        planes = np.where(gradients.touched, gradients.planes, 0.0)
        groups = np.split(planes, [3, 6, 10, 11])
        found += [image.copy(), *groups, gradients.pose, gradients.weights.copy()]
    return found


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() != 'x86_64', reason='names CPUs of x86-64')
@pytest.mark.parametrize(
    ('cpu', 'registers', 'lacking'), [('x86-64', '%xmm', '%ymm'), ('haswell', '%ymm', '%zmm')]
)
def test_a_cpu_that_has_less_gives_the_same(
    tmp_path: Path, cpu: str, registers: str, lacking: str
) -> None:
    here, root = Path(__file__).parent, Path(__file__).parents[3]
    environment = os.environ | {
        'NUMBA_CPU_NAME': cpu,
        'NUMBA_CPU_FEATURES': '',  # else those of this machine come on top
        'NUMBA_CACHE_DIR': str(tmp_path),
        'PYTHONPATH': os.pathsep.join([str(root), os.environ.get('PYTHONPATH', '')]),
    }
    command = [sys.executable, '-c', RENDER_IN_ANOTHER_PROCESS, str(here), str(tmp_path / 'found')]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    assert registers in done.stdout and lacking not in done.stdout
    with np.load(tmp_path / 'found.npz') as archive:
        for found, expected in zip(archive.values(), rendered(), strict=True):
            error = float(np.linalg.norm(found - expected))
            assert error <= OTHER_CPU * float(np.linalg.norm(expected))
