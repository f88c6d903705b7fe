"""Rigid transforms: SO(3), SE(3), and the type `Pose`.

Conventions: a `Pose` named ``a_from_b`` maps points of frame b to frame a. Tangent vectors are ``xi
= (rho, phi)``: translation first (metres), rotation second (radians). Everything is float64.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_SMALL_ANGLE = 1e-6  # rad; below it Taylor series are exact to float64
_SINGULAR = 1e-9  # least eigenvalue of a scaled matrix that has an inverse


def hat(v: ArrayLike) -> Array:
    """Skew-symmetric matrix (3, 3) with ``hat(a) @ b == cross(a, b)``."""
    x, y, z = np.asarray(v, dtype=np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def so3_exp(phi: ArrayLike) -> Array:
    """Rotation matrix (3, 3) of a rotation vector (3,) in radians (Rodrigues)."""
    phi = np.asarray(phi, dtype=np.float64)
    angle = float(np.linalg.norm(phi))
    K = hat(phi)
    if angle < _SMALL_ANGLE:
        return np.eye(3) + K + 0.5 * K @ K
    a = np.sin(angle) / angle
    b = (1.0 - np.cos(angle)) / angle**2
    rotation: Array = np.eye(3) + a * K + b * K @ K
    return rotation


def so3_log(R: ArrayLike) -> Array:
    """Rotation vector (3,) in radians, angle in [0, pi], of a rotation matrix (3, 3)."""
    q = quaternion_from_matrix(R)
    w, v = q[0], q[1:]
    n = float(np.linalg.norm(v))
    phi: Array = 2.0 * v / w if n < _SMALL_ANGLE else 2.0 * np.arctan2(n, w) * v / n
    return phi


def _left_jacobian(phi: Array) -> Array:
    """Left Jacobian of SO(3), (3, 3): ``exp((rho, phi))`` translates by ``V(phi) @ rho``."""
    angle = float(np.linalg.norm(phi))
    K = hat(phi)
    if angle < _SMALL_ANGLE:
        return np.eye(3) + 0.5 * K + K @ K / 6.0
    a = (1.0 - np.cos(angle)) / angle**2
    b = (angle - np.sin(angle)) / angle**3
    jacobian: Array = np.eye(3) + a * K + b * K @ K
    return jacobian


def quaternion_from_matrix(R: ArrayLike) -> Array:
    """Unit quaternion (4,), order (w, x, y, z) with w >= 0, of a rotation matrix (3, 3)."""
    R = np.asarray(R, dtype=np.float64)
    # The 4x4 symmetric form is stable at every angle (Bar-Itzhack 2000).
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R
    K = np.array(
        [
            [xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, xx - yy - zz, xy + yx, xz + zx],
            [xz - zx, xy + yx, yy - xx - zz, yz + zy],
            [yx - xy, xz + zx, yz + zy, zz - xx - yy],
        ]
    )
    q: Array = np.linalg.eigh(K)[1][:, 3]
    return -q if q[0] < 0 else q


def matrix_from_quaternion(q: ArrayLike) -> Array:
    """Rotation matrix (3, 3) of a quaternion (4,), order (w, x, y, z); it is normalised first."""
    w, x, y, z = np.asarray(q, dtype=np.float64) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def matrix_from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Array:
    """Aerospace body-to-NED rotation (3, 3): Rz(yaw) Ry(pitch) Rx(roll), angles in radians."""
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    cp, sp = np.cos(pitch_rad), np.sin(pitch_rad)
    cy, sy = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def euler_from_matrix(R: ArrayLike) -> tuple[float, float, float]:
    """(roll, pitch, yaw) in radians of a body-to-NED rotation; inverse of `matrix_from_euler`."""
    R = np.asarray(R, dtype=np.float64)
    return (
        float(np.arctan2(R[2, 1], R[2, 2])),
        float(np.arcsin(np.clip(-R[2, 0], -1.0, 1.0))),
        float(np.arctan2(R[1, 0], R[0, 0])),
    )


def scaled_inverse(matrix: Array) -> Array | None:
    """Inverse of a positive definite matrix with rows of any units (m, rad), such as normal
    equations; None if it is singular.
    """
    diagonal = np.diag(matrix)
    if not np.all(diagonal > 0):
        return None
    spread = 1.0 / np.sqrt(diagonal)
    scaled = matrix * np.outer(spread, spread)
    if np.linalg.eigvalsh(scaled)[0] < _SINGULAR:
        return None
    inverse: Array = np.linalg.inv(scaled) * np.outer(spread, spread)
    return inverse


@dataclass(frozen=True)
class Pose:
    """A rigid transform ``a_from_b``: ``x_a = rotation @ x_b + translation``.

    rotation: (3, 3), translation: (3,) in metres; float64.
    """

    rotation: Array
    translation: Array

    @classmethod
    def identity(cls) -> Pose:
        """The identity transform."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_matrix(cls, T: ArrayLike) -> Pose:
        """From a homogeneous matrix (4, 4) or its upper part (3, 4)."""
        T = np.asarray(T, dtype=np.float64)
        return cls(T[:3, :3].copy(), T[:3, 3].copy())

    @classmethod
    def exp(cls, xi: ArrayLike) -> Pose:
        """SE(3) exponential of ``xi = (rho, phi)``, shape (6,) (paper, Eq. 9)."""
        xi = np.asarray(xi, dtype=np.float64)
        return cls(so3_exp(xi[3:]), _left_jacobian(xi[3:]) @ xi[:3])

    def log(self) -> Array:
        """SE(3) logarithm ``(rho, phi)``, shape (6,); inverse of `exp` (paper, Eq. 10)."""
        phi = so3_log(self.rotation)
        return np.concatenate([np.linalg.solve(_left_jacobian(phi), self.translation), phi])

    @property
    def matrix(self) -> Array:
        """Homogeneous matrix (4, 4)."""
        T = np.eye(4)
        T[:3, :3] = self.rotation
        T[:3, 3] = self.translation
        return T

    @property
    def inverse(self) -> Pose:
        """``b_from_a`` of ``a_from_b``."""
        Rt = self.rotation.T
        return Pose(Rt, -Rt @ self.translation)

    def __matmul__(self, other: Pose) -> Pose:
        """``a_from_b @ b_from_c == a_from_c``."""
        return Pose(
            self.rotation @ other.rotation,
            self.rotation @ other.translation + self.translation,
        )

    def apply(self, points: ArrayLike) -> Array:
        """Points (..., 3) of frame b, mapped to frame a."""
        mapped: Array = np.asarray(points, dtype=np.float64) @ self.rotation.T + self.translation
        return mapped

    def distance_to(self, other: Pose) -> tuple[float, float]:
        """(translation in metres, rotation in degrees) between two poses ``world_from_x``.

        The paper's error measures: Euclidean distance of the centres and geodesic angle.
        """
        translation = float(np.linalg.norm(self.translation - other.translation))
        angle = float(np.linalg.norm(so3_log(self.rotation.T @ other.rotation)))
        return translation, float(np.degrees(angle))
