"""Quaternion kernels (w, x, y, z; body to NED) shared by dynamics, estimator and controller."""

from __future__ import annotations

from math import atan2, cos, sin, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mavlink_bridge.quaternion import from_euler, to_euler

Array = NDArray[np.float64]
Quaternion = tuple[float, float, float, float]


@njit(cache=True)
def matrix(q: Array) -> Array:
    """Rotation matrix (3, 3), body to NED."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    R = np.empty((3, 3))
    R[0, 0] = 1 - 2 * (y * y + z * z)
    R[0, 1] = 2 * (x * y - w * z)
    R[0, 2] = 2 * (x * z + w * y)
    R[1, 0] = 2 * (x * y + w * z)
    R[1, 1] = 1 - 2 * (x * x + z * z)
    R[1, 2] = 2 * (y * z - w * x)
    R[2, 0] = 2 * (x * z - w * y)
    R[2, 1] = 2 * (y * z + w * x)
    R[2, 2] = 1 - 2 * (x * x + y * y)
    return R


@njit(cache=True)
def rotate_body(q: Array, rx: float, ry: float, rz: float) -> None:
    """``q <- q * exp(r)`` in place: a rotation vector in body axes, radians."""
    _multiply((q[0], q[1], q[2], q[3]), _exp(rx, ry, rz), q)


@njit(cache=True)
def rotate_world(q: Array, rx: float, ry: float, rz: float) -> None:
    """``q <- exp(r) * q`` in place: a rotation vector in NED axes, radians."""
    _multiply(_exp(rx, ry, rz), (q[0], q[1], q[2], q[3]), q)


@njit(cache=True)
def _exp(rx: float, ry: float, rz: float) -> Quaternion:
    angle = sqrt(rx * rx + ry * ry + rz * rz)
    s = 0.5 if angle < 1e-9 else sin(0.5 * angle) / angle
    return cos(0.5 * angle), s * rx, s * ry, s * rz


@njit(cache=True)
def _multiply(p: Quaternion, q: Quaternion, out: Array) -> None:
    """The product of two quaternions, normalised."""
    a = p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3]
    b = p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2]
    c = p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1]
    d = p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0]
    n = 1.0 / sqrt(a * a + b * b + c * c + d * d)
    out[0], out[1], out[2], out[3] = a * n, b * n, c * n, d * n


def quaternion(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Array:
    """Quaternion (4,) of aerospace Euler angles in radians."""
    return np.array(from_euler(roll_rad, pitch_rad, yaw_rad))


def euler(q: Array) -> tuple[float, float, float]:
    """(roll, pitch, yaw) in radians of a quaternion (4,)."""
    w, x, y, z = (float(c) for c in q)
    return to_euler((w, x, y, z))


def wrap_pi(angle_rad: float) -> float:
    """The angle in (-pi, pi]."""
    return atan2(sin(angle_rad), cos(angle_rad))
