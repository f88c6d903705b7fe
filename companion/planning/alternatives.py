"""Alternatives for failing legs, by the same forecast: other heights, gimbal angles and
headings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from companion.planning.survey import Progress, Surveyor
from companion.planning.verdicts import LegVerdict, SampleVerdict
from companion.planning.way import PathSample

_HEIGHT_FACTORS = (0.6, 1.5, 2.2)
_PITCHES_DEG = (-90.0, -60.0, -45.0)
_LEAST_CHANGE_DEG = 10.0
_TURNS_DEG = (90.0, 180.0)
_LOWEST_M, _HIGHEST_M = 25.0, 300.0  # above the ground that is seen
_SAMPLES = 2  # of a leg, the worst
_LEGS = 12  # the longest of those that will not do


@dataclass(frozen=True)
class LegAlternative:
    """Fly higher by this value, with the gimbal at this pitch and the camera turned from the course
    by this angle (as in `PathSample`). words: for the pilot.
    """

    rise_m: float
    pitch_deg: float
    turn_deg: float
    words: str

    def applied(self, sample: PathSample) -> PathSample:
        """The sample as it is flown then."""
        position = sample.position + np.array([0.0, 0.0, self.rise_m])
        return replace(sample, position=position, pitch_deg=self.pitch_deg, turn_deg=self.turn_deg)


@dataclass(frozen=True)
class LegProposal:
    """The best alternative for a leg. risk: largest of its samples, 0 to 1; holds: whether vision
    is sufficient at all of them.
    """

    leg: str
    change: LegAlternative
    risk: float
    sigma_m: float
    holds: bool


def leg_proposals(
    surveyor: Surveyor, verdicts: Sequence[LegVerdict], fixed: bool, progress: Progress | None
) -> tuple[LegProposal, ...]:
    """Find the alternative with the lowest risk for each of the twelve longest failing legs, if it
    is better than the plan. fixed: the camera turns only with the vehicle.
    """
    bad = sorted(
        (v for v in verdicts if not v.holds), key=lambda v: -(1 - v.share) * v.leg.length_m
    )[:_LEGS]
    tried: list[tuple[LegVerdict, LegAlternative, list[PathSample]]] = []
    for verdict in bad:
        worst = sorted((j for j in verdict.samples if not j.holds), key=lambda j: -j.forecast.risk)[
            :_SAMPLES
        ]
        for change in alternatives_at(worst[0], fixed):
            tried.append((verdict, change, [change.applied(j.sample) for j in worst]))
    judged = iter(surveyor.verdicts([s for _, _, part in tried for s in part], progress))
    found: dict[str, LegProposal] = {}
    for verdict, change, samples in tried:
        results = [next(judged) for _ in samples]
        option = _option(verdict.leg.name, change, results)
        best = found.get(option.leg)
        if option.risk < verdict.worst.forecast.risk and (
            best is None or (not option.holds, option.risk) < (not best.holds, best.risk)
        ):
            found[option.leg] = option
    return tuple(found[v.leg.name] for v in bad if v.leg.name in found)


def alternatives_at(worst: SampleVerdict, fixed: bool) -> list[LegAlternative]:
    """Alternatives to try at a failing sample; for a fixed camera only heights and headings."""
    sample, ground = worst.sample, worst.forecast.ground_m
    options = []
    above = ground * abs(float(np.sin(np.radians(sample.pitch_deg)))) if ground else 0.0
    for factor in _HEIGHT_FACTORS if above else ():
        height = above * factor
        if _LOWEST_M <= height <= _HIGHEST_M:
            rise = height - above
            words = f"{abs(rise):.0f} m {'higher' if rise > 0 else 'lower'}"
            options.append(LegAlternative(rise, sample.pitch_deg, sample.turn_deg, words))
    if not fixed:
        options += [
            LegAlternative(0.0, pitch, sample.turn_deg, f"gimbal at {pitch:.0f}°")
            for pitch in _PITCHES_DEG
            if abs(pitch - sample.pitch_deg) >= _LEAST_CHANGE_DEG
        ]
    options += [
        LegAlternative(0.0, sample.pitch_deg, turn, f"camera {turn:.0f}° from the way")
        for turn in _TURNS_DEG
    ]
    return options


def _option(leg: str, change: LegAlternative, results: Sequence[SampleVerdict]) -> LegProposal:
    worst = max(results, key=lambda j: (not j.holds, j.forecast.risk))
    return LegProposal(
        leg, change, worst.forecast.risk, worst.forecast.sigma_m, all(j.holds for j in results)
    )
