"""Explains failed criteria, and where to look first."""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.reporting.content import CriterionResult


@dataclass(frozen=True)
class Advice:
    """Explanation of a failed criterion. meaning: for the pilot; look: what to open first."""

    meaning: str
    look: str


_UNKNOWN = Advice("outside what was asked for", "the plots and the timeline")

# By the beginning of the target's name.
_ADVICE = {
    "localizer median": Advice(
        "most positions are further off than they should be: calibration or map rather than noise",
        "the worst overlays: edges that run beside each other everywhere mean focal length, "
        "distortion or a shifted map",
    ),
    "localizer R@": Advice(
        "frames are wrong or missing; as many as completeness lacks are missing, not wrong",
        "frames_report.csv: a frame without an error has no position, one with a large error is "
        "wrong; then the timeline at that time, and the worst overlays",
    ),
    "completeness": Advice(
        "frames were refused, so there was no position for them",
        "quality over time, and the overlays of refused frames: map too old, too coarse, or "
        "motion blur",
    ),
    "localized frames": Advice(
        "the computer is too slow, or the feed delivers too few frames",
        "latency by stage; lower localizer.width, or raise the camera's rate",
    ),
    "EKF horizontal": Advice(
        "the autopilot's position is off although vision may be right: late, refused or held",
        "events of injection, latency against bridge.injection.delay_ms, `companion doctor`",
    ),
    "fixes in their level": Advice(
        "the protection level did not hold: a fix was further off than the worst it admitted",
        "what kind of map it is (`companion map info`): without buildings in the heights the level "
        "rests on the attitude",
    ),
    "fixes in their bound": Advice(
        "fixes are further off than their own 95 % bound says, more often than 5 in 100",
        "calibration and time stamps, which no single picture shows, and localizer.map_error_m",
    ),
    "fixed targets in their bound": Advice(
        "coordinates of standing targets are further off than their sigma says",
        "the map's kind: what stands on the ground and is not in its heights; then the targets' "
        "own lines",
    ),
    "fixed targets": Advice(
        "coordinates given for places that stand still are off",
        "the targets' own lines: one bad target is an edge or a roof, all of them are the pose",
    ),
}


def value_and_limit(
    value: float | None, limit: float, unit: str, *, at_least: bool
) -> tuple[str, str]:
    """A value and its limit as text, with enough digits to show the difference: never "0.25 m,
    needed <= 0.25 m: missed".
    """
    needed = f"{'>=' if at_least else '<='} {limit:g} {unit}"
    if value is None or not math.isfinite(value):
        return "-", needed

    def holds(figure: float) -> bool:
        return figure >= limit if at_least else figure <= limit

    digits = next((d for d in range(2, 9) if holds(round(value, d)) == holds(value)), 9)
    return f"{value:.{digits}f} {unit}", needed


def advice(name: str) -> Advice:
    """Explanation of the criterion whose name begins with a known one; otherwise a general one."""
    return next((a for begin, a in _ADVICE.items() if name.startswith(begin)), _UNKNOWN)


def criterion_result(
    name: str, value: float | None, limit: float, unit: str, *, at_least: bool
) -> CriterionResult:
    """Compare a value, None if it is not known, with its limit."""
    known = advice(name)
    found, needed = value_and_limit(value, limit, unit, at_least=at_least)
    figure = math.nan if value is None else value  # which meets no limit
    ok = math.isfinite(figure) and (figure >= limit if at_least else figure <= limit)
    return CriterionResult(name, found, needed, ok, known.meaning, known.look)
