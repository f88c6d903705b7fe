"""One target's position over time, with every surface that its pixels may have shown.

A sum of Gaussians (Alspach and Sorenson 1972, "Nonlinear Bayesian estimation using Gaussian sum
approximations"): one constant-velocity Kalman track for each surface that the sightings so far
allow. Tracks of different surfaces are never averaged; the most probable one is reported, and the
others widen its covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from filterpy.common import Q_continuous_white_noise
from filterpy.kalman import predict as kalman_predict
from filterpy.kalman import update as kalman_update

from localizer.geometry.pose import Array
from localizer.types import TargetFix, TargetSighting, TargetSurface

# Spectral density of a target's acceleration, east north up, m²/s³: 0.3 m/s in a second is a car in
# traffic, 0.15 m/s the slope of its road.
_ACCELERATION = (0.45, 0.45, 0.02)
_SPEED_SIGMA = (10.0, 10.0, 2.0)  # m/s, before anything is known
_GATE = 25.0  # squared Mahalanobis distance, 3 dimensions
_OUTLIERS = 3  # sightings in a row that no track explains: the target is elsewhere
_NEGLIGIBLE = 1e-3
_MOST_TRACKS = 6
_SAME = 1.0  # squared Mahalanobis distance below which two tracks are one
_ELSEWHERE = 9.0  # and above which a track is another place than the reported one
_H = np.hstack([np.eye(3), np.zeros((3, 3))])


@dataclass(frozen=True)
class _TrackHypothesis:
    """A hypothesis. weight: probability; mean: (6,) position m and velocity m/s, world axes;
    covariance: (6, 6); sightings: number of observations in it.
    """

    weight: float
    mean: Array
    covariance: Array
    sightings: int = 1


class TargetFilter:
    """Tracks one target that may move; not thread-safe."""

    def __init__(self) -> None:
        self._tracks: list[_TrackHypothesis] = []
        self._time_ns = 0
        self._outliers = 0

    @property
    def velocity(self) -> Array | None:
        """Velocity (3,), m/s, world, of the most probable track; None before 2 observations."""
        if not self._tracks or self._tracks[0].sightings < 2:
            return None
        velocity: Array = self._tracks[0].mean[3:].copy()
        return velocity

    @property
    def velocity_covariance(self) -> Array | None:
        """Covariance (3, 3) m²/s² of `velocity`, of that track alone; None without it."""
        if self.velocity is None:
            return None
        covariance: Array = self._tracks[0].covariance[3:, 3:].copy()
        return covariance

    def expected(self, time_ns: int) -> tuple[Array, Array] | None:
        """Predicted position (3,), world m, and covariance (3, 3) of the most probable track alone;
        None before an observation.
        """
        if not self._tracks:
            return None
        track = _predicted(self._tracks[0], time_ns - self._time_ns)
        return track.mean[:3], track.covariance[:3, :3]

    def update(self, sighting: TargetSighting) -> TargetFix | None:
        """Fuse an observation of at least one surface, later than the last one; None for one that
        fits no track. The third of those in a row gives a fix again: its surfaces become the
        tracks.
        """
        tracks = [_predicted(t, sighting.time_ns - self._time_ns) for t in self._tracks]
        met = _met(tracks, sighting.surfaces)
        self._outliers = 0 if met else self._outliers + 1
        if not tracks or self._outliers >= _OUTLIERS:
            met = [_new_track(s) for s in sighting.surfaces]
            self._outliers = 0
        self._tracks = _reduced(met or tracks)
        self._time_ns = sighting.time_ns
        return self._fix(sighting) if met else None

    def _fix(self, sighting: TargetSighting) -> TargetFix:
        """The most probable track; the covariance is the mean square of all tracks about it."""
        best = self._tracks[0]
        covariance, elsewhere = np.zeros((3, 3)), 0.0
        for track in self._tracks:
            offset = track.mean[:3] - best.mean[:3]
            P = track.covariance[:3, :3]
            covariance += track.weight * (P + np.outer(offset, offset))
            if offset @ np.linalg.solve(best.covariance[:3, :3], offset) > _ELSEWHERE:
                elsewhere += track.weight
        return TargetFix(
            sighting.target_id,
            best.mean[:3].copy(),
            covariance,
            sighting.pixel,
            sighting.time_ns,
            elsewhere,
            self.velocity,
            self.velocity_covariance,
        )


def _new_track(surface: TargetSurface) -> _TrackHypothesis:
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = surface.covariance
    covariance[3:, 3:] = np.diag(np.square(_SPEED_SIGMA))
    return _TrackHypothesis(
        surface.probability, np.concatenate([surface.position, np.zeros(3)]), covariance
    )


def _predicted(track: _TrackHypothesis, elapsed_ns: int) -> _TrackHypothesis:
    dt = max(elapsed_ns * 1e-9, 1e-3)
    F = np.eye(6)
    F[:3, 3:] = np.eye(3) * dt
    Q = np.kron(Q_continuous_white_noise(2, dt), np.diag(_ACCELERATION))
    mean, P = kalman_predict(track.mean, track.covariance, F, Q)
    return replace(track, mean=np.asarray(mean), covariance=np.asarray(P))


def _met(
    tracks: list[_TrackHypothesis], surfaces: tuple[TargetSurface, ...]
) -> list[_TrackHypothesis]:
    """Every track with every surface within its gate; empty if there is no such pair.

    The measurement is a pixel, whichever surface it shows. So the likelihood is a Gaussian of the
    same height for all surfaces, taken over the track's own spread. The surfaces' probabilities
    count only between surfaces that a track cannot separate. If they counted in every frame, a
    constant error of the map's edge or of the aim would be taken for evidence.
    """
    met = []
    for track in tracks:
        pairs = [(s, _likelihood(track, s)) for s in surfaces]
        pairs = [(s, likelihood) for s, likelihood in pairs if likelihood > 0.0]
        total = sum(s.probability for s, _ in pairs)
        for surface, likelihood in pairs:
            weight = track.weight * likelihood * surface.probability / total
            mean, P = kalman_update(
                track.mean, track.covariance, surface.position, surface.covariance, _H
            )
            met.append(
                _TrackHypothesis(weight, np.asarray(mean), np.asarray(P), track.sightings + 1)
            )
    return met


def _likelihood(track: _TrackHypothesis, surface: TargetSurface) -> float:
    """Likelihood of a surface's point relative to the best possible one; 0 outside the gate."""
    S = track.covariance[:3, :3] + surface.covariance
    innovation = surface.position - track.mean[:3]
    distance = float(innovation @ np.linalg.solve(S, innovation))
    if distance > _GATE:
        return 0.0
    height = np.linalg.det(surface.covariance) / np.linalg.det(S)
    return float(np.sqrt(height) * np.exp(-0.5 * distance))


def _reduced(tracks: list[_TrackHypothesis]) -> list[_TrackHypothesis]:
    """The tracks normalised, by falling weight; equal ones are merged, negligible ones dropped."""
    waiting = sorted(tracks, key=lambda t: -t.weight)
    total = sum(t.weight for t in waiting)
    kept: list[_TrackHypothesis] = []
    while waiting and len(kept) < _MOST_TRACKS:
        head = waiting[0]
        offsets = [t.mean - head.mean for t in waiting]
        same = [o @ np.linalg.solve(head.covariance, o) < _SAME for o in offsets]
        weight = sum(t.weight for t, s in zip(waiting, same, strict=True) if s)
        kept.append(replace(head, weight=weight))
        waiting = [t for t, s in zip(waiting, same, strict=True) if not s]
    kept = [t for t in kept if t.weight >= _NEGLIGIBLE * total]
    total = sum(t.weight for t in kept)
    return sorted((replace(t, weight=t.weight / total) for t in kept), key=lambda t: -t.weight)
