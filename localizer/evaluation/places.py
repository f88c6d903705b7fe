"""Starts a sequence, and recovers from LOST, by relocalization instead of a prior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from localizer.geometry.pose import Array, Pose, so3_exp
from localizer.relocalization.patch import with_heading
from localizer.relocalization.relocalizer import Relocalizer
from localizer.relocalization.types import PlaceQuery, SearchRegion
from localizer.types import Frame, PosePrior

_OFF_M = (100.0, 500.0)  # of a prior that is lost
_HEADING_OFF_DEG = 15.0  # of a heading that is known, at most
# A search's answer is one frame's: what tracking begins with is no better than this.
_LEAST_SIGMA = np.array([1.0, 1.0, 1.0, *np.radians([1.0, 1.0, 1.0])])


@dataclass(frozen=True)
class SimulatedPlaceData:
    """Simulated data of other sensors for a lost camera: true values with seeded errors.

    prior: whether a position with an error of 100 to 500 m is known. heading: whether the heading
    is known to 15 degrees. tilt_sigma_deg, height_sigma_m: of the autopilot's roll and pitch, and
    of the barometer.
    """

    prior: bool
    heading: bool
    tilt_sigma_deg: float = 0.7
    height_sigma_m: float = 2.0
    seed: int = 0

    def query(self, frame: Frame, truth: Pose, index: int) -> PlaceQuery:
        """The search query of a frame."""
        rng = np.random.default_rng((self.seed, index))
        tilt = np.array([*rng.normal(0.0, np.radians(self.tilt_sigma_deg), 2), 0.0])
        limit = np.radians(_HEADING_OFF_DEG) if self.heading else np.pi
        rotation = with_heading(so3_exp(tilt) @ truth.rotation, rng.uniform(-limit, limit))
        return PlaceQuery(
            frame,
            rotation,
            float(np.radians(self.tilt_sigma_deg)),
            limit / 2 if self.heading else None,
            float(truth.translation[2] + rng.normal(0.0, self.height_sigma_m)),
            self.height_sigma_m,
            self._region(truth.translation, rng),
        )

    def _region(self, place: Array, rng: np.random.Generator) -> SearchRegion | None:
        if not self.prior:
            return None
        angle, distance = rng.uniform(0.0, 2 * np.pi), rng.uniform(*_OFF_M)
        off = distance * np.array([np.cos(angle), np.sin(angle)])
        return SearchRegion.circle(place[:2] + off, _OFF_M[1])


@dataclass(frozen=True)
class PlaceFinder:
    """Finds a frame's prior by a relocalizer. known: simulated data of other sensors."""

    relocalizer: Relocalizer
    known: SimulatedPlaceData

    def __call__(self, frame: Frame, truth: Pose, index: int) -> PosePrior | None:
        """The prior to track from; None if nothing was found. truth: true pose, from which sensor
        data are drawn.
        """
        found = self.relocalizer.find(self.known.query(frame, truth, index))
        if found is None:
            return None
        covariance = found.covariance + np.diag(_LEAST_SIGMA**2)
        return PosePrior(found.world_from_camera, covariance, frame.exposure_time_ns)
