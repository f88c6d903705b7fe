"""Computes a report's contents from a record's columns: pure functions over arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from companion.offline.record import STAGES, Columns
from companion.reporting.content import (
    NOTHING,
    Curve,
    MapMark,
    MapTrack,
    Plot,
    ReportEvent,
    ReportTable,
    Span,
)
from mavlink_bridge.alerts.ids import AlertId

_GAP_S = 1.0  # without an estimate: the state before is not carried on over it
_HARMLESS = (AlertId.INJECTION_FORCED.value, AlertId.GNSS_LOST.value, AlertId.ENDING.value)
_WELL = f"{NOTHING}: tracking from the first fix to the end, and no warning"
_NEAR_NS = 2_000_000
LATENCY = "exposure to estimate"
_NEWEST_FIX = "Place, sigma and elsewhere are those of each target's newest fix."
_EVERY_FIX = (
    "The errors are of every fix while GNSS was denied, the first ones too: a maximum far beyond "
    "the sigma is an earlier fix, often one at the image's edge, where the ray is flat and a "
    "step of the surface moves its end by metres."
)


def seconds(time_ns: np.ndarray, start_ns: int) -> np.ndarray:
    """Seconds since start_ns."""
    return np.asarray((np.asarray(time_ns) - start_ns) * 1e-9, dtype=np.float64)


def track(name: str, colour: str, width: float, columns: Columns, prefix: str = "") -> MapTrack:
    """The path of a table's positions, in the columns that begin with `prefix`."""
    points = np.column_stack([columns[f"{prefix}{k}_m"] for k in ("east", "north")])
    return MapTrack(name, colour, width, points)


def nearest(times: np.ndarray, wanted: np.ndarray, within_ns: int = _NEAR_NS) -> np.ndarray:
    """For each wanted time (ns) the index of the nearest of sorted `times`, or -1 if none is within
    `within_ns`, 2 ms if not given.
    """
    if not len(times):
        return np.full(len(wanted), -1)
    right = np.clip(np.searchsorted(times, wanted), 0, len(times) - 1)
    left = np.maximum(right - 1, 0)
    nearer = np.where(np.abs(times[left] - wanted) < np.abs(times[right] - wanted), left, right)
    return np.where(np.abs(times[nearer] - wanted) <= within_ns, nearer, -1)


def state_spans(time_s: np.ndarray, states: np.ndarray) -> tuple[Span, ...]:
    """Time spans of each tracking state; gaps without estimates."""
    spans: list[Span] = []
    for i, (t, state) in enumerate(zip(time_s, states, strict=True)):
        until = time_s[i + 1] if i + 1 < len(time_s) else t
        end = float(min(until, t + _GAP_S))
        if spans and spans[-1].name == str(state) and t - spans[-1].end_s < 1e-6:
            spans[-1] = Span(spans[-1].begin_s, end, str(state))
        else:
            spans.append(Span(float(t), end, str(state)))
    return tuple(spans)


def events(columns: Columns, start_ns: int) -> tuple[ReportEvent, ...]:
    """The record's events, in seconds since the start."""
    if not columns:
        return ()
    times = seconds(columns["time_ns"], start_ns)
    alerts = columns.get("alert", [""] * len(times))  # a record of 0.1 has none
    rows = zip(times, columns["level"], columns["text"], alerts, strict=True)
    return tuple(ReportEvent(float(t), *(str(c) for c in cells)) for t, *cells in rows)


def stage_table(estimates: Columns) -> ReportTable:
    """Median, 95th percentile and maximum latency of each stage."""
    rows = []
    for name in STAGES:
        values = np.asarray(estimates[f"{name}_ms"])
        values = values[np.isfinite(values)]
        if len(values):
            spread = (*np.percentile(values, [50, 95]), values.max())
            label = LATENCY if name == "latency" else name
            rows.append((label, *(f"{v:.0f}" for v in spread)))
    note = "Over the whole record, from its first estimate to its last, also with GNSS."
    return ReportTable(("stage", "median", "p95", "max"), tuple(rows), note=note)


def stage_plot(estimates: Columns, time_s: np.ndarray, limit_ms: float | None) -> Plot:
    """Latency by stage over time."""
    names = {"latency": LATENCY}
    curves = tuple(Curve(names.get(s, s), np.asarray(estimates[f"{s}_ms"])) for s in STAGES)
    return Plot("latency by stage, ms", time_s, curves, limit_ms)


def first_fault(
    estimates: Columns, time_s: np.ndarray, happened: Sequence[ReportEvent], large_error: str = "",
    since_s: float | None = None,
) -> str:  # fmt: skip
    """The first fault after localization began, as text; it begins with `NOTHING` without one.
    large_error: "SECONDS TEXT" of the first large error, if the truth is known, or "". since_s: a
    fault before it counts only if there is no later one.
    """
    states = np.asarray(estimates.get("state", np.empty(0)))
    began = np.flatnonzero(states == "tracking")
    if not len(began):
        last = next((e.text for e in reversed(happened) if e.level == "warning"), "")
        return "never localized" + (f"; the last warning: {last}" if last else "")
    begin_s = float(time_s[began[0]])
    if since_s is not None and since_s > begin_s:
        later = tuple(event for event in happened if event.time_s >= since_s)
        after = _first_since(since_s, states, time_s, later, large_error)
        before = _first_since(begin_s, states, time_s, happened, large_error)
        return after or (f"{NOTHING} while GNSS was denied; before, {before}" if before else _WELL)
    return _first_since(begin_s, states, time_s, happened, large_error) or _WELL


def _first_since(
    begin_s: float, states: np.ndarray, time_s: np.ndarray, happened: Sequence[ReportEvent],
    large_error: str,
) -> str:  # fmt: skip
    """The first fault from begin_s on, with its time; "" without one."""
    found: list[tuple[float, str]] = []
    left = np.flatnonzero((states != "tracking") & (time_s > begin_s))
    if len(left):
        t = float(time_s[left[0]])
        found.append((t, f"tracking ended in state {states[left[0]]}"))
    for event in happened:
        if event.level == "warning" and event.time_s >= begin_s:
            if event.alert in _HARMLESS:
                continue
            found.append((event.time_s, event.text))
            break
    if large_error:
        when, _, text = large_error.partition(" ")
        found.append((float(when), text))
    if not found:
        return ""
    t, text = min(found)
    return f"at {t:.1f} s: {text}"


def target_marks(targets: Columns) -> tuple[MapMark, ...]:
    """Last position of each target, with its sigma."""
    marks = []
    for name, rows in by_name(targets).items():
        i = rows[-1]
        columns = ("east_m", "north_m", "sigma_horizontal_m")
        east, north, sigma = (float(targets[key][i]) for key in columns)
        if np.isfinite([east, north, sigma]).all():
            marks.append(MapMark(name, east, north, "target", sigma))
    return tuple(marks)


def by_name(targets: Columns) -> dict[str, np.ndarray]:
    """Row indices of each target by its name, in order of first appearance."""
    if not targets:
        return {}
    names = np.asarray(targets["target_id"])
    return {str(n): np.flatnonzero(names == n) for n in dict.fromkeys(names)}


def target_table(
    targets: Columns, errors: Mapping[str, np.ndarray] | None = None, limit_m: float | None = None
) -> ReportTable | None:
    """One row for each target: last position and, if the truth is known, errors; None without a
    target. errors: by target (3,) median, p95 and maximum, m; limit_m: of p95, beyond it is bad.
    """
    grouped = by_name(targets)
    known = errors or {}
    names = [*grouped, *(n for n in known if n not in grouped)]
    if not names:
        return None
    rows: list[tuple[str, ...]] = []
    bad = set()
    for name in names:
        cells = [name, *_last_place(targets, grouped.get(name))]
        if errors is not None:
            spread = known.get(name, np.full(3, np.nan))
            cells += [f"{v:.2f}" if np.isfinite(v) else "-" for v in spread]
            if limit_m is not None and spread[1] > limit_m:
                bad.add(len(rows))
        rows.append(tuple(cells))
    headings = ("target", "fixes", "latitude", "longitude", "height, m", "sigma, m", "elsewhere")
    more = ("median error, m", "p95, m", "max, m") if errors is not None else ()
    note = _NEWEST_FIX if errors is None else f"{_NEWEST_FIX} {_EVERY_FIX}"
    return ReportTable((*headings, *more), tuple(rows), frozenset(bad), note)


def _last_place(targets: Columns, rows: np.ndarray | None) -> tuple[str, ...]:
    if rows is None:
        return ("0", "-", "-", "-", "-", "-")
    i = rows[-1]
    return (
        str(len(rows)),
        f"{targets['latitude_deg'][i]:.7f}",
        f"{targets['longitude_deg'][i]:.7f}",
        f"{targets['height_m'][i]:.1f}",
        f"{targets['sigma_horizontal_m'][i]:.2f}",
        f"{100 * targets['elsewhere'][i]:.0f} %",
    )
