"""Results of a forecast: verdicts of samples and legs, and the stretches that need odometry."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from companion.planning.way import FlightLeg, PathSample
from localizer.forecast.forecast import ViewForecast
from localizer.forecast.risk import RISK_LIMIT
from localizer.odometry.config import GrowthModel, OdometryConfig

_HILLS = (
    0.1  # scale error over ground that is not known, mean of the first 150 m at 100 m of height
)
_LEAST_MAP_SHARE = 0.5  # of the picture: with less it is the map that ends
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
