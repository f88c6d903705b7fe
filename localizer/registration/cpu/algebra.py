"""The small dense algebra of the numba kernel: the 6x6 system, the retraction, the quadratic prior.

float64 throughout, in place on scratch that the caller owns. sums: H's lower triangle by rows (21),
then g (6). R, t: a pose camera_from_local. Equation numbers are of
docs/explanation/registration.md.
"""

# ruff: noqa: PLR0912 (loops over a packed triangle, unrolled by hand)

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import njit, types
from numba.extending import intrinsic

# Reassociation and contraction give SIMD reductions; NaN and infinity keep their meaning.
JIT: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "fastmath": {"reassoc", "contract", "arcp", "nsz"},
    "error_model": "numpy",
    "boundscheck": False,
}


@intrinsic
def prefetch(_context, array, _index):  # type: ignore[no-untyped-def]
    """Prefetch the cache line of ``array[index]`` (1-d, contiguous) before its use."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        function = builder.module.declare_intrinsic("llvm.prefetch.p0i8", fnty=kind)
        address = builder.bitcast(builder.gep(data, [arguments[1]]), byte)
        read, keep, is_data = (ir.Constant(number, v) for v in (0, 3, 1))
        builder.call(function, [address, read, keep, is_data])
        return context.get_dummy_value()

    return types.void(array, types.intp), generate


@njit(**JIT)
def damp(sums, t, damping, M):  # type: ignore[no-untyped-def]
    """Write the left side of equation 8 to the lower triangle of M; False if H's diagonal is not
    positive.
    """
    k = 0
    for i in range(6):
        for j in range(i + 1):
            M[i, j] = sums[k]
            k += 1
        if not M[i, i] > 0.0:
            return False
    x, y, z = t[0], t[1], t[2]
    # What a turn about the camera's centre is worth: the diagonal of equation 8a.
    turn0 = M[3, 3] + z * z * M[1, 1] + y * y * M[2, 2]
    turn0 += 2.0 * (y * M[3, 2] - z * M[3, 1] - y * z * M[2, 1])
    turn1 = M[4, 4] + z * z * M[0, 0] + x * x * M[2, 2]
    turn1 += 2.0 * (z * M[4, 0] - x * M[4, 2] - x * z * M[2, 0])
    turn2 = M[5, 5] + y * y * M[0, 0] + x * x * M[1, 1]
    turn2 += 2.0 * (x * M[5, 1] - y * M[5, 0] - x * y * M[1, 0])
    a, b, c = damping * M[0, 0], damping * M[1, 1], damping * M[2, 2]
    M[0, 0] += a
    M[1, 1] += b
    M[2, 2] += c
    M[3, 1] += b * z
    M[3, 2] -= c * y
    M[4, 0] -= a * z
    M[4, 2] += c * x
    M[5, 0] += a * y
    M[5, 1] -= b * x
    M[3, 3] += damping * turn0 + b * z * z + c * y * y
    M[4, 4] += damping * turn1 + a * z * z + c * x * x
    M[5, 5] += damping * turn2 + a * y * y + b * x * x
    M[4, 3] -= c * x * y
    M[5, 3] -= b * x * z
    M[5, 4] -= a * y * z
    return True


@njit(**JIT)
def solve(sums, t, damping, M, scale, L, step):  # type: ignore[no-untyped-def]
    """Solve equation 8 by Cholesky on the unit-diagonal system, into step; False if singular."""
    if not damp(sums, t, damping, M):
        return False
    for i in range(6):
        if not M[i, i] > 0.0:
            return False
        scale[i] = 1.0 / np.sqrt(M[i, i])
    for i in range(6):
        for j in range(i + 1):
            s = M[i, j] * scale[i] * scale[j]
            for m in range(j):
                s -= L[i, m] * L[j, m]
            if i == j:
                if not s > 0.0:
                    return False
                L[i, i] = np.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    for i in range(6):
        s = -sums[21 + i] * scale[i]
        for m in range(i):
            s -= L[i, m] * step[m]
        step[i] = s / L[i, i]
    for i in range(5, -1, -1):
        s = step[i]
        for m in range(i + 1, 6):
            s -= L[m, i] * step[m]
        step[i] = s / L[i, i]
    for i in range(6):
        step[i] *= scale[i]
    return True


@njit(**JIT)
def retract(R, t, step, R_out, t_out):  # type: ignore[no-untyped-def]
    """Equation 5: ``R_out = exp(phi) R``, ``t_out = t + rho``."""
    x, y, z = step[3], step[4], step[5]
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-12:
        a, b = 1.0 - angle2 / 6.0, 0.5
    else:
        angle = np.sqrt(angle2)
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    e00, e01, e02 = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    e10, e11, e12 = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    e20, e21, e22 = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
    for j in range(3):
        c0, c1, c2 = R[0, j], R[1, j], R[2, j]
        R_out[0, j] = e00 * c0 + e01 * c1 + e02 * c2
        R_out[1, j] = e10 * c0 + e11 * c1 + e12 * c2
        R_out[2, j] = e20 * c0 + e21 * c1 + e22 * c2
    for i in range(3):
        t_out[i] = t[i] + step[i]


@njit(**JIT)
def _relative_log(R, R0, out):  # type: ignore[no-untyped-def]
    """Rotation vector of ``R' R0`` for angles below pi (equation 13)."""
    out[0] = out[1] = out[2] = trace = 0.0
    for k in range(3):
        out[0] += R[k, 2] * R0[k, 1] - R[k, 1] * R0[k, 2]
        out[1] += R[k, 0] * R0[k, 2] - R[k, 2] * R0[k, 0]
        out[2] += R[k, 1] * R0[k, 0] - R[k, 0] * R0[k, 1]
        for i in range(3):
            trace += R[k, i] * R0[k, i]
    s = 0.5 * np.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2)
    angle = np.arctan2(s, 0.5 * (trace - 1.0))
    factor = 0.5 if s < 1e-12 else 0.5 * angle / s
    for i in range(3):
        out[i] *= factor


@njit(**JIT)
def add_prior(R, t, R0, t0, information, weight, sums, work):  # type: ignore[no-untyped-def]
    """Equation 15: add the quadratic prior to H, g and the score; returns its cost.

    work: (14, 6) scratch.
    """
    d, Ld, J, LJ = work[0], work[1], work[2:8], work[8:14]
    _relative_log(R, R0, d[3:])
    for i in range(3):
        d[i] = 0.0
        for k in range(3):
            d[i] += R0[k, i] * t0[k] - R[k, i] * t[k]
            J[i, k] = J[3 + i, 3 + k] = -R[k, i]
            J[3 + i, k] = 0.0
        J[i, 3] = -(R[1, i] * t[2] - R[2, i] * t[1])
        J[i, 4] = -(R[2, i] * t[0] - R[0, i] * t[2])
        J[i, 5] = -(R[0, i] * t[1] - R[1, i] * t[0])
    for i in range(6):
        Ld[i] = 0.0
        for j in range(6):
            Ld[i] += information[i, j] * d[j]
            LJ[i, j] = 0.0
            for m in range(6):
                LJ[i, j] += information[i, m] * J[m, j]
    k = 0
    for i in range(6):
        for j in range(i + 1):
            s = 0.0
            for m in range(6):
                s += J[m, i] * LJ[m, j]
            sums[k] += weight * s
            k += 1
    cost = 0.0
    for i in range(6):
        s = 0.0
        for m in range(6):
            s += J[m, i] * Ld[m]
        sums[21 + i] += weight * s
        cost += d[i] * Ld[i]
    return weight * cost
