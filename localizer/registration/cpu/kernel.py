"""The CPU backend: a two-pass numba kernel, compiled once per channel count and cached on disk.

Per evaluation of one hypothesis: (1) project all anchors (SIMD over anchors) and keep those in the
image; (2) sample: per anchor reduce the C channels to the 2x2 structure tensor, the 2-vector
gradient·residual and the squared residual norm (SIMD over channels), so that no C x 6 Jacobian is
ever formed; (3) accumulate the 6x6 normal equations (SIMD over anchors). Poses, the 6x6 solution
and the retraction are float64; points, features and sums are float32. Threads split the hypotheses
and hold no GIL. Equations are numbered in docs/explanation/registration.md.
"""

# ruff: noqa: PLR0915 (kernels pass arrays and unroll sums, for speed)

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import numpy as np
from numba import njit

from localizer.geometry.pose import Array
from localizer.registration.backend import LevelProblem, LMSettings, Refinement
from localizer.registration.cpu.algebra import JIT, add_prior, prefetch, retract, solve
from localizer.registration.cpu.reference import MIN_DEPTH, minimum_visible

_F = np.float32
_HYPOTHESES_PER_THREAD = 8  # fewer finish sooner than another thread wakes up
_ROWS = 17  # scratch rows of N floats per worker
_SUMS = 27  # 21 of H (lower triangle), 6 of g
_WORK = 23  # scratch rows of 6: 14 of a prior or a damped system, scale, step, L (6), a translation
_AHEAD = 6  # anchors between asking for features and using them; 4 to 8 measured alike
_LINE = 16  # floats of a cache line


@njit(**JIT)
def _project(R, t, points, focal, centre, buf):  # type: ignore[no-untyped-def]
    """Equation 1 for all anchors: x, y, z, u, v into rows 0 to 4 of buf."""
    r00, r01, r02, t0 = _F(R[0, 0]), _F(R[0, 1]), _F(R[0, 2]), _F(t[0])
    r10, r11, r12, t1 = _F(R[1, 0]), _F(R[1, 1]), _F(R[1, 2]), _F(t[1])
    r20, r21, r22, t2 = _F(R[2, 0]), _F(R[2, 1]), _F(R[2, 2]), _F(t[2])
    fx, fy, cx, cy = _F(focal[0]), _F(focal[1]), _F(centre[0]), _F(centre[1])
    X, Y, Z = points[0], points[1], points[2]
    bx, by, bz, bu, bv = buf[0], buf[1], buf[2], buf[3], buf[4]
    near = _F(MIN_DEPTH)
    for j in range(X.shape[0]):
        x = r00 * X[j] + r01 * Y[j] + r02 * Z[j] + t0
        y = r10 * X[j] + r11 * Y[j] + r12 * Z[j] + t1
        z = r20 * X[j] + r21 * Y[j] + r22 * Z[j] + t2
        iz = _F(1) / max(z, near)
        bx[j], by[j], bz[j] = x, y, z
        bu[j] = fx * x * iz + cx
        bv[j] = fy * y * iz + cy


@njit(**JIT)
def _compact(count, h, w, buf, index):  # type: ignore[no-untyped-def]
    """Keep the anchors in view, of `count`: writes x, y, z and fractions to rows 5 to 9 of buf, and
    anchor and feature cell to index; returns their number.
    """
    bx, by, bz, bu, bv = buf[0], buf[1], buf[2], buf[3], buf[4]
    kx, ky, kz, ka, kb = buf[5], buf[6], buf[7], buf[8], buf[9]
    anchor, cell = index[0], index[1]
    umax, vmax, near, zero = _F(w - 1), _F(h - 1), _F(MIN_DEPTH), _F(0)
    n = 0
    for j in range(count):
        u, v = bu[j], bv[j]
        if u >= zero and u < umax and v >= zero and v < vmax and bz[j] > near:
            iu, iv = int(u), int(v)
            kx[n], ky[n], kz[n] = bx[j], by[j], bz[j]
            ka[n], kb[n] = u - _F(iu), v - _F(iv)
            anchor[n], cell[n] = j, iv * w + iu
            n += 1
    return n


@njit(**JIT)
def _weigh(n, w, confidence, anchor_confidence, delta, redescending, buf, index):  # type: ignore[no-untyped-def]
    """Equations 2 and 4: (cost, weight); row 16 gets the anchors' IRLS weights."""
    ka, kb, ke, kw = buf[8], buf[9], buf[15], buf[16]
    anchor, cell = index[0], index[1]
    for k in range(n):
        i = cell[k]
        a, b = ka[k], kb[k]
        top = confidence[i] + a * (confidence[i + 1] - confidence[i])
        low = confidence[i + w] + a * (confidence[i + w + 1] - confidence[i + w])
        kw[k] = anchor_confidence[anchor[k]] * (top + b * (low - top))
    cost, total = _F(0), _F(0)
    if redescending:
        inverse = _F(1) / (delta * delta)
        for k in range(n):
            share = _F(1) / (_F(1) + ke[k] * inverse)
            total += kw[k]
            cost += kw[k] * ke[k] * share
            kw[k] *= share * share
        return cost, total
    for k in range(n):
        e = ke[k]
        norm = np.sqrt(e)
        weight = kw[k]
        total += weight
        inlier = norm <= delta
        cost += weight * (e if inlier else delta * (_F(2) * norm - delta))
        kw[k] = weight if inlier else weight * delta / norm
    return cost, total


@njit(**JIT)
def _accumulate(n, t, focal, buf, sums):  # type: ignore[no-untyped-def]
    """Equations 6 and 7 over the anchors in view: 21 sums of H and 6 of g."""
    fx, fy = _F(focal[0]), _F(focal[1])
    t0, t1, t2 = _F(t[0]), _F(t[1]), _F(t[2])
    kx, ky, kz = buf[5], buf[6], buf[7]
    kA, kB, kD, kp, kq, kw = buf[10], buf[11], buf[12], buf[13], buf[14], buf[16]
    # Three loops, because 27 vector accumulators do not fit in the registers.
    g0, g1, g2, g3, g4, g5 = _F(0), _F(0), _F(0), _F(0), _F(0), _F(0)
    for k in range(n):
        iz = _F(1) / kz[k]
        a, c = fx * iz, fy * iz
        b, d = -a * kx[k] * iz, -c * ky[k] * iz
        x, y, z = kx[k] - t0, ky[k] - t1, kz[k] - t2
        p, q = kw[k] * kp[k], kw[k] * kq[k]
        g0 += p * a
        g1 += q * c
        g2 += p * b + q * d
        g3 += p * (b * y) + q * (d * y - c * z)
        g4 += p * (a * z - b * x) - q * (d * x)
        g5 += q * (c * x) - p * (a * y)
    sums[21], sums[22], sums[23], sums[24], sums[25], sums[26] = g0, g1, g2, g3, g4, g5
    h00, h10, h11, h20, h21, h22 = _F(0), _F(0), _F(0), _F(0), _F(0), _F(0)
    h30, h31, h32, h33 = _F(0), _F(0), _F(0), _F(0)
    for k in range(n):
        iz = _F(1) / kz[k]
        a, c = fx * iz, fy * iz
        b, d = -a * kx[k] * iz, -c * ky[k] * iz
        y, z = ky[k] - t1, kz[k] - t2
        A, B, D = kw[k] * kA[k], kw[k] * kB[k], kw[k] * kD[k]
        b3, d3 = b * y, d * y - c * z
        m2, n2 = A * b + B * d, B * b + D * d
        m3, n3 = A * b3 + B * d3, B * b3 + D * d3
        h00 += A * a * a
        h10 += B * a * c
        h11 += D * c * c
        h20 += m2 * a
        h21 += n2 * c
        h22 += m2 * b + n2 * d
        h30 += m3 * a
        h31 += n3 * c
        h32 += m3 * b + n3 * d
        h33 += m3 * b3 + n3 * d3
    sums[0], sums[1], sums[2], sums[3], sums[4] = h00, h10, h11, h20, h21
    sums[5], sums[6], sums[7], sums[8], sums[9] = h22, h30, h31, h32, h33
    h40, h41, h42, h43, h44 = _F(0), _F(0), _F(0), _F(0), _F(0)
    h50, h51, h52, h53, h54, h55 = _F(0), _F(0), _F(0), _F(0), _F(0), _F(0)
    for k in range(n):
        iz = _F(1) / kz[k]
        a, c = fx * iz, fy * iz
        b, d = -a * kx[k] * iz, -c * ky[k] * iz
        x, y, z = kx[k] - t0, ky[k] - t1, kz[k] - t2
        A, B, D = kw[k] * kA[k], kw[k] * kB[k], kw[k] * kD[k]
        b3, d3 = b * y, d * y - c * z
        b4, d4 = a * z - b * x, -d * x
        b5, d5 = -a * y, c * x
        m4, n4 = A * b4 + B * d4, B * b4 + D * d4
        m5, n5 = A * b5 + B * d5, B * b5 + D * d5
        h40 += m4 * a
        h41 += n4 * c
        h42 += m4 * b + n4 * d
        h43 += m4 * b3 + n4 * d3
        h44 += m4 * b4 + n4 * d4
        h50 += m5 * a
        h51 += n5 * c
        h52 += m5 * b + n5 * d
        h53 += m5 * b3 + n5 * d3
        h54 += m5 * b4 + n5 * d4
        h55 += m5 * b5 + n5 * d5
    sums[10], sums[11], sums[12], sums[13], sums[14] = h40, h41, h42, h43, h44
    sums[15], sums[16], sums[17], sums[18], sums[19], sums[20] = h50, h51, h52, h53, h54, h55


@njit(forceinline=True, **JIT)
def _sample(C, n, w, features, anchor_features, buf, index):  # type: ignore[no-untyped-def]
    """Equations 3 and 7: reduce the channels of each anchor in view to rows 10 to 15."""
    ka, kb = buf[8], buf[9]
    kA, kB, kD, kp, kq, ke = buf[10], buf[11], buf[12], buf[13], buf[14], buf[15]
    anchor, cell = index[0], index[1]
    row = w * C
    for k in range(n):
        ahead = cell[min(k + _AHEAD, n - 1)] * C
        for c in range(0, 2 * C, _LINE):
            prefetch(features, ahead + c)
            prefetch(features, ahead + row + c)
        a, b = ka[k], kb[k]
        i, j = cell[k] * C, anchor[k] * C
        f00, f01 = features[i : i + C], features[i + C : i + 2 * C]
        f10 = features[i + row : i + row + C]
        f11 = features[i + row + C : i + row + 2 * C]
        fr = anchor_features[j : j + C]
        A, B, D, p, q, e = _F(0), _F(0), _F(0), _F(0), _F(0), _F(0)
        for c in range(C):
            v00, v10 = f00[c], f10[c]
            d0, d1 = f01[c] - v00, f11[c] - v10
            top = v00 + a * d0
            gy = v10 + a * d1 - top
            gx = d0 + b * (d1 - d0)
            r = top + b * gy - fr[c]
            A += gx * gx
            B += gx * gy
            D += gy * gy
            p += gx * r
            q += gy * r
            e += r * r
        kA[k], kB[k], kD[k], kp[k], kq[k], ke[k] = A, B, D, p, q, e


@njit(forceinline=True, **JIT)
def _residuals(C, n, w, features, anchor_features, buf, index):  # type: ignore[no-untyped-def]
    """Row 15 of `_sample` alone: all that a score needs."""
    ka, kb, ke = buf[8], buf[9], buf[15]
    anchor, cell = index[0], index[1]
    row = w * C
    for k in range(n):
        ahead = cell[min(k + _AHEAD, n - 1)] * C
        for c in range(0, 2 * C, _LINE):
            prefetch(features, ahead + c)
            prefetch(features, ahead + row + c)
        a, b = ka[k], kb[k]
        i, j = cell[k] * C, anchor[k] * C
        f00, f01 = features[i : i + C], features[i + C : i + 2 * C]
        f10 = features[i + row : i + row + C]
        f11 = features[i + row + C : i + row + 2 * C]
        fr = anchor_features[j : j + C]
        e = _F(0)
        for c in range(C):
            top = f00[c] + a * (f01[c] - f00[c])
            low = f10[c] + a * (f11[c] - f10[c])
            r = top + b * (low - top) - fr[c]
            e += r * r
        ke[k] = e


@njit(forceinline=True, **JIT)
def _evaluate(  # type: ignore[no-untyped-def]
    C, R, t, focal, centre, points, features, confidence, anchor_features, anchor_confidence,
    h, w, delta, redescending, min_visible, prior_R, prior_t, information, prior_weight,
    derive, buf, index, work, sums,
):  # fmt: skip
    """Score of a pose and the count of anchors in view; sums gets H and g if `derive`."""
    _project(R, t, points, focal, centre, buf)
    n = _compact(points.shape[1], h, w, buf, index)
    if n < min_visible:
        return np.inf, n
    if derive:
        _sample(C, n, w, features, anchor_features, buf, index)
    else:
        _residuals(C, n, w, features, anchor_features, buf, index)
    cost, total = _weigh(n, w, confidence, anchor_confidence, _F(delta), redescending, buf, index)
    if not total > _F(0):
        return np.inf, n
    inverse = 1.0 / total
    if derive:
        _accumulate(n, t, focal, buf, sums)
        for i in range(27):
            sums[i] *= inverse
    score = cost * inverse
    if prior_weight > 0.0:
        score += add_prior(R, t, prior_R, prior_t, information, prior_weight, sums, work)
    return score, n


@lru_cache
def refine_kernel(channels: int) -> Callable[..., int]:
    """The compiled kernel for feature maps of `channels` channels.

    It closes over the number alone. Numba's cache on disk identifies closures by their pickled
    variables. A pickled compiled function contains a number of its process, so the kernel would be
    compiled in every process again. Therefore the functions that need the number as a constant are
    inlined.
    """
    C = channels

    @njit(**JIT)
    def refine(  # type: ignore[no-untyped-def]
        start, stop, R, t, scores, visible, focal, centre, points, features, confidence,
        anchor_features, anchor_confidence, h, w, iterations, delta, redescending, damping0,
        down, up, min_visible, prior_R, prior_t, information, prior_weight, buf, index, work,
        sums, best, R_try,
    ):  # fmt: skip
        """Levenberg-Marquardt (equations 8 and 9) on hypotheses start to stop, in place."""
        scale, step, L, t_try = work[14], work[15], work[16:22], work[22, :3]
        evaluations = 0
        for m in range(start, stop):
            damping, scores[m] = damping0, np.inf
            R_try[:], t_try[:] = R[m], t[m]
            for k in range(iterations + 1):  # one call, since it is inlined: the first scores only
                if k > 0:
                    if not solve(best, t[m], damping, work, scale, L, step):
                        break
                    retract(R[m], t[m], step, R_try, t_try)
                score, n = _evaluate(
                    C, R_try, t_try, focal, centre, points, features, confidence, anchor_features,
                    anchor_confidence, h, w, delta, redescending, min_visible, prior_R, prior_t,
                    information, prior_weight, k < iterations, buf, index, work, sums,
                )  # fmt: skip
                evaluations += 1
                if k == 0:
                    visible[m] = n
                    if not score < np.inf:
                        break
                if score < scores[m]:
                    scores[m], visible[m] = score, n
                    R[m], t[m] = R_try, t_try
                    best, sums = sums, best
                    damping *= down if k > 0 else 1.0
                else:
                    damping *= up
        return evaluations

    kernel: Callable[..., int] = refine
    return kernel


class NumbaBackend:
    """Splits the hypotheses over threads. One `refine` at a time: it reuses its scratch."""

    def __init__(self, threads: int = 2) -> None:
        self.name = f"numba ({threads} thread{'s' if threads > 1 else ''}, float32)"
        self._threads = threads
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="registration")
        self._scratch: list[tuple[np.ndarray, ...]] = []

    def refine(
        self,
        problem: LevelProblem,
        rotations: Array,
        translations: Array,
        iterations: int,
        settings: LMSettings,
    ) -> Refinement:
        """See `Backend.refine`."""
        R = np.array(rotations, dtype=np.float64, order="C")
        t = np.array(translations, dtype=np.float64, order="C")
        M, N = len(R), problem.points.shape[1]
        scores, visible = np.empty(M), np.empty(M, dtype=np.int64)
        h, w, C = problem.features.shape
        kernel = refine_kernel(C)
        prior = problem.prior
        prior_R = np.eye(3) if prior is None else prior.camera_from_local.rotation
        prior_t = np.zeros(3) if prior is None else prior.camera_from_local.translation
        information = np.zeros((6, 6)) if prior is None else prior.information
        arguments = (
            R, t, scores, visible,
            np.asarray(problem.focal), np.asarray(problem.centre), problem.points,
            problem.features.reshape(-1), problem.confidence.reshape(-1),
            problem.anchor_features.reshape(-1), problem.anchor_confidence,
            h, w, iterations, float(settings.scale), settings.redescending, float(settings.damping),
            float(settings.damping_down), float(settings.damping_up),
            minimum_visible(problem, settings),
            np.ascontiguousarray(prior_R), np.ascontiguousarray(prior_t),
            np.ascontiguousarray(information), 0.0 if prior is None else float(prior.weight),
        )  # fmt: skip
        workers = max(1, min(self._threads, M // _HYPOTHESES_PER_THREAD))
        scratch = self._workspace(N)
        cuts = np.linspace(0, M, workers + 1).astype(int)
        if workers == 1:
            evaluations = kernel(0, M, *arguments, *scratch[0])
        else:
            jobs = [
                self._pool.submit(kernel, cuts[i], cuts[i + 1], *arguments, *scratch[i])
                for i in range(workers)
            ]
            evaluations = sum(job.result() for job in jobs)
        return Refinement(R, t, scores, visible / N, int(evaluations))

    def _workspace(self, anchors: int) -> list[tuple[np.ndarray, ...]]:
        """Each worker's scratch, the last arguments of the kernel."""
        if not self._scratch or self._scratch[0][0].shape[1] < anchors:
            self._scratch = [
                (
                    np.empty((_ROWS, anchors), np.float32),
                    np.empty((2, anchors), np.int64),
                    np.empty((_WORK, 6)),
                    np.empty(_SUMS),
                    np.empty(_SUMS),
                    np.empty((3, 3)),
                )
                for _ in range(self._threads)
            ]
        return self._scratch
