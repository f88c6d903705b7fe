"""Results of a forecast: verdicts of samples and legs, stretches without vision, and the flight."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path

import numpy as np

from companion.offline.record import read_estimates, read_record
from companion.planning.way import FlightLeg, PathSample
from localizer.forecast.forecast import RISK_LIMIT, ViewForecast
from localizer.geometry.pose import Array
from localizer.map.cache.cache import TileCache
from localizer.odometry.config import GrowthModel, OdometryConfig

# Scale error over ground that is not known, mean of the first 150 m at 100 m of height.
_HILLS = 0.1
_LEAST_MAP_SHARE = 0.5  # of the image: with less it is the map that ends
_LIKENESS = 0.7  # of another place's match, beyond which it may be taken for this one


class Reason(Enum):
    """Why vision fails at a position."""

    NONE = "holds"
    NO_MAP = "no map in view"
    EDGE = "the map ends in view"
    ALIKE = "another place looks like it"
    SIGMA = "sigma beyond the limit"
    WEAK = "too little to match"


@dataclass(frozen=True)
class MissionLimits:
    """sigma_m: largest acceptable position sigma, one axis; risk: largest acceptable share of
    frames that are lost or wrong.
    """

    sigma_m: float = 1.0
    risk: float = RISK_LIMIT


@dataclass(frozen=True)
class SampleVerdict:
    """A sample with the worst of its forecasts, over the conditions."""

    sample: PathSample
    forecast: ViewForecast
    reason: Reason

    @property
    def holds(self) -> bool:
        """Whether vision is sufficient at this sample."""
        return self.reason is Reason.NONE


@dataclass(frozen=True)
class LegVerdict:
    """Results of a leg's samples. times: how often the leg is flown."""

    leg: FlightLeg
    samples: tuple[SampleVerdict, ...]
    times: int = 1

    @property
    def holds(self) -> bool:
        """Whether every sample holds."""
        return all(j.holds for j in self.samples)

    @property
    def share(self) -> float:
        """Share of the samples that hold."""
        return float(np.mean([j.holds for j in self.samples]))

    @property
    def worst(self) -> SampleVerdict:
        """The sample with the largest risk, of those that fail if there are any."""
        return max(self.samples, key=lambda j: (not j.holds, j.forecast.risk))

    @property
    def sigma_m(self) -> float:
        """Median sigma of the samples that hold; NaN without any."""
        held = [j.forecast.sigma_m for j in self.samples if j.holds]
        return float(np.median(held)) if held else math.nan


@dataclass(frozen=True)
class VisionGap:
    """A stretch without vision. begin_m, end_m: along the mission; drift_m: position sigma
    (horizontal, one axis) after it with odometry; can_bridge: whether that stays below odometry's
    limit.
    """

    begin_m: float
    end_m: float
    seconds: float
    drift_m: float
    can_bridge: bool

    @property
    def length_m(self) -> float:
        """Length along the path, m."""
        return self.end_m - self.begin_m


def sample_verdict(
    sample: PathSample, forecasts: Sequence[ViewForecast], limits: MissionLimits
) -> SampleVerdict:
    """The sample's result under its worst condition. forecasts: one for each condition."""
    worst = max(forecasts, key=lambda f: (_reason(f, limits) is not Reason.NONE, f.risk, f.sigma_m))
    return SampleVerdict(sample, worst, _reason(worst, limits))


def _reason(forecast: ViewForecast, limits: MissionLimits) -> Reason:
    if forecast.ground_m == 0.0:
        return Reason.NO_MAP
    risky = forecast.risk > limits.risk
    if risky and forecast.figures.map_share < _LEAST_MAP_SHARE:
        return Reason.EDGE
    if forecast.rival.share > _LIKENESS:
        return Reason.ALIKE
    if risky:
        return Reason.WEAK
    return Reason.SIGMA if forecast.sigma_m > limits.sigma_m else Reason.NONE


def stretches(
    verdicts: Sequence[LegVerdict],
    speed_m_s: float,
    odometry: OdometryConfig,
    *,
    terrain: bool = False,
) -> tuple[VisionGap, ...]:
    """The stretches that need odometry, in order; neighbouring samples are one stretch. speed_m_s:
    used if the leg has none; terrain: heights are known outside the map.
    """
    found: list[tuple[float, float, float, bool]] = []
    for verdict in verdicts:
        half = verdict.leg.step_m / 2
        seconds = verdict.leg.step_m / (verdict.leg.speed_m_s or speed_m_s)
        for judged in (j for j in verdict.samples if not j.holds):
            begin, end = judged.sample.way_m - half, judged.sample.way_m + half
            off_map = judged.reason in (Reason.NO_MAP, Reason.EDGE)
            if found and begin - found[-1][1] < 1e-6 + 0.01 * half:
                start, _, before, beside = found[-1]
                found[-1] = (start, end, before + seconds, beside or off_map)
            else:
                found.append((begin, end, seconds, off_map))
    outside = odometry.with_ground if terrain else replace(odometry.with_plane, scale=_HILLS)
    return tuple(_stretch(*one, odometry, outside) for one in found)


def _stretch(
    begin_m: float,
    end_m: float,
    seconds: float,
    off_map: bool,
    odometry: OdometryConfig,
    outside: GrowthModel,
) -> VisionGap:
    """The gap between two distances. off_map: the map has no geometry at one sample."""
    growth, length = outside if off_map else odometry.with_map, end_m - begin_m
    drift = math.hypot(growth.horizontal * math.sqrt(length), growth.scale * length)
    can_bridge = drift <= odometry.longest_sigma_m
    return VisionGap(begin_m, end_m, seconds, drift, can_bridge)


FLOWN_HEADINGS = ("leg", "should work", "worked", "forecast right", "positions flown")


@dataclass(frozen=True)
class FlownLeg:
    """One leg. forecast, held: (N,) for the samples that were flown, whether vision should work
    there and whether it did; places: number of the leg's samples.
    """

    name: str
    places: int
    forecast: np.ndarray
    held: np.ndarray

    @property
    def row(self) -> tuple[str, ...]:
        """Table cells of the leg."""
        flown = f"{len(self.held)} of {self.places}"
        if not len(self.held):
            return self.name, "-", "-", "-", flown
        shares = (self.forecast.mean(), self.held.mean(), (self.forecast == self.held).mean())
        return (self.name, *(f"{100 * share:.0f} %" for share in shares), flown)


def flown_legs(
    verdicts: Sequence[LegVerdict], places: Array, accepted: np.ndarray
) -> tuple[FlownLeg, ...]:
    """Compare each leg's samples with the frames of the flight within half a step horizontally; a
    sample without such a frame was not flown.
    places: (F, 3) positions of all frames; accepted: (F,), whether each was localized.
    """
    legs = []
    for verdict in verdicts:
        forecast, held = [], []
        for judged in verdict.samples:
            away = np.linalg.norm(places[:, :2] - judged.sample.position[:2], axis=1)
            near = away <= max(verdict.leg.step_m / 2, 1.0)
            if near.any():
                forecast.append(judged.holds)
                held.append(bool(accepted[near].mean() >= 1.0 - RISK_LIMIT))
        told = (np.array(forecast, bool), np.array(held, bool))
        legs.append(FlownLeg(verdict.leg.name, len(verdict.samples), *told))
    return tuple(legs)


def recorded_frames(record: Path, cache: TileCache) -> tuple[Array, np.ndarray]:
    """Positions (F, 3) of a record's frames, world metres, and whether each was localized.
    `RecordError` if the folder is no record, or of another map.
    """
    read_record(record).flown_map.require_frame(cache)
    estimates = read_estimates(record / "estimates.csv")
    places = np.array([e.world_from_camera.translation for e in estimates]).reshape(-1, 3)
    return places, np.array([e.accepted for e in estimates], bool)


def flown_words(legs: Sequence[FlownLeg]) -> str:
    """The comparison in a sentence, for the user."""
    forecast = np.concatenate([leg.forecast for leg in legs])
    held = np.concatenate([leg.held for leg in legs])
    if not len(held):
        return "The flight has no frame on this mission."
    return (
        f"Flown: {len(held)} points; the forecast is right at "
        f"{100 * (forecast == held).mean():.0f} %; {int((forecast & ~held).sum())} failed that "
        f"should hold, {int((~forecast & held).sum())} held that should fail."
    )
