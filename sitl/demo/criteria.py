"""Pass criteria of the demo flight."""

from __future__ import annotations

import os
from dataclasses import dataclass

from localizer.evaluation.metrics import LocalizationMetrics
from sitl.demo.analysis import Spread

_SLOW = 0.9  # of what is wanted: a computer with room loses next to nothing
_MAX_LATENCY_MS = 250.0  # the oldest measurement that ArduPilot fuses; VISO_DELAY_MS's maximum


@dataclass(frozen=True)
class Criterion:
    """A measured value and its limit. at_least: the limit is a minimum, otherwise a maximum."""

    name: str
    value: float | None
    limit: float
    unit: str
    at_least: bool = False

    @property
    def ok(self) -> bool:
        """Whether the criterion is met; an unknown value (None) is not."""
        if self.value is None:
            return False
        if self.at_least:
            return self.value >= self.limit
        return self.value <= self.limit


@dataclass(frozen=True)
class FlightFigures:
    """Measured values of a flight that are checked. ekf_m: horizontal, in the map's frame; fixed_m:
    3-D errors of stationary targets; inside, inside_level: per cent of fixes within their 95 %
    bound, and within their protection level; fixed_inside: per cent of stationary targets'
    positions within their 95 % bound.
    """

    localizer: LocalizationMetrics
    ekf_m: Spread
    fixed_m: Spread
    inside: float | None
    inside_level: float | None
    fixed_inside: float | None


def check_criteria(flight: FlightFigures, *, satellite: bool = False) -> tuple[Criterion, ...]:
    """Compare a flight with the pass criteria. satellite: the map is satellite imagery without
    building heights. Positions are then less accurate, and the criteria check the stated error
    bounds instead.
    """
    m = flight.localizer
    if satellite:
        return (
            Criterion("completeness", m.completeness, 99.0, "%", at_least=True),
            Criterion("localized frames", m.fps, 8.0, "/s", at_least=True),
            Criterion("EKF horizontal p95", flight.ekf_m.p95, 3.0, "m"),
            Criterion("fixed targets in their bound", flight.fixed_inside, 95.0, "%", True),
            Criterion("fixes in their bound", flight.inside, 93.0, "%", at_least=True),
            Criterion("fixes in their level", flight.inside_level, 99.9, "%", at_least=True),
        )
    return (
        Criterion("localizer median", m.median_translation_m, 0.25, "m"),
        Criterion("localizer R@3", m.recall_3, 100.0, "%", at_least=True),
        Criterion("completeness", m.completeness, 99.0, "%", at_least=True),
        Criterion("localized frames", m.fps, 8.0, "/s", at_least=True),
        Criterion("EKF horizontal p95", flight.ekf_m.p95, 0.6, "m"),
        Criterion("fixed targets p95", flight.fixed_m.p95, 3.0, "m"),
        Criterion("fixes in their bound", flight.inside, 95.0, "%", at_least=True),
        Criterion("fixes in their level", flight.inside_level, 99.9, "%", at_least=True),
    )


def headline(flight: FlightFigures, home_error_m: float, denied_s: float) -> str:
    """One-line result of a flight for the report."""
    m, p95 = flight.localizer, flight.ekf_m.p95
    median = m.median_translation_m
    said = [f"came home on vision alone after {denied_s:.0f} s, {home_error_m:.1f} m from home"]
    if p95 is not None:
        said.append(f"EKF p95 {p95:.2f} m")
    if median is not None:
        said.append(f"localizer {median:.2f} m in the median, {m.completeness:.1f} % of frames")
    return "; ".join(said)


@dataclass(frozen=True)
class ComputingRates:
    """Computing speed of a flight. sent_hz, wanted_hz: real and configured frame rate. taken: share
    of frames that the localizer processed. latency_ms: p95 from exposure to estimate; None without
    estimates. delay_ms: the autopilot's VISO_DELAY_MS. load: mean load of the computer.
    """

    sent_hz: float
    wanted_hz: float
    taken: float
    latency_ms: float | None
    delay_ms: float
    load: float

    def slow_reason(self) -> str | None:
        """Why the computer was too slow for this flight; None if it was fast enough."""
        limit_ms = min(self.delay_ms, _MAX_LATENCY_MS)
        said = []
        if self.sent_hz < _SLOW * self.wanted_hz:
            said.append(f"the camera sent {self.sent_hz:.1f} of {self.wanted_hz:g} pictures/s")
        if self.taken < _SLOW:
            said.append(f"{100 * self.taken:.0f} % of the pictures were localized in time")
        if self.latency_ms is not None and self.latency_ms > limit_ms:
            said.append(
                f"exposure to estimate p95 {self.latency_ms:.0f} ms ({limit_ms:.0f} at most)"
            )
        if not said:
            return None
        return (
            f"this computer did not keep up: {', '.join(said)}, load {self.load:.1f} on "
            f"{os.cpu_count() or 1} processors; end other work, or fly configs/demo_small.yaml"
        )
