"""Least squares over all frames: the shared values and every frame's pose.

Image noise is independent between patches. Errors of the autopilot's attitude and position are
correlated over seconds, so each is a Gauss-Markov process (`wander`) whose sigma and correlation
time are estimated from the residuals.

Images of the same ground have the same map errors, so a second image adds little information. The
images' part of the covariance is therefore computed from each image's gradient together with those
of neighbouring images (Conley 1999).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from companion.calibrate import unknowns as u
from companion.calibrate.evidence import CalibrationProblem, Guess
from companion.calibrate.wander import AttitudeProcess, GaussMarkovProcess
from localizer.geometry.pose import Array

_ROUNDS, _STEPS = 4, 5  # of noise, and of the poses and numbers under it
# Weight of the variance of a picture's parts: their errors are correlated.
_ALIKE = 6.0
_CAUCHY = 2.5  # sigmas
_WHITE = {"attitudes": np.radians(0.03), "places": 0.03}  # of what has no memory: rad, m
_LEAST = {"attitudes": np.radians(0.05), "places": 0.08}
_FIRST = {"attitudes": np.radians(0.5), "places": 0.4}
_FIRST_MEMORY_S = 5.0
_DIFFERENCE = 1e-5
_CONVERGED = 1e-3  # of a sigma


@dataclass(frozen=True)
class Solution:
    """Result of the least-squares solution. guess: the most probable corrections
    and poses. covariance: (COUNT, COUNT) of the corrections, with the weak priors; information: of
    them, from the flight alone. pixel_sigma: sigma of a patch, px.
    """

    guess: Guess
    covariance: Array
    information: Array
    pixel_sigma: float
    attitude: AttitudeProcess
    place: GaussMarkovProcess


@dataclass(frozen=True)
class _Noise:
    """Assumed measurement noise; weight: (N,) of the patches."""

    pixel_sigma: float
    weight: Array
    attitude: AttitudeProcess
    place: GaussMarkovProcess


def solve(
    problem: CalibrationProblem, fixed: NDArray[np.bool_] | None = None, sigmas: Array = u.SIGMAS
) -> Solution:
    """Estimate `UNKNOWNS`, corrections of the deployment's values, and every frame's pose. fixed:
    (COUNT,) bool, True keeps a correction at 0, None: none; sigmas: (COUNT,) of the weak priors,
    whose means are 0.
    """
    guess = problem.start
    still = np.zeros(u.COUNT, bool) if fixed is None else fixed
    prior: Array = 1.0 / sigmas**2 * np.where(still, 1e12, 1.0)
    up = guess.rotations[:, 2]
    attitude = AttitudeProcess(np.full(5, _FIRST["attitudes"]), _FIRST_MEMORY_S, up)
    place = GaussMarkovProcess(np.full(3, _FIRST["places"]), np.full(3, _FIRST_MEMORY_S))
    noise = _Noise(1.0, np.ones(len(problem.owner)), attitude, place)
    for _ in range(_ROUNDS):
        for _ in range(_STEPS):
            H, g = _normal(problem, guess, noise, prior)
            factor = cho_factor(H, lower=True, check_finite=False)
            step = -cho_solve(factor, g, check_finite=False)
            frames = step[u.COUNT :].reshape(-1, 6)
            guess = guess.stepped(step[: u.COUNT], frames)
            if np.abs(step[: u.COUNT] / u.USEFUL).max() < _CONVERGED:
                break
        noise = _noise(problem, guess, noise)
    noise = _with_long_term_errors(problem, guess, noise)
    H, _ = _normal(problem, guess, noise, prior)
    shared = np.eye(len(H), u.COUNT)
    gain: Array = cho_solve(cho_factor(H, lower=True), shared).T
    pictures = _pictures(problem, guess, noise)
    alone, larger = images_covariance(gain, u.COUNT, pictures, problem.grounds)
    P = gain[:, : u.COUNT] + alone * (np.outer(larger, larger) - 1.0)
    P = 0.5 * (P + P.T)
    information: Array = np.linalg.inv(P).astype(np.float64) - np.diag(prior)
    return Solution(guess, P, information, noise.pixel_sigma, noise.attitude, noise.place)


def _noise(problem: CalibrationProblem, guess: Guess, before: _Noise) -> _Noise:
    off = problem.pixel_residuals(guess)
    squares = (off**2).sum(axis=1)
    sigma = float(np.sqrt(np.median(squares) / (2.0 * np.log(2.0))))
    weight = 1.0 / (1.0 + squares / (_CAUCHY * sigma) ** 2)
    attitude = AttitudeProcess.of(
        problem.attitude_residuals(guess), guess.rotations[:, 2], problem.times_s,
        _LEAST["attitudes"], _WHITE["attitudes"],
    )  # fmt: skip
    place, placed = before.place, problem.placed
    if placed.any():
        left = problem.place_residuals(guess)[placed]
        place = GaussMarkovProcess.of(left, problem.times_s[placed], _LEAST["places"])
    return replace(before, pixel_sigma=sigma, weight=weight, attitude=attitude, place=place)


def _with_long_term_errors(problem: CalibrationProblem, guess: Guess, noise: _Noise) -> _Noise:
    """Noise whose position errors are those over minutes, for the reported covariance."""
    placed = problem.placed
    if not placed.any():
        return noise
    left = problem.place_residuals(guess)[placed]
    return replace(noise, place=noise.place.over_long_steps(left, problem.times_s[placed]))


def _normal(
    problem: CalibrationProblem, guess: Guess, noise: _Noise, prior: Array
) -> tuple[Array, Array]:
    """Normal equations over (shared, frame 0, frame 1, ...): (M, M) and (M,). prior: (COUNT,)
    information of the weak priors; very large for a fixed value.
    """
    K = len(problem.times_s)
    M = u.COUNT + 6 * K
    H, g = np.zeros((M, M)), np.zeros(M)
    _add_pictures(_pictures(problem, guess, noise), H, g)
    _add_wander(problem.attitude_residuals, "attitudes", noise.attitude, problem, guess, H, g)
    if problem.placed.any():
        _add_wander(problem.place_residuals, "places", noise.place, problem, guess, H, g)
    H[range(u.COUNT), range(u.COUNT)] += prior
    g[: u.COUNT] += prior * guess.shared
    H[range(u.COUNT, M), range(u.COUNT, M)] += 1e-9
    return H, g


def _derivatives(
    function: Callable[[Guess], Array], guess: Guess, shared: range
) -> tuple[Array, Array, Array]:
    """Values (n, d), derivatives (n, d, 6) by each one's frame and (n, d, COUNT) by `shared`."""
    K = len(guess.places)
    value = function(guess)
    by_frame = np.zeros((*value.shape, 6))
    none = np.zeros(u.COUNT)
    for j in range(6):
        h = _DIFFERENCE * (1.0 if j < 3 else 0.01)
        step = np.zeros((K, 6))
        step[:, j] = h
        by_frame[..., j] = (function(guess.stepped(none, step)) - value) / h
    by_shared = np.zeros((*value.shape, u.COUNT))
    still = np.zeros((K, 6))
    for j in shared:
        step = none.copy()
        step[j] = h = 1e-4 * u.USEFUL[j]
        by_shared[..., j] = (function(guess.stepped(step, still)) - value) / h
    return value, by_frame, by_shared


def _pictures(problem: CalibrationProblem, guess: Guess, noise: _Noise) -> ImageNormalEquations:
    optics = range(*u.OPTICS.indices(u.COUNT))
    value, by_frame, by_shared = _derivatives(problem.pixel_residuals, guess, optics)
    weight = noise.weight / (noise.pixel_sigma**2 * _ALIKE)
    by_optics = by_shared[..., u.OPTICS]
    return ImageNormalEquations.of(problem.owner, weight, value, by_frame, by_optics)


def _add_pictures(pictures: ImageNormalEquations, H: Array, g: Array) -> None:
    S, of = u.COUNT, u.OPTICS
    H[of, of] += pictures.shared.sum(axis=0)
    g[of] += pictures.shared_pull.sum(axis=0)
    for k, both in enumerate(pictures.both):
        at = slice(S + 6 * k, S + 6 * k + 6)
        H[at, at] += pictures.own[k]
        H[at, of] += both
        H[of, at] += both.T
        g[at] += pictures.pull[k]


def _add_wander(
    function: Callable[[Guess], Array], name: str, wander: GaussMarkovProcess | AttitudeProcess,
    problem: CalibrationProblem, guess: Guess, H: Array, g: Array,
) -> None:  # fmt: skip
    """Add the autopilot's residuals, whitened by their error process, to H and g."""
    used = problem.placed if name == "places" else np.ones(len(guess.places), bool)
    value, by_frame, by_shared = _derivatives(function, guess, range(u.LATE, u.COUNT))
    which = np.flatnonzero(used)
    times_s, S = problem.times_s[which], u.COUNT
    J = np.zeros((len(which), 3, len(g) + 1))
    for i, k in enumerate(which):
        J[i, :, S + 6 * k : S + 6 * k + 6] = by_frame[k]
    J[:, :, :S] = by_shared[which]
    J[:, :, -1] = value[which]
    flat = wander.whitened(J, times_s, _WHITE[name])
    H += flat[:, :-1].T @ flat[:, :-1]
    g += flat[:, :-1].T @ flat[:, -1]


_REACH_M = 100.0  # on the ground: about a picture's width at the heights that are flown
_MOST_ALIKE = 0.5  # of all pairs: beyond it the flight was over one place, and tells nothing of it


@dataclass(frozen=True)
class ImageNormalEquations:
    """Normal equations of K images; each depends on S shared values of the optics and on its own
    pose. own: (K, 6, 6), both: (K, 6, S), shared: (K, S, S): blocks of the matrix; pull: (K, 6),
    shared_pull: (K, S): right sides.
    """

    own: Array
    both: Array
    shared: Array
    pull: Array
    shared_pull: Array

    @classmethod
    def of(
        cls,
        owner: NDArray[np.int64],
        weight: Array,
        value: Array,
        by_frame: Array,
        by_optics: Array,
    ) -> ImageNormalEquations:
        """From N patches: values (N, 2), derivatives (N, 2, 6) and (N, 2, S). owner: (N,) image of
        each patch, ascending, each with one at least.
        """
        begins = np.flatnonzero(np.diff(owner, prepend=-1))
        weighted, weighted_optics = (weight[:, None, None] * d for d in (by_frame, by_optics))
        each = (
            np.einsum("nai,naj->nij", weighted, by_frame),
            np.einsum("nai,naj->nij", weighted, by_optics),
            np.einsum("nai,naj->nij", weighted_optics, by_optics),
            np.einsum("nai,na->ni", weighted, value),
            np.einsum("nai,na->ni", weighted_optics, value),
        )
        return cls(*(np.add.reduceat(one, begins, axis=0) for one in each))


def images_covariance(
    gain: Array, count: int, pictures: ImageNormalEquations, grounds: Array
) -> tuple[Array, Array]:
    """The images' part (C, C) of the shared values' covariance for independent image errors, and
    the factor (C,) by which correlation increases each sigma, at least 1.

    gain: (C, C + 6 K), the first rows of the inverse of the normal equations; count: C; grounds:
    (K, 2), east and north of the ground that each image shows, m.
    """
    K, S = pictures.shared_pull.shape
    alone, pulls = np.zeros((count, count)), np.zeros((K, count))
    for k in range(K):
        mine = np.concatenate([gain[:, :S], gain[:, count + 6 * k : count + 6 * k + 6]], axis=1)
        both = pictures.both[k]
        normal = np.block([[pictures.shared[k], both.T], [both, pictures.own[k]]])
        alone += mine @ normal @ mine.T
        pulls[k] = mine @ np.concatenate([pictures.shared_pull[k], pictures.pull[k]])
    apart = np.abs(grounds[:, None] - grounds)
    weight = np.maximum(1.0 - apart / _REACH_M, 0.0).prod(axis=2)
    together = np.einsum("kc,kl,lc->c", pulls, weight, pulls, optimize=True)
    # All pulls together are nothing, which takes a part of each from those around it.
    together /= 1.0 - min(float(weight.mean()), _MOST_ALIKE)
    share = together / np.maximum(np.diag(alone), 1e-30)
    return alone, np.sqrt(np.maximum(share, 1.0))
