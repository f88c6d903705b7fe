"""Errors that last from one picture to the next: how large they are, and for how long.

Each source is a Gauss-Markov process. Places err along the world's axes, each for itself. Attitudes
err about the camera's axes, and about the vertical: a heading's error (compass, the gimbal's yaw)
turns a camera that looks straight down about its boresight, and one that looks ahead sideways.
Told apart, heading does not hide the mounting, and what is said of both is as unsure as it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from companion.calibrate import unknowns as u
from localizer.geometry.pose import Array

_MEMORIES_S = np.array([0.1, 0.3, 1.0, 2.0, 4.0, 8.0, 15.0, 30.0, 60.0])
_AS_LIKELY = 1.0  # of minus twice the logarithm of the likelihood
_LARGEST = 30.0  # times the least: where the search for a sigma ends
_STEEPEST = 0.999  # of what is kept from one picture to the next


@dataclass(frozen=True)
class Wander:
    """Along three axes, each for itself. sigma, memory_s: (3,)."""

    sigma: Array
    memory_s: Array

    def whitening(self, times_s: Array, white: float) -> tuple[Array, Array]:
        """(K, 3, 3) factors of a value and of the one before it, by which what is left is white.

        white: of what has no memory.
        """
        gaps = np.diff(times_s)[:, None]
        kept = np.concatenate([np.zeros((1, 3)), np.exp(-gaps / self.memory_s)])
        variance = self.sigma**2 * (1.0 - kept**2) + white**2 * (1.0 + kept**2)
        axes = np.eye(3)
        return axes / np.sqrt(variance)[..., None], axes * (kept / np.sqrt(variance))[..., None]

    @classmethod
    def of(cls, left: Array, times_s: Array, least: float) -> Wander:
        """Of what is left over, (K, 3), whose mean was taken off it: by restricted likelihood
        (Patterson and Thompson 1971), and of memories that are about as likely the longest. Else
        what lasts looks shorter and smaller than it is, and so do the sigmas of what is found.
        """
        sigmas, memories = np.zeros(3), np.zeros(3)
        gaps, free_of_mean = np.diff(times_s), len(times_s) - 1
        for axis in range(3):
            e = left[:, axis]
            found = []
            for memory_s in _MEMORIES_S:
                kept = np.exp(-gaps / memory_s)
                free = np.maximum(1.0 - kept**2, 1e-6)
                white = np.concatenate([e[:1], (e[1:] - kept * e[:-1]) / np.sqrt(free)])
                ones = np.concatenate([[1.0], (1.0 - kept) / np.sqrt(free)])
                told = float(ones @ ones)
                squares = float(white @ white) - float(ones @ white) ** 2 / told
                variance = max(squares / free_of_mean, least**2)
                cost = squares / variance + free_of_mean * np.log(variance)
                found.append((cost + float(np.log(free).sum()) + np.log(told), np.sqrt(variance)))
            longest = _longest([cost for cost, _ in found])
            sigmas[axis], memories[axis] = found[longest][1], _MEMORIES_S[longest]
        return cls(sigmas, memories)


@dataclass(frozen=True)
class AttitudeWander:
    """Of attitudes. sigma: (3,) about the camera's axes; upright: about the vertical, rad; all keep
    their errors for memory_s. up: (K, 3), the vertical in each camera's axes.
    """

    sigma: Array
    upright: float
    memory_s: float
    up: Array

    def whitening(self, times_s: Array, white: float) -> tuple[Array, Array]:
        """As `Wander.whitening`."""
        covariance = self._covariance()
        now, before, _ = _whitening(covariance, np.diff(times_s), self.memory_s, white)
        return now, before

    def _covariance(self) -> Array:
        """(K, 3, 3) of one error."""
        outer: Array = self.up[:, :, None] * self.up[:, None, :]
        return np.diag(self.sigma**2) + self.upright**2 * outer

    @classmethod
    def of(
        cls, left: Array, up: Array, times_s: Array, least: float, white: float
    ) -> AttitudeWander:
        """Of what is left over, (K, 3), from which a mounting and a heading were taken: by
        restricted likelihood, as `Wander.of`. A flight that cannot tell the vertical from the
        boresight shares the error out between them.
        """
        gaps = np.diff(times_s)
        columns = np.concatenate([np.broadcast_to(np.eye(3), (len(up), 3, 3)), up[..., None]], 2)
        taken = np.diag(1.0 / u.SIGMAS[[*range(u.MOUNT.start, u.MOUNT.stop), u.HEADING]] ** 2)
        start = np.log(np.maximum(left.std(axis=0).mean(), least)) * np.ones(4)
        found = []
        for memory_s in _MEMORIES_S:

            def cost(logs: Array, memory_s: float = float(memory_s)) -> float:
                made = _made(logs, memory_s, up)
                now, before, size = _whitening(made._covariance(), gaps, memory_s, white)
                e, x = _whitened(now, before, left[..., None]), _whitened(now, before, columns)
                x = x.reshape(-1, 4)
                normal, pull = x.T @ x + taken, x.T @ e.ravel()
                squares = float(e.ravel() @ e.ravel() - pull @ np.linalg.solve(normal, pull))
                return squares + size + float(np.linalg.slogdet(normal)[1])

            low, high = np.log(least), np.log(_LARGEST * least)
            best = minimize(cost, np.clip(start, low, high), method="L-BFGS-B",
                            bounds=[(low, high)] * 3 + [(low - 2.0, high)])  # fmt: skip
            start = best.x
            found.append((float(best.fun), _made(best.x, float(memory_s), up)))
        return found[_longest([cost for cost, _ in found])][1]


def _made(logs: Array, memory_s: float, up: Array) -> AttitudeWander:
    sigmas = np.exp(logs)
    return AttitudeWander(sigmas[:3], float(sigmas[3]), memory_s, up)


def _longest(costs: list[float]) -> int:
    """Of memories that are about as likely as the likeliest."""
    values = np.array(costs)
    return int(np.flatnonzero(values < values.min() + _AS_LIKELY)[-1])


def _whitening(
    covariance: Array, gaps_s: Array, memory_s: float, white: float
) -> tuple[Array, Array, float]:
    """Factors (K, 3, 3) of a value and of the one before; log of their errors' determinants."""
    values, vectors = np.linalg.eigh(covariance)
    root = (vectors * np.sqrt(values)[:, None]) @ np.swapaxes(vectors, 1, 2)
    undo = (vectors / np.sqrt(values)[:, None]) @ np.swapaxes(vectors, 1, 2)
    kept = np.minimum(np.exp(-gaps_s / memory_s), _STEEPEST)[:, None, None]
    carried = np.zeros_like(covariance)
    carried[1:] = kept * root[1:] @ undo[:-1]
    new = covariance.copy()
    new[1:] *= 1.0 - kept**2
    new += white**2 * (np.eye(3) + carried @ np.swapaxes(carried, 1, 2))
    factor = np.linalg.cholesky(new)
    now = np.linalg.inv(factor)
    size = 2.0 * float(np.log(np.diagonal(factor, axis1=1, axis2=2)).sum())
    return now, now @ carried, size


def _whitened(now: Array, before: Array, values: Array) -> Array:
    """Values (K, 3, n) less what is left of the ones before them."""
    made = now @ values
    made[1:] -= before[1:] @ values[:-1]
    return made
