"""Contents of a report as plain data, independent of layout."""

from __future__ import annotations

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
