"""Estimates a static target's position from several viewpoints; wrong hypotheses are dropped.

Every surface hit by an observation's rays starts a hypothesis, a point on that surface's plane. As
the aircraft moves, parallax pulls wrong hypotheses off their planes or away from the rays, and each
must have been visible where the target was seen. Pose errors repeat between images of the same
view, so rays are averaged per viewpoint: only pixel noise averages out within one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from localizer.geometry.pose import Array
from localizer.targets.locate import RaySpread
from localizer.types import TargetSurface

_Item = TypeVar("_Item")
_SAME_VIEW = float(np.cos(np.radians(2.0)))
_MOST_VIEWS = 32
_AVERAGED = 5  # pixels of one viewpoint: a detector's aim is off alike in all of them
_TORN = 16.0  # squared Mahalanobis distance at which a viewpoint's ray says no more
_HUBER = 2.5
_BUNDLES = 8  # of a viewpoint: one alone swings with its pixel's noise
_UNSEEN = 0.2  # how likely a viewpoint reports a pixel whose bundle does not meet the place
_LEAST_SIGHT = -6.0  # log: parallax decides, not what is wrong with the map's edge in every view
_BESIDE_M = 1.0  # along the ray: what is nearer to a surface than this is on it
_SAME_PLACE = 9.0  # squared Mahalanobis distance
_NEGLIGIBLE = 1e-3
_MOST_PLACES = 6
_RECENT = 6
_ROUGHER = 1.5  # a much rougher surface says less of the plane than the one that is known
_OUTLIER = 36.0
_STEPS = 4
_FAR_M = 300.0  # what holds a point along rays that are parallel to its plane


@dataclass(frozen=True)
class ObservedRay:
    """A target's pixel in one frame as a ray. eye, direction: (3,) world axes, direction of unit
    length.
    """

    eye: Array
    direction: Array
    spread: RaySpread


@dataclass(frozen=True)
class PositionHypothesis:
    """A possible target position. weight: probability; position: (3,) m; covariance: (3, 3) m²."""

    weight: float
    position: Array
    covariance: Array


@dataclass(frozen=True)
class _View:
    """Rays of about one viewpoint, averaged. pixel, pose: (3, 3) rad², world axes, of one ray."""

    count: int
    eye: Array
    direction: Array
    sideways: Array
    pixel: Array
    pose: Array
    bundles: tuple[tuple[TargetSurface, ...], ...]

    @classmethod
    def of(cls, ray: ObservedRay, surfaces: tuple[TargetSurface, ...]) -> _View:
        S = ray.spread.sideways
        pixel, pose = S.T @ ray.spread.pixel @ S, S.T @ ray.spread.pose @ S
        return cls(1, ray.eye, ray.direction, S, pixel, pose, (surfaces,))

    def merged(self, other: _View) -> _View:
        """The mean of both views, with the newest ray bundles."""
        n, share = self.count + other.count, other.count / (self.count + other.count)
        mean = {
            name: (1 - share) * getattr(self, name) + share * getattr(other, name)
            for name in ("eye", "direction", "pixel", "pose")
        }
        bundles = (*self.bundles, *other.bundles)[-_BUNDLES:]
        return replace(self, count=n, bundles=bundles, **mean)

    def information(self) -> Array:
        """(2, 2) rad⁻² across the ray."""
        C = self.pixel / min(self.count, _AVERAGED) + self.pose
        information: Array = np.linalg.inv(self.sideways @ C @ self.sideways.T)
        return information

    def seen_share(self, point: Array) -> float:
        """Share of the newest bundles' rays that hit the surface at the point (3,)."""
        along = float((point - self.eye) @ self.direction)
        met = 0.0
        for s in (surface for bundle in self.bundles for surface in bundle):
            off = abs(along - float((s.position - self.eye) @ self.direction))
            sigma = float(np.sqrt(self.direction @ s.covariance @ self.direction))
            if off <= max(_BESIDE_M, 3.0 * sigma):
                met += s.probability
        return met / len(self.bundles)


@dataclass(frozen=True)
class _Hypothesis:
    """A point on a plane. anchor, normal: (3,) of the plane; sigma_m: of the map along it."""

    position: Array
    anchor: Array
    normal: Array
    sigma_m: float
    covariance: Array
    log_weight: float = 0.0


class StaticTarget:
    """All position hypotheses of a static target; not thread-safe. map_sigma_m: of the surface."""

    def __init__(self, map_sigma_m: float) -> None:
        self._map_sigma_m = map_sigma_m
        self._views: list[_View] = []
        self._recent: deque[float] = deque(maxlen=_RECENT)
        self._hypotheses: list[_Hypothesis] = []
        self.sightings = 0

    def update(self, ray: ObservedRay, surfaces: tuple[TargetSurface, ...]) -> bool:
        """Add an observation of at least one surface. False, unchanged, if its ray passes far from
        all hypotheses; the first six are never refused.
        """
        view = _View.of(ray, surfaces)
        if self._hypotheses:
            off = min(_mahalanobis(view, h) for h in self._hypotheses)
            if self.sightings >= _RECENT and off > _OUTLIER:
                return False
            self._recent.append(min(off, _TORN))
        self.sightings += 1
        self._add(view)
        self._assign_planes(surfaces)
        self._solve_all()
        return True

    @property
    def residual_ratio(self) -> float:
        """Mean squared ratio of the six newest residuals to their expected errors, at least 1."""
        n = len(self._recent)
        return max(1.0, sum(self._recent) / (2 * n)) if n else 1.0

    @property
    def moves(self) -> bool:
        """Whether the six newest observations fit no fixed position: the target moves."""
        n = len(self._recent)
        return n > 0 and sum(self._recent) > 2 * n + 8.0 * np.sqrt(n)

    def hypotheses(self) -> tuple[PositionHypothesis, ...]:
        """All of them (`update` first): that of the smallest expected error, then by weight."""
        logs = np.array([h.log_weight for h in self._hypotheses])
        weights = np.exp(logs - logs.max())
        weights /= weights.sum()
        points = np.array([h.position for h in self._hypotheses])
        apart = np.linalg.norm(points[:, None] - points[None], axis=2)
        first = int(np.argmin(apart @ weights))
        order = sorted(range(len(weights)), key=lambda i: (i != first, -weights[i]))
        return tuple(
            PositionHypothesis(float(weights[i]), points[i].copy(), self._hypotheses[i].covariance)
            for i in order
        )

    def _add(self, view: _View) -> None:
        for k, known in enumerate(self._views):
            mean = known.direction / np.linalg.norm(known.direction)
            if float(mean @ view.direction) >= _SAME_VIEW:
                self._views[k] = known.merged(view)
                return
        self._views.append(view)
        if len(self._views) > _MOST_VIEWS:
            self._views = every_second(self._views)

    def _assign_planes(self, surfaces: tuple[TargetSurface, ...]) -> None:
        """Make each surface the plane of a hypothesis that lies on it, or begin another hypothesis.

        A hypothesis never changes to a plane that it is not on. At a ridge or the foot of a wall
        the bundle's mean plane changes with the pixel and would move the hypothesis.
        """
        for surface in surfaces:
            sigma = float(np.hypot(self._map_sigma_m, surface.roughness_m))
            offs = [_apart(h, surface) for h in self._hypotheses]
            k = int(np.argmin(offs)) if offs else -1
            p, n = surface.position, surface.normal
            if k >= 0 and offs[k] < _SAME_PLACE:
                h = self._hypotheses[k]
                lift = abs(float(n @ (h.position - p)))
                if lift <= sigma <= h.sigma_m * _ROUGHER:
                    self._hypotheses[k] = replace(h, anchor=p, normal=n, sigma_m=sigma)
                    continue
                if lift <= sigma:
                    continue
                p = h.position - n * float(n @ (h.position - p))
            self._hypotheses.append(_Hypothesis(p, p, n, sigma, surface.covariance))

    def _solve_all(self) -> None:
        """Move each hypothesis to the position that plane and rays give; drop the unlikely ones."""
        stack = _ViewRays.of(self._views)
        settled = []
        for h in self._hypotheses:
            moved, cost = stack.solve(h)
            sight = sum(
                float(np.log(max(v.seen_share(moved.position), _UNSEEN))) for v in self._views
            )
            log_weight = -0.5 * cost + max(sight, _LEAST_SIGHT)
            settled.append(replace(moved, log_weight=log_weight))
        settled.sort(key=lambda h: -h.log_weight)
        least = settled[0].log_weight + float(np.log(_NEGLIGIBLE))
        kept: list[_Hypothesis] = []
        for h in settled:
            offsets = [h.position - k.position for k in kept]
            same = any(
                o @ np.linalg.solve(k.covariance, o) < 1.0
                for o, k in zip(offsets, kept, strict=True)
            )
            if h.log_weight >= least and not same and len(kept) < _MOST_PLACES:
                kept.append(h)
        self._hypotheses = kept


def every_second(views: Sequence[_Item]) -> list[_Item]:
    """Every second item, always with the newest and the first."""
    return [views[0], *views[:0:-2][::-1]]


@dataclass(frozen=True)
class _ViewRays:
    """All viewpoints as arrays: eyes, directions (G, 3); sideways (G, 2, 3); weights (G, 2, 2)."""

    eyes: Array
    directions: Array
    sideways: Array
    weights: Array

    @classmethod
    def of(cls, views: list[_View]) -> _ViewRays:
        return cls(
            np.array([v.eye for v in views]),
            np.array([v.direction for v in views]),
            np.array([v.sideways for v in views]),
            np.array([v.information() for v in views]),
        )

    def solve(self, h: _Hypothesis) -> tuple[_Hypothesis, float]:
        """The hypothesis at the position that fits all rays and its plane, and its cost."""
        x = h.position
        plane = np.outer(h.normal, h.normal) / h.sigma_m**2
        weak = np.eye(3) / _FAR_M**2
        for _ in range(_STEPS):
            r, J, chi2 = self._residuals(x)
            robust = np.minimum(1.0, _HUBER / np.sqrt(np.maximum(chi2, 1e-12)))
            JW = np.einsum("g,gji,gjk->gik", robust, J, self.weights)
            H = np.einsum("gij,gjk->ik", JW, J) + plane + weak
            g = np.einsum("gij,gj->i", JW, r) + plane @ (x - h.anchor)
            x = x - np.linalg.solve(H, g)
        _, _, chi2 = self._residuals(x)
        lift = float(h.normal @ (x - h.anchor)) ** 2 / h.sigma_m**2
        cost = float(np.minimum(chi2, _TORN).sum()) + lift
        return replace(h, position=x, covariance=np.linalg.inv(H)), cost

    def _residuals(self, x: Array) -> tuple[Array, Array, Array]:
        """Residuals across each ray (G, 2), rad, their derivatives (G, 2, 3), and squares (G,)."""
        away = x - self.eyes
        distance = np.linalg.norm(away, axis=1)
        r = np.einsum("gij,gj->gi", self.sideways, away / distance[:, None] - self.directions)
        J = self.sideways / distance[:, None, None]
        return r, J, np.einsum("gi,gij,gj->g", r, self.weights, r)


def _mahalanobis(view: _View, h: _Hypothesis) -> float:
    """Squared Mahalanobis distance of a new ray from a hypothesis."""
    away = h.position - view.eye
    distance = float(np.linalg.norm(away))
    S = view.sideways
    r = S @ (away / distance - view.direction)
    C = S @ (view.pixel + view.pose + h.covariance / distance**2) @ S.T
    return float(r @ np.linalg.solve(C, r))


def _apart(h: _Hypothesis, surface: TargetSurface) -> float:
    offset = surface.position - h.position
    C = h.covariance + surface.covariance + 0.25 * np.eye(3)
    return float(offset @ np.linalg.solve(C, offset))
