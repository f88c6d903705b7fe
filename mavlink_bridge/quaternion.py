"""Quaternions (w, x, y, z) and aerospace angles in MAVLink's conventions; radians."""

from __future__ import annotations

import math

Quaternion = tuple[float, float, float, float]
Vector = tuple[float, float, float]


def wrap_pi(angle: float) -> float:
    """The angle in [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def normalise(q: tuple[float, ...] | list[float]) -> Quaternion:
    """Scale to unit length; ValueError for a quaternion that is zero or not finite."""
    w, x, y, z = q
    n = math.sqrt(w * w + x * x + y * y + z * z)
    if not n > 1e-6 or not math.isfinite(n):
        raise ValueError(f"{tuple(q)} is no rotation")
    return w / n, x / n, y / n, z / n


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Hamilton product: rotates by b first, then by a."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def conjugate(q: Quaternion) -> Quaternion:
    """The inverse of a unit quaternion."""
    return q[0], -q[1], -q[2], -q[3]


def rotate(q: Quaternion, v: Vector) -> Vector:
    """Rotate the vector by the unit quaternion q: from body axes to NED, if q is body to NED."""
    _, x, y, z = multiply(multiply(q, (0.0, *v)), conjugate(q))
    return x, y, z


def from_euler(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Quaternion of Rz(yaw) Ry(pitch) Rx(roll), radians: body to NED."""
    cr, sr = math.cos(roll / 2.0), math.sin(roll / 2.0)
    cp, sp = math.cos(pitch / 2.0), math.sin(pitch / 2.0)
    cy, sy = math.cos(yaw / 2.0), math.sin(yaw / 2.0)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def to_euler(q: Quaternion) -> Vector:
    """(roll, pitch, yaw) in radians; inverse of `from_euler` away from pitch +-90 deg."""
    w, x, y, z = q
    return (
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x)))),
        math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )


def slerp(a: Quaternion, b: Quaternion, t: float) -> Quaternion:
    """Spherical interpolation along the shorter path; t = 0 gives a, t = 1 gives b."""
    dot = sum(p * q for p, q in zip(a, b, strict=True))
    if dot < 0.0:
        b, dot = (-b[0], -b[1], -b[2], -b[3]), -dot
    if dot > 0.9995:
        # Nearly parallel: the chord is as good as the arc.
        return normalise([p + t * (q - p) for p, q in zip(a, b, strict=True)])
    angle = math.acos(dot)
    u, v = math.sin((1.0 - t) * angle), math.sin(t * angle)
    return normalise([u * p + v * q for p, q in zip(a, b, strict=True)])


def rotated(q: Quaternion, rates: Vector, seconds: float) -> Quaternion:
    """The attitude q (body to NED) after `seconds` at constant body rates (rad/s)."""
    rx, ry, rz = (rate * seconds for rate in rates)
    angle = math.sqrt(rx * rx + ry * ry + rz * rz)
    if angle < 1e-9:
        return q
    s = math.sin(angle / 2.0) / angle
    return normalise(multiply(q, (math.cos(angle / 2.0), rx * s, ry * s, rz * s)))
