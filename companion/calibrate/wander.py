"""Errors that are correlated in time: their sigma and correlation time.

Each source is a Gauss-Markov process. Positions have errors along the world's axes. Attitudes have
errors about the camera's axes (gimbal, seconds) and about the vertical (compass, a minute).
Separating the two keeps a heading error from hiding the boresight error, and gives correct sigmas
for both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import minimize

from companion.calibrate import unknowns as u
from localizer.geometry.pose import Array

_MEMORIES_S = np.array([0.1, 0.3, 1.0, 2.0, 4.0, 8.0, 15.0, 30.0, 60.0])
_LONG_STEP_S, _LEAST_STEPS = 8.0, 8  # beyond an EKF's own memory; fewer steps say nothing
_AS_LIKELY = 1.0  # of minus twice the logarithm of the likelihood
_COMPASS_S = 60.0
_USUAL_S, _UNUSUAL = 8.0, 1.0  # of a gimbal's memory: the middle, and one sigma of its logarithm
_SHORTEST_S, _LONGEST_S = 0.5, 60.0
_LARGEST = 40.0  # times the least: where the search for a sigma ends
_FEW = 100  # frames suffice for the sigmas


@dataclass(frozen=True)
class GaussMarkovProcess:
    """Error process, independent along three axes. sigma, memory_s (correlation time): (3,)."""

    sigma: Array
    memory_s: Array

    def whitened(self, values: Array, times_s: Array, white: float) -> Array:
        """Residuals (K, 3, n) at times_s (K,), without the part that is predicted from earlier
        ones, in sigmas: (3 K, n).

        white: sigma of uncorrelated noise, in the unit of the residuals.
        """
        gaps = np.diff(times_s)[:, None]
        kept = np.concatenate([np.zeros((1, 3)), np.exp(-gaps / self.memory_s)])
        sigma = np.sqrt(self.sigma**2 * (1.0 - kept**2) + white**2 * (1.0 + kept**2))[..., None]
        made = values / sigma
        made[1:] -= kept[1:, :, None] * values[:-1] / sigma[1:]
        return made.reshape(-1, values.shape[2])

    @classmethod
    def of(cls, left: Array, times_s: Array, least: float) -> GaussMarkovProcess:
        """Estimate from residuals (K, 3) minus their mean, by restricted likelihood (Patterson
        and Thompson 1971); of equally likely correlation times it takes the longest. A shorter one
        would make the sigmas too small. least: of the sigmas.
        """
        sigmas, memories = np.zeros(3), np.zeros(3)
        gaps, free_of_mean = np.diff(times_s), len(times_s) - 1
        for axis in range(3):
            e = left[:, axis]
            found = []
            for memory_s in _MEMORIES_S:
                squares, likely = _restricted(e, gaps, memory_s)
                variance = max(squares / free_of_mean, least**2)
                cost = squares / variance + free_of_mean * np.log(variance) + likely
                found.append((cost, np.sqrt(variance)))
            costs = np.array([cost for cost, _ in found])
            longest = int(np.flatnonzero(costs < costs.min() + _AS_LIKELY)[-1])
            sigmas[axis], memories[axis] = found[longest][1], _MEMORIES_S[longest]
        return cls(sigmas, memories)

    def over_long_steps(self, left: Array, times_s: Array) -> GaussMarkovProcess:
        """The same correlation times, with sigmas at least those of the residuals' changes over
        `_LONG_STEP_S`.

        An EKF smooths its receiver's errors from frame to frame, so short steps underestimate its
        drift. left: residuals (K, 3); times_s: (K,) their times.
        """
        spacing_s = max(float(np.median(np.diff(times_s))), 1e-3)
        stride = max(1, round(_LONG_STEP_S / spacing_s))
        begins = [k for k in range(stride) if len(times_s[k::stride]) >= _LEAST_STEPS]
        if not begins:
            return self
        sigma = self.sigma.copy()
        for axis, memory_s in enumerate(self.memory_s):
            squares = told = 0.0
            for k in begins:
                some = times_s[k::stride]
                squares += _restricted(left[k::stride, axis], np.diff(some), memory_s)[0]
                told += len(some) - 1
            sigma[axis] = max(sigma[axis], np.sqrt(squares / told))
        return GaussMarkovProcess(sigma, self.memory_s)


def _restricted(errors: Array, gaps_s: Array, memory_s: float) -> tuple[float, float]:
    """Minus twice the restricted log likelihood, in two parts: the sum of squares of the errors
    (K,) minus their mean, in units of their variance, and the remaining terms. memory_s:
    correlation time of the errors.
    """
    kept = np.exp(-gaps_s / memory_s)
    free = np.maximum(1.0 - kept**2, 1e-6)
    white = np.concatenate([errors[:1], (errors[1:] - kept * errors[:-1]) / np.sqrt(free)])
    ones = np.concatenate([[1.0], (1.0 - kept) / np.sqrt(free)])
    told = float(ones @ ones)
    squares = float(white @ white) - float(ones @ white) ** 2 / told
    return squares, float(np.log(free).sum()) + float(np.log(told))


@dataclass(frozen=True)
class AttitudeProcess:
    """Error process of attitudes, rad. sigma: (5,) about the camera's three axes, about the
    vertical of a gimbal, and about that of a compass; memory_s: correlation time of the gimbal's
    errors. up: (K, 3), the vertical in each camera's axes.
    """

    sigma: Array
    memory_s: float
    up: Array

    def whitened(self, values: Array, times_s: Array, white: float) -> Array:
        """As `GaussMarkovProcess.whitened`."""
        C: Array = np.eye(self.up.size) * white**2
        for part in _covariances(np.log(self.sigma), self.memory_s, self.up, times_s):
            C += part
        factor = np.linalg.cholesky(C)
        flat = values.reshape(len(C), -1)
        return np.asarray(solve_triangular(factor, flat, lower=True, check_finite=False))

    @classmethod
    def of(
        cls, left: Array, up: Array, times_s: Array, least: float, white: float
    ) -> AttitudeProcess:
        """Estimate from residuals (K, 3) of a solution with mounting and heading, by restricted
        likelihood as `GaussMarkovProcess.of`. If a flight cannot separate vertical and boresight,
        each gets half of the error. up: (K, 3), as stored; white: sigma of uncorrelated noise.
        """
        few = np.unique(np.linspace(0, len(times_s) - 1, min(_FEW, len(times_s))).round())
        k = few.astype(int)
        likelihood = Likelihood(left[k], up[k], times_s[k], white)
        low, high = np.log(least), np.log(_LARGEST * least)
        first = np.clip(np.log(max(float(left.std()), least)), low, high)
        slow = low - 1.0
        bounds = [(low, high)] * 3 + [(slow, high)] * 2
        start = np.append(np.full(5, first), np.log(_USUAL_S))
        found = minimize(
            likelihood, start, jac=True, method="L-BFGS-B",
            bounds=[*bounds, (np.log(_SHORTEST_S), np.log(_LONGEST_S))],
        )  # fmt: skip
        return cls(np.exp(found.x[:5]), float(np.exp(found.x[5])), up)


class Likelihood:
    """Minus twice the log of the restricted likelihood, with derivatives by the logarithms of five
    sigmas and of the correlation time.
    """

    def __init__(self, left: Array, up: Array, times_s: Array, white: float) -> None:
        self._left, self._up, self._times_s, self._white = left.ravel(), up, times_s, white
        columns = np.concatenate([np.broadcast_to(np.eye(3), (len(up), 3, 3)), up[..., None]], 2)
        self._columns = columns.reshape(-1, 4)
        taken = [*range(u.MOUNT.start, u.MOUNT.stop), u.HEADING]
        self._prior = np.diag(1.0 / u.SIGMAS[taken] ** 2)

    def __call__(self, logs: Array) -> tuple[float, Array]:
        """At six logarithms: the value, and its derivatives (6,)."""
        memory_s = float(np.exp(logs[5]))
        parts = _covariances(logs[:5], memory_s, self._up, self._times_s)
        C = sum(parts) + np.eye(len(self._left)) * self._white**2
        factor = cho_factor(C, lower=True, check_finite=False)
        inverse = cho_solve(factor, np.eye(len(C)), check_finite=False)
        x = inverse @ self._columns
        normal = self._columns.T @ x + self._prior
        projected = inverse - x @ np.linalg.solve(normal, x.T)
        e = projected @ self._left
        unusual = (logs[5] - np.log(_USUAL_S)) / _UNUSUAL
        cost = float(self._left @ e) + float(np.linalg.slogdet(normal)[1]) + unusual**2
        cost += 2.0 * float(np.log(np.diagonal(factor[0])).sum())
        gaps = np.abs(self._times_s[:, None] - self._times_s) / memory_s
        lasting = sum(parts[:4]) * np.kron(gaps, np.ones((3, 3)))
        slopes = [2.0 * part for part in parts] + [lasting]
        gradient = np.array([float((projected * d).sum() - e @ d @ e) for d in slopes])
        gradient[5] += 2.0 * unusual / _UNUSUAL
        return cost, gradient


def _covariances(logs: Array, memory_s: float, up: Array, times_s: Array) -> list[Array]:
    """Covariance (3 K, 3 K) of each of the five sources."""
    gaps = np.abs(times_s[:, None] - times_s)
    quick, slow = np.exp(-gaps / memory_s), np.exp(-gaps / _COMPASS_S)
    upright = up.reshape(-1, 1) @ up.reshape(1, -1)
    variances = np.exp(2.0 * logs)
    axes = [
        variance * np.kron(quick, np.diag(axis))
        for variance, axis in zip(variances[:3], np.eye(3), strict=True)
    ]
    ones = np.ones((3, 3))
    return [
        *axes, variances[3] * upright * np.kron(quick, ones),
        variances[4] * upright * np.kron(slow, ones),
    ]  # fmt: skip
