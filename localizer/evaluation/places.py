"""Evaluation without a true prior: starts by relocalization, with simulated sensors.

Drawn sensors: recorded sequences with true poses seldom contain the autopilot's data. Simulated
ones show how much such data improve the result.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from localizer.config import LocalizerConfig
from localizer.evaluation.sequences import Sequence
from localizer.geometry.pose import Array, Pose, so3_exp
from localizer.relocalization.patch import with_heading
from localizer.relocalization.relocalizer import Relocalizer
from localizer.relocalization.types import PlaceQuery, SearchRegion
from localizer.tracking.attitude_bias import AttitudePrior
from localizer.tracking.motion import AuxiliarySensors
from localizer.types import Frame, PosePrior


@dataclass(frozen=True)
class DrawnSensors:
    """Errors of the simulated sensors. tilt_sigma_deg: of roll and pitch, per axis; height_sigma_m:
    of the height; None: not measured. by_frame: independent errors for each frame, as for photos;
    otherwise constant, as a gimbal's and barometer's in a flight. truth, index: a frame's true pose
    world_from_camera, and its number.
    """

    tilt_sigma_deg: float | None = None
    height_sigma_m: float | None = None
    by_frame: bool = False
    seed: int = 0

    def rotation(self, truth: Pose, index: int) -> Array | None:
        """Simulated attitude (3, 3) world_from_camera of frame `index`, with the true heading;
        None: not measured.
        """
        if self.tilt_sigma_deg is None:
            return None
        tilt = self._rng(index).normal(0.0, np.radians(self.tilt_sigma_deg), 2)
        rotation: Array = so3_exp(np.array([*tilt, 0.0])) @ truth.rotation
        return rotation

    def height_m(self, truth: Pose, index: int) -> float | None:
        """Simulated height (world z, m) of frame `index`; None: not measured."""
        if self.height_sigma_m is None:
            return None
        error = self._rng(index).normal(0.0, 1.0, 3)[2]
        return float(truth.translation[2] + self.height_sigma_m * error)

    def config(self, config: LocalizerConfig) -> LocalizerConfig:
        """The localizer's settings with these sigmas; what is not measured is not used."""
        tilt = self.tilt_sigma_deg
        attitude = None if tilt is None else AttitudePrior.with_sigma(tilt)
        return config.model_copy(
            update={"attitude": attitude, "height_sigma_m": self.height_sigma_m}
        )

    def auxiliary(self, sequence: Sequence) -> AuxiliarySensors:
        """The drawn data for a localizer, at the frames' exposure times; None at other times."""
        index = {time_ns: k for k, time_ns in enumerate(sequence.times_ns)}

        def rotation_at(time_ns: int) -> Array | None:
            k = index.get(time_ns)
            return None if k is None else self.rotation(sequence.truth[k], k)

        def height_at(time_ns: int) -> float | None:
            k = index.get(time_ns)
            return None if k is None else self.height_m(sequence.truth[k], k)

        return AuxiliarySensors(rotation_at=rotation_at, height_at=height_at)

    def in_prior(self, prior: PosePrior, truth: Pose, index: int) -> PosePrior:
        """The prior of frame `index` with simulated roll, pitch and height in place of its own, and
        their variances; position and heading are unchanged. truth: the frame's world_from_camera.
        """
        pose, covariance = prior.world_from_camera, prior.covariance.copy()
        rotation, height_m = self.rotation(truth, index), self.height_m(truth, index)
        if rotation is not None and self.tilt_sigma_deg is not None:
            ahead, true_ahead = pose.rotation[:2, 1], truth.rotation[:2, 1]
            turn = np.arctan2(ahead[1], ahead[0]) - np.arctan2(true_ahead[1], true_ahead[0])
            pose = Pose(with_heading(rotation, float(turn)), pose.translation)
            covariance[3:5, :] = covariance[:, 3:5] = 0.0
            covariance[3, 3] = covariance[4, 4] = np.radians(self.tilt_sigma_deg) ** 2
        if height_m is not None and self.height_sigma_m is not None:
            pose = Pose(pose.rotation, np.array([*pose.translation[:2], height_m]))
            covariance[2, :] = covariance[:, 2] = 0.0
            covariance[2, 2] = self.height_sigma_m**2
        return replace(prior, world_from_camera=pose, covariance=covariance)

    def _rng(self, index: int) -> np.random.Generator:
        return np.random.default_rng((self.seed, 5, index if self.by_frame else 0))


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
