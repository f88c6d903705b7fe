"""What a report shows, whatever it is about: plain data, ready to be laid out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from localizer.types import Image

NOTHING = "nothing"  # that went wrong: how the page's headline begins then


@dataclass(frozen=True)
class CriterionResult:
    """One target of the flight. value, needed: as text with units; meaning, look: what a miss means
    and where to look.
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
    """A way in the map's frame. points: (N, 2) east, north, m; a NaN ends a stretch."""

    name: str
    colour: str
    width: float
    points: np.ndarray


@dataclass(frozen=True)
class MapMark:
    """A place in the map's frame. kind: "target" is one that was located, "truth" where one truly
    is, else an event's; sigma_m: radius of its circle, 0: none.
    """

    name: str
    east_m: float
    north_m: float
    kind: str = "event"
    sigma_m: float = 0.0


@dataclass(frozen=True)
class MapSheet:
    """Top view with tracks. rgb: (n, n, 3), None where the map is not to be had; west to north: its
    edges, m. key: what circles and crosses are.
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
    """Curves over one abscissa. limit: a line that should not be crossed."""

    title: str
    x: np.ndarray
    curves: tuple[Curve, ...]
    limit: float | None = None


@dataclass(frozen=True)
class Stanford:
    """Error against protection level, both (N,) m; alert_limit_m: beyond it nothing is used."""

    error_m: np.ndarray
    level_m: np.ndarray
    alert_limit_m: float


@dataclass(frozen=True)
class Span:
    """A stretch of the timeline, seconds."""

    begin_s: float
    end_s: float
    name: str


@dataclass(frozen=True)
class ReportEvent:
    """Something that happened. alert: the identifier of its alert, if any."""

    time_s: float
    level: str
    text: str
    alert: str = ""


@dataclass(frozen=True)
class Overlay:
    """A frame and the map at its estimated pose, both (H, W, 3)."""

    video: Image
    render: Image
    caption: str


@dataclass(frozen=True)
class ReportTable:
    """Rows of text under their headings. bad: numbers of the rows that miss their target; note: how
    the columns are to be read.
    """

    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    bad: frozenset[int] = frozenset()
    note: str = ""


@dataclass(frozen=True)
class Report:
    """All of it. first: what went wrong first, in words; abscissa: of the plots and the timeline.

    spans: named lanes of stretches (states, GNSS denied); notes: what the report could not show;
    overlays_of: the frames of which the overlays show the worst; verdict: the result in one
    sentence; tables: further ones with their titles.
    """

    title: str
    subtitle: str
    first: str
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
    overlays_of: str = "all frames"
    verdict: str = ""
    tables: tuple[tuple[str, ReportTable], ...] = ()
