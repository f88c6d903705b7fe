"""One target's position over time: whether it moves, and on which surface that its pixels may show.

A sum of hypotheses (Alspach and Sorenson 1972, "Nonlinear Bayesian estimation using Gaussian sum
approximations"), one for each surface; hypotheses of different surfaces are never averaged. Each is
an interacting-multiple-model filter (Blom and Bar-Shalom 1988) of a target that stands, of one with
constant velocity, and of one that changes it. The error of the pose is correlated in neighbouring
views, so it is a state too: many frames of one view do not claim more than its pose allows.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from filterpy.common import Q_continuous_white_noise
from filterpy.kalman import IMMEstimator, KalmanFilter

from localizer.geometry.pose import Array
from localizer.types import TargetSurface

# The models: it stands, drives on, or turns, starts and brakes. Mean time in each, s, and spectral
# density of its acceleration, east north up, m²/s³: 0.3 m/s in a second is a car in traffic, 0.15
# m/s the slope of its road; 7 m/s² for a second, what tyres hold.
_LASTS_S = np.array([60.0, 30.0, 2.0])
_ACCELERATION = ((0.0, 0.0, 0.0), (0.45, 0.45, 0.02), (100.0, 100.0, 0.02))
_STANDING, _MOVING = 0, slice(1, 3)
_SPEED_SIGMA = (10.0, 10.0, 2.0)  # m/s, of a target that begins to move
_DECORRELATES = np.radians(3.0)  # turn of the view that reduces its error's correlation to 1/e
_SAME_VIEW = float(np.cos(np.radians(4.0)))  # what is wrong with the map's edges stays the same
_GATE = 25.0  # chi-square of 2 dimensions: 1 in 300,000 is beyond
_MISSED = 1e-3  # likelihood of a pixel that shows something else
_BESIDE_M = 1.0  # along the ray: what is nearer to a surface than this, or three sigmas, is on it
_UNSEEN = 0.2  # probability of a target that its view's rays do not meet: edges of the map are off
_LEAST_SIGHT = 2.5e-3  # over all views: parallax decides, not what is wrong with the map's edge
_BUNDLES = 8  # of a view: one alone swings with its pixel's noise
_VIEWS = 32  # remembered
_NEGLIGIBLE = 1e-8
_MOST = 6
_SAME = 1.0  # squared Mahalanobis distance below which two hypotheses are one
_ELSEWHERE = 9.0  # and above which one is another place than the reported one
_FAR_M = 300.0  # sigma of the distance along a ray alone
_GRAZING = 0.05  # cosine: what is seen at less than 3 degrees is met at its middle
# The state: position m, velocity m/s, and the view's error m.
_P, _V, _E = slice(0, 3), slice(3, 6), slice(6, 9)
_H = np.hstack([np.eye(3), np.zeros((3, 3)), np.eye(3)])


@dataclass(frozen=True)
class _Sighting:
    """eye, direction: (3,) of the ray; surfaces: that its pixel may show."""

    eye: Array
    direction: Array
    surfaces: tuple[TargetSurface, ...]
    is_new_view: bool


@dataclass(frozen=True)
class _Hypothesis:
    """likelihood: of the pixels; shares: of the rays in each frame of the present view that meet
    it; sight: their product over earlier views; models: of the state above; repeats: (3, 3) m² of
    the view's error; is_seen: whether the newest sighting shows it.
    """

    likelihood: float
    models: IMMEstimator
    repeats: Array
    shares: tuple[float, ...]
    sight: float = 1.0
    is_seen: bool = True

    @property
    def share(self) -> float:
        """Mean of `shares`."""
        return max(sum(self.shares) / len(self.shares), _UNSEEN)

    @property
    def weight(self) -> float:
        """Not normalised."""
        return self.likelihood * max(self.sight * self.share, _LEAST_SIGHT)

    @property
    def position(self) -> Array:
        position: Array = self.models.x[_P]
        return position

    @property
    def covariance(self) -> Array:
        covariance: Array = self.models.P[_P, _P]
        return covariance

    @property
    def motion(self) -> tuple[Array, Array]:
        """Velocity (3,) and covariance (3, 3) of the models that move."""
        models, shares = self.models.filters[_MOVING], self.models.mu[_MOVING]
        velocities = np.array([model.x[_V] for model in models])
        return np.average(velocities, axis=0, weights=shares), np.cov(
            velocities.T, aweights=shares, ddof=0
        ) + np.average([model.P[_V, _V] for model in models], axis=0, weights=shares)


class TargetFilter:
    """Tracks one target; not thread-safe."""

    def __init__(self) -> None:
        self._hypotheses: list[_Hypothesis] = []
        self._time_ns = 0
        self._view: Array = np.zeros(3)
        self._newest: Array = np.zeros(3)
        self._eyes = deque[Array](maxlen=_VIEWS)

    @property
    def moves(self) -> bool:
        """Whether the target more probably moves than stands."""
        return bool(self._hypotheses and self._hypotheses[0].models.mu[_STANDING] < 0.5)

    @property
    def position(self) -> Array:
        """Position (3,) of the most probable surface at the last update."""
        position: Array = self._hypotheses[0].position.copy()
        return position

    @property
    def velocity(self) -> Array | None:
        """Velocity (3,), m/s, world, of a target that moves; None otherwise."""
        return self._hypotheses[0].motion[0] if self.moves else None

    @property
    def velocity_covariance(self) -> Array | None:
        """Covariance (3, 3) m²/s² of `velocity`, of the reported surface alone."""
        return self._hypotheses[0].motion[1] if self.moves else None

    def expected(self, time_ns: int) -> tuple[Array, Array]:
        """Predicted position (3,), world m, and covariance (3, 3) of the most probable surface
        alone; `update` first.
        """
        best = self._hypotheses[0]
        if self.moves:
            best = _predicted(best, (time_ns - self._time_ns) * 1e-9, 0.0)
        return best.position.copy(), best.covariance.copy()

    def place(self, bias: Array) -> tuple[Array, Array, float]:
        """Position (3,) of the most probable surface at the last update, the mean square (3, 3) of
        all surfaces about it, and the probability of other places. bias: (3, 3) m², common to all.
        """
        best = self._hypotheses[0]
        covariance, elsewhere = bias.copy(), 0.0
        total = sum(h.weight for h in self._hypotheses)
        for h in self._hypotheses:
            offset, share = h.position - best.position, h.weight / total
            covariance += share * (h.covariance + np.outer(offset, offset))
            if offset @ np.linalg.solve(best.covariance + bias, offset) > _ELSEWHERE:
                elsewhere += share
        return best.position.copy(), covariance, elsewhere

    def update(
        self, eye: Array, direction: Array, surfaces: tuple[TargetSurface, ...], time_ns: int
    ) -> bool:
        """Fuse a sighting of at least one surface, later than the last one; whether the most
        probable hypothesis explains it. eye, direction: (3,) of the ray, unit length.
        """
        turn = float(np.arccos(np.clip(direction @ self._newest, -1.0, 1.0)))
        is_new_view = float(direction @ self._view) < _SAME_VIEW
        if is_new_view:
            self._view = direction
            self._eyes.append(eye)
        elapsed_s = max((time_ns - self._time_ns) * 1e-9, 1e-3)
        self._time_ns, self._newest = time_ns, direction
        sighting = _Sighting(eye, direction, surfaces, is_new_view)
        known = [_met(_predicted(h, elapsed_s, turn), sighting) for h in self._hypotheses]
        unmet = [
            s for s in surfaces if not any(h.is_seen and _is_on(h, s, direction) for h in known)
        ]
        new = [_begun(sighting, s) for s in unmet]
        if known:
            best = max(known, key=lambda h: h.weight)
            new = [_compared(h, best, self._eyes) for h in new]
        self._hypotheses = _reduced(known + new)
        return self._hypotheses[0].is_seen


def _is_on(h: _Hypothesis, surface: TargetSurface, direction: Array) -> bool:
    """Whether a hypothesis is at the depth of a surface of the ray."""
    off = abs(float((surface.position - h.position) @ direction))
    sigma = float(np.sqrt(direction @ surface.covariance @ direction))
    return off <= max(_BESIDE_M, 3.0 * sigma)


def _begun(sighting: _Sighting, surface: TargetSurface) -> _Hypothesis:
    """A hypothesis where the ray meets the plane of a surface."""
    x, P = np.zeros(9), np.zeros((9, 9))
    d, n = sighting.direction, surface.normal
    away, cosine = surface.position - sighting.eye, float(n @ d)
    distance = float(n @ away) / cosine if abs(cosine) > _GRAZING else float(d @ away)
    x[_P] = sighting.eye + distance * d
    P[_P, _P], P[_E, _E] = surface.covariance, surface.repeats
    P[_P, _E] = P[_E, _P] = -surface.repeats
    P[_V, _V] = np.diag(np.square(_SPEED_SIGMA))
    models = []
    for _ in _LASTS_S:
        model = KalmanFilter(9, 3)
        model.x, model.P, model.H = x.copy(), P.copy(), _H
        models.append(model)
    estimator = IMMEstimator(models, _LASTS_S / _LASTS_S.sum(), np.eye(len(models)))
    return _Hypothesis(1.0, estimator, surface.repeats, (surface.probability,))


def _compared(new: _Hypothesis, best: _Hypothesis, eyes: Collection[Array]) -> _Hypothesis:
    """A new hypothesis beside earlier ones. No earlier ray met it. It explains the pixels as well
    as the best one; if the two are apart as seen from an earlier view, `_MISSED` times as well.
    eyes: (3,) of the views.
    """
    offset, farthest = new.position - best.position, 0.0
    for eye in eyes:
        d = (best.position - eye) / np.linalg.norm(best.position - eye)
        S = new.covariance + best.covariance + _FAR_M**2 * np.outer(d, d)
        farthest = max(farthest, float(offset @ np.linalg.solve(S, offset)))
    agreement = float(np.exp(-0.5 * farthest * best.models.mu[_STANDING]))
    return replace(
        new,
        likelihood=best.likelihood * max(agreement, _MISSED),
        shares=(0.0,) * (len(best.shares) - 1) + new.shares,
        sight=_UNSEEN ** (len(eyes) - 1),
    )


def _copied(h: _Hypothesis, changes: Array) -> IMMEstimator:
    """A copy whose predictions and updates leave the original unchanged. changes: (3, 3)
    probabilities of the next model, by the present one.
    """
    return IMMEstimator([copy(model) for model in h.models.filters], h.models.mu, changes)


def _predicted(h: _Hypothesis, elapsed_s: float, turn: float) -> _Hypothesis:
    """turn: of the view meanwhile, rad. To a target that moves, the view's errors are white."""
    stays = np.exp(-elapsed_s / _LASTS_S)
    n = len(stays)
    changes = np.diag(stays) + (1.0 - np.eye(n)) * (1.0 - stays)[:, None] / (n - 1)
    models = _copied(h, changes)
    for model, density in zip(models.filters, _ACCELERATION, strict=True):
        model.F, model.Q = np.eye(9), np.zeros((9, 9))
        model.F[_P, _V] = elapsed_s * np.eye(3)
        model.Q[:6, :6] = np.kron(Q_continuous_white_noise(2, elapsed_s), np.diag(density))
        kept = 0.0 if any(density) else float(np.exp(-turn / _DECORRELATES))
        model.F[_E, _E], model.Q[_E, _E] = kept * np.eye(3), (1.0 - kept**2) * h.repeats
    standing = models.filters[_STANDING]
    standing.F[:, _V], standing.Q[_V, _V] = np.zeros((9, 3)), np.diag(np.square(_SPEED_SIGMA))
    models.predict()
    return replace(h, models=models)


def _met(h: _Hypothesis, sighting: _Sighting) -> _Hypothesis:
    """The hypothesis with a sighting: unchanged but less likely if its ray is beyond the gate.

    The ray decides between standing and moving, and between the surfaces. Its depth only keeps a
    moving target on the map: a standing one was placed there once, and its error stays the same.
    """
    eye, d = sighting.eye, sighting.direction
    nearest = min(sighting.surfaces, key=lambda s: abs(float((s.position - h.position) @ d)))
    along = _FAR_M**2 * np.outer(d, d)
    models = _copied(h, h.models.M)
    for model in models.filters:
        model.R = nearest.covariance - nearest.repeats + along
    models.update(eye + d * float((h.position - eye) @ d))
    if min(model.mahalanobis for model in models.filters) ** 2 > _GATE:
        return replace(h, likelihood=h.likelihood * _MISSED, is_seen=False)
    height = np.sqrt(np.linalg.det(2.0 * np.pi * (nearest.covariance + along)))
    likelihood = h.likelihood * height * float(models.likelihood @ h.models.cbar)
    on = [s for s in sighting.surfaces if _is_on(h, s, d)]
    share = sum(s.probability for s in on)
    off = float((nearest.position - h.position) @ d)
    if off**2 <= _GATE * float(d @ (nearest.covariance + models.P[_P, _P]) @ d):
        across = _FAR_M**2 * np.eye(3) - along
        known, measured = (
            float(d @ models.filters[_STANDING].P[_P, _P] @ d),
            float(d @ nearest.covariance @ d),
        )
        for k, model in enumerate(models.filters):
            if k == _STANDING:
                if measured >= known:
                    continue
                model.R = across + np.outer(d, d) * measured * known / (known - measured)
            else:
                model.R = nearest.covariance + across
            model.update(nearest.position)
        models = IMMEstimator(models.filters, models.mu, models.M)
    # What is wrong with the map's edge is wrong in all frames of one place; what moves leaves it.
    stands = models.mu[_STANDING]
    likelihood *= max(share, _UNSEEN) ** (1.0 - stands)
    met = _Hypothesis(likelihood, models, nearest.repeats, (*h.shares, share)[-_BUNDLES:], h.sight)
    if sighting.is_new_view:
        return replace(met, shares=(share,), sight=h.sight * h.share**stands)
    return met


def _is_within(a: _Hypothesis, b: _Hypothesis) -> bool:
    offset = a.position - b.position
    return bool(offset @ np.linalg.solve(b.covariance, offset) < _SAME)


def _reduced(hypotheses: list[_Hypothesis]) -> list[_Hypothesis]:
    """The hypotheses, normalised; equal ones are joined, negligible dropped. The first is that of
    the smallest expected error.
    """
    kept: list[_Hypothesis] = []
    total = sum(h.weight for h in hypotheses)
    for h in sorted(hypotheses, key=lambda h: -h.weight):
        is_new = not any(_is_within(h, k) and _is_within(k, h) for k in kept)
        if is_new and len(kept) < _MOST and h.weight >= _NEGLIGIBLE * total:
            kept.append(replace(h, likelihood=h.likelihood / total))
    at, weights = np.array([h.position for h in kept]), np.array([h.weight for h in kept])
    first = int(np.argmin(np.linalg.norm(at[:, None] - at, axis=2) @ weights))
    return [kept.pop(first), *kept]
