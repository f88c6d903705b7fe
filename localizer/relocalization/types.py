"""Input and output of a search."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array, Pose
from localizer.types import Frame


@dataclass(frozen=True)
class SearchRegion:
    """An ellipse that contains the camera. centre: (2,) east and north, m; shape: (2, 2) m²,
    positive definite; inside is ``(x - centre)' shape^-1 (x - centre) <= 1``.
    """

    centre: Array
    shape: Array

    @classmethod
    def circle(cls, centre: Array, radius_m: float) -> SearchRegion:
        """A circle of `radius_m` about `centre` (2,)."""
        return cls(np.asarray(centre, np.float64)[:2], np.eye(2) * radius_m**2)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Least and greatest east and north, (2,) each."""
        reach = np.sqrt(np.diag(self.shape))
        return self.centre - reach, self.centre + reach

    def contains(self, places: Array) -> NDArray[np.bool_]:
        """Which of the positions (..., 2), m east and north, lie inside."""
        d = np.asarray(places, np.float64) - self.centre
        inside = np.einsum("...i,ij,...j->...", d, np.linalg.inv(self.shape), d) <= 1.0
        return np.asarray(inside)


@dataclass(frozen=True)
class EarlierFrame:
    """A frame before the query's. rotation: as `PlaceQuery`, of its time; higher_m: of the camera,
    than the query's.
    """

    frame: Frame
    rotation: Array
    higher_m: float


@dataclass(frozen=True)
class PlaceQuery:
    """One frame with the other sensors' data of its camera.

    rotation: (3, 3) world_from_camera by autopilot and gimbal. tilt_sigma_rad: sigma of its roll
    and pitch; heading_sigma_rad: of its heading, None if the heading is unknown. height_m: the
    camera's world z (barometer, m). region: contains the camera, None for the whole map. earlier:
    frames of the last seconds, newest first, for a strip.
    """

    frame: Frame
    rotation: Array
    tilt_sigma_rad: float
    heading_sigma_rad: float | None
    height_m: float
    height_sigma_m: float
    region: SearchRegion | None = None
    earlier: tuple[EarlierFrame, ...] = ()


@dataclass(frozen=True)
class PlaceCandidate:
    """A position whose ground looks like the frame. score: normalised correlation, -1 to 1."""

    world_from_camera: Pose
    score: float


@dataclass(frozen=True)
class Relocalization:
    """A position that was found and confirmed by registration.

    covariance: (6, 6) as `PosePrior`'s. quality, overlap: of the registration. score: correlation
    of its candidate, runner_up: of the best candidate elsewhere; rank: of the candidate, from 0.
    rival_quality: of the best registration elsewhere, 0 without one. stage_s: seconds by stage.
    """

    world_from_camera: Pose
    covariance: Array
    exposure_time_ns: int
    quality: float
    overlap: float
    score: float
    runner_up: float
    rank: int
    rival_quality: float
    stage_s: dict[str, float]

    @property
    def separation(self) -> float:
        """Score divided by the runner-up's; 1 means no separation."""
        return self.score / max(self.runner_up, 1e-6)
