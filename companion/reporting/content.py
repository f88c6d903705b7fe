"""Contents of a report as plain data, independent of layout, and advice about failed criteria."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from localizer.types import Image

NOTHING = "nothing"  # that went wrong: how the page's headline begins then


@dataclass(frozen=True)
class CriterionResult:
    """Result of one criterion. value, needed: as text with units; meaning, look: what a failure
    means and where to look.
    """

    name: str
    value: str
    needed: str
    ok: bool
    meaning: str = ""
    look: str = ""


# Widths of tracks that nearly coincide: each is seen inside the one below, rim and all; pixels.
OUTER, MIDDLE, INNER = 10.0, 6.5, 2.5
RIM = 1.5  # of dark about a track, both sides together


@dataclass(frozen=True)
class MapTrack:
    """A path in the map's frame. points: (N, 2) east, north, m; NaN interrupts the line."""

    name: str
    colour: str
    width: float
    points: np.ndarray


@dataclass(frozen=True)
class MapMark:
    """A position in the map's frame. kind: "target" (located), "truth" (true), or an event's;
    sigma_m: radius of its circle, 0: none.
    """

    name: str
    east_m: float
    north_m: float
    kind: str = "event"
    sigma_m: float = 0.0


@dataclass(frozen=True)
class MapSheet:
    """Top view with tracks. rgb: (n, n, 3), None without a map; west to north: its edges, m. key:
    legend.
    """

    rgb: Image | None
    west: float
    east: float
    south: float
    north: float
    tracks: tuple[MapTrack, ...] = ()
    marks: tuple[MapMark, ...] = ()
    key: str = "located targets are circles, crosses are true places or events"


@dataclass(frozen=True)
class Curve:
    """One line of a plot; NaN breaks it."""

    label: str
    values: np.ndarray


@dataclass(frozen=True)
class Plot:
    """Curves over one abscissa. limit: horizontal line; joined: lines, not only points."""

    title: str
    x: np.ndarray
    curves: tuple[Curve, ...]
    limit: float | None = None
    joined: bool = True


@dataclass(frozen=True)
class Stanford:
    """Stanford diagram: error against protection level, both (N,) m, and alert limit."""

    error_m: np.ndarray
    level_m: np.ndarray
    alert_limit_m: float


@dataclass(frozen=True)
class Span:
    """A time span of the timeline, seconds."""

    begin_s: float
    end_s: float
    name: str


@dataclass(frozen=True)
class ReportEvent:
    """An event. alert: the identifier of its alert, if any."""

    time_s: float
    level: str
    text: str
    alert: str = ""


@dataclass(frozen=True)
class Overlay:
    """A frame and the map rendered at its estimated pose, both (H, W, 3)."""

    video: Image
    render: Image
    caption: str


@dataclass(frozen=True)
class ReportTable:
    """Headings and rows. bad: indices of rows that fail; note: explains the columns."""

    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    bad: frozenset[int] = frozenset()
    note: str = ""


@dataclass(frozen=True)
class Report:
    """All contents of a report. first: the first fault as text; abscissa: label of the plots and
    timeline.

    spans: named lanes of time spans (states, GNSS denied); notes: what the report could not show;
    overlays_of: the frames that the overlays show; verdict: the result in one sentence; tables,
    pictures: further ones with their titles.
    """

    title: str
    subtitle: str
    first: str = ""
    verdicts: tuple[CriterionResult, ...] = ()
    sheet: MapSheet | None = None
    plots: tuple[Plot, ...] = ()
    stanford: Stanford | None = None
    lanes: tuple[tuple[str, tuple[Span, ...]], ...] = ()
    events: tuple[ReportEvent, ...] = ()
    overlays: tuple[Overlay, ...] = ()
    targets: ReportTable | None = None
    stages: ReportTable | None = None
    abscissa: str = "time, s"
    settings: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, Any] = field(default_factory=dict)
    notes: Sequence[str] = ()
    overlays_of: str = "The worst of all frames"
    verdict: str = ""
    tables: tuple[tuple[str, ReportTable], ...] = ()
    pictures: tuple[tuple[str, Image], ...] = ()


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
        "calibration and time stamps, which no single image shows, and localizer.map_error_m",
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
