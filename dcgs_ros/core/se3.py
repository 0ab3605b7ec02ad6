# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""SE(3) as 4x4 float64 matrices.

Twists are xi = (rho, phi), translation first. The package perturbs on the right, T exp(xi), so a
twist, a Hessian and a covariance of T_world_cam are all expressed in the camera's own frame.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .kernels.jit import kernel

_SMALL = 1e-4  # rad: below, the series of sin(x)/x and friends are exact to double precision
_SERIES = 1e-2  # rad: below, the series of V^-1's last coefficient loses less than the formula
_NEAR_PI = math.pi - 1e-3
_POLISHED = 3  # times: from an error of 1e-2 to rounding


_HAT = np.zeros((3, 9))  # of hat, which is linear
_HAT[[0, 0, 1, 1, 2, 2], [7, 5, 2, 6, 3, 1]] = np.tile([1.0, -1.0], 3)


def hat(v: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the matrix (3, 3) of the cross product with v (3,): hat(v) w = v x w."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


@kernel
def _sine_ratios(angle):
    """Return sin(x)/x, (1 - cos x)/x^2 and (x - sin x)/x^3."""
    if angle < _SMALL:
        x2 = angle * angle
        return 1.0 - x2 / 6.0, 0.5 - x2 / 24.0, 1.0 / 6.0 - x2 / 120.0
    sine = math.sin(angle)
    return sine / angle, 2.0 * (math.sin(0.5 * angle) / angle) ** 2, (angle - sine) / angle**3


def so3_left_jacobian(phi: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return V(phi) (3, 3), phi (3,): the integral of the rotation by s phi over s in [0, 1]."""
    _, b, c = _sine_ratios(math.sqrt(float(phi @ phi)))
    k = hat(phi)
    return np.eye(3) + b * k + c * (k @ k)


def exp(xi: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the transform (4, 4) of a twist (6,)."""
    T = np.empty((4, 4))
    _exp(np.ascontiguousarray(xi, np.float64), T)
    return T


def log(T: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the twist (6,) of a transform (4, 4), rotation angle in [0, pi]."""
    T = np.ascontiguousarray(T, np.float64)
    xi = np.empty(6)
    if _log_rotation(T, xi) > _NEAR_PI:  # the sine is too small to give the axis
        xi[3:] = Rotation.from_matrix(T[:3, :3]).as_rotvec()
    _log_translation(T, xi)
    return xi


def inverse(T: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the inverse of one transform (4, 4) or of a stack (..., 4, 4)."""
    T = np.ascontiguousarray(T, np.float64)
    out = np.empty_like(T)
    _invert(T.reshape(-1, 4, 4), out.reshape(-1, 4, 4))
    return out


@kernel
def _exp(xi, T):
    """Write the transform of the twist `xi` (6,) into `T` (4, 4)."""
    x, y, z = xi[3], xi[4], xi[5]
    a, b, c = _sine_ratios(math.sqrt(x * x + y * y + z * z))
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    for i in range(3):
        T[i, 3] = xi[i]
        T[3, i] = 0.0
        for j in range(3):
            square = k[i, 0] * k[0, j] + k[i, 1] * k[1, j] + k[i, 2] * k[2, j]
            T[i, j] = (1.0 if i == j else 0.0) + a * k[i, j] + b * square
            T[i, 3] += (b * k[i, j] + c * square) * xi[j]
    T[3, 3] = 1.0


@kernel
def _log_rotation(T, xi):
    """Write the rotation vector of `T` (4, 4) into `xi` (6,), and return its angle."""
    x, y, z = T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1]
    sine = 0.5 * math.sqrt(x * x + y * y + z * z)
    angle = math.atan2(sine, 0.5 * (T[0, 0] + T[1, 1] + T[2, 2] - 1.0))
    if angle <= _NEAR_PI:
        s = 0.5 / _sine_ratios(angle)[0]
        xi[3], xi[4], xi[5] = s * x, s * y, s * z
    return angle


@kernel
def _log_translation(T, xi):
    """Write V^-1 t of `T` (4, 4) into the first half of `xi` (6,), whose second half is phi."""
    x, y, z = xi[3], xi[4], xi[5]
    angle = math.sqrt(x * x + y * y + z * z)
    a, b, _ = _sine_ratios(angle)
    # V^-1 = I - K/2 + e K^2 with e = (1 - a / (2 b)) / x^2
    e = 1.0 / 12.0 + angle**2 / 720.0 if angle < _SERIES else (1.0 - 0.5 * a / b) / angle**2
    p, q, r = T[0, 3], T[1, 3], T[2, 3]
    kp, kq, kr = y * r - z * q, z * p - x * r, x * q - y * p
    xi[0] = p - 0.5 * kp + e * (y * kr - z * kq)
    xi[1] = q - 0.5 * kq + e * (z * kp - x * kr)
    xi[2] = r - 0.5 * kr + e * (x * kq - y * kp)


@kernel
def _invert(T, out):
    """Write the inverses of the transforms `T` (N, 4, 4) into `out` (N, 4, 4)."""
    for n in range(T.shape[0]):
        for i in range(3):
            out[n, i, 3] = 0.0
            out[n, 3, i] = 0.0
            for j in range(3):
                out[n, i, j] = T[n, j, i]
                out[n, i, 3] -= T[n, j, i] * T[n, j, 3]
        out[n, 3, 3] = 1.0


def transform(T: NDArray[np.float64], points: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return points (N, 3) mapped by one transform (4, 4): p_a = T_a_b p_b."""
    return points @ T[:3, :3].T + T[:3, 3]


def adjoint(T: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return Ad (..., 6, 6) of transforms (..., 4, 4), with T exp(xi) T^-1 = exp(Ad xi)."""
    R, t = T[..., :3, :3], T[..., :3, 3]
    Ad = np.zeros((*T.shape[:-2], 6, 6))
    Ad[..., :3, :3] = Ad[..., 3:, 3:] = R
    Ad[..., :3, 3:] = (t @ _HAT).reshape(R.shape) @ R
    return Ad


def orthonormalised(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the nearest transforms with an exact rotation, of one (4, 4) or of a stack.

    It undoes the rounding of long products. R <- R (3 I - R^T R) / 2 squares the error, which may
    be that of a few decimals (Bjorck and Bowie 1971).
    """
    out = T.copy()
    for _ in range(_POLISHED):
        R = out[..., :3, :3]
        out[..., :3, :3] = R @ (1.5 * np.eye(3) - 0.5 * np.swapaxes(R, -1, -2) @ R)
    return out


def from_quaternion(
    quat_wxyz: NDArray[np.floating], translation: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Return transforms (..., 4, 4) of unit quaternions (..., 4) and translations (..., 3)."""
    quat_wxyz, translation = np.asarray(quat_wxyz), np.asarray(translation)
    T = np.zeros((*translation.shape[:-1], 4, 4))
    xyzw = np.roll(quat_wxyz, -1, axis=-1).reshape(-1, 4)
    if len(xyzw):  # SciPy before 1.17 rejects an empty stack
        T[..., :3, :3] = Rotation.from_quat(xyzw).as_matrix().reshape(*T.shape[:-2], 3, 3)
    T[..., :3, 3] = translation
    T[..., 3, 3] = 1.0
    return T


def to_quaternion(T: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return unit quaternions (..., 4) wxyz, w >= 0, of transforms (..., 4, 4)."""
    T = np.asarray(T)
    if not T.size:
        return np.zeros((*T.shape[:-2], 4))
    xyzw = Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_quat()
    wxyz = np.roll(xyzw, 1, axis=-1)
    wxyz = np.where(wxyz[:, :1] < 0, -wxyz, wxyz)
    return wxyz.reshape(*T.shape[:-2], 4)
