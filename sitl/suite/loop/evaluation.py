"""Computes a flight's figures from its samples, checks the expectations, and prints them."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from scipy.stats import binomtest

from companion.writing import json_value
from mavlink_bridge.alerts.catalogue import spec_of
from mavlink_bridge.alerts.ids import AlertId
from sitl.demo.companion_process import Health
from sitl.demo.scenario import ScenarioError
from sitl.suite.checks import AlertExpectation
from sitl.suite.loop.case import Expectation
from sitl.suite.record import Text
from sitl.suite.runner import PACE_LIMIT, STALL_LIMIT_S
from sitl.vehicles.process import VehicleKind

_COLUMNS = (
    "flight", "vehicle, seed", "EKF at most, m", "unreported, s", "false of sent", "worst fix, m",
    "reported, s", "frames/s", "held",
)  # fmt: skip


@dataclass(frozen=True)
class LoopRow:
    """Result of one flight; error: why it could not be flown, otherwise empty.

    alarms: false alarms; None for a flight with a fault. pace, stall_s: see `sitl.suite.record`.
    """

    name: str
    vehicle: VehicleKind
    seed: int
    held: tuple[LoopExpectationResult, ...]
    figures: LoopFigures | None = None
    alarms: tuple[str, ...] | None = None
    pace: float = 1.0
    stall_s: float = 0.0
    error: str = ""

    @property
    def ok(self) -> bool:
        """Whether the flight was flown and every expectation holds."""
        return not self.error and all(held.ok for held in self.held)

    @property
    def valid(self) -> bool:
        """Whether it was flown, in real time."""
        return not self.error and not self.slow

    @property
    def slow(self) -> bool:
        """Whether the vehicle did not run in real time; the result then says little."""
        return self.pace < PACE_LIMIT or self.stall_s > STALL_LIMIT_S


@dataclass(frozen=True)
class FalseAlarms:
    """False-alarm statistics of flights without a fault. low, high: exact 95 % interval of the
    share of flights with an alarm (Clopper and Pearson). told_s: seconds with an alert.
    """

    flights: int
    with_alarm: int
    low: float
    high: float
    hours: float
    told_s: float


def false_alarm_rate(rows: Sequence[LoopRow]) -> FalseAlarms | None:
    """False-alarm statistics of the flown flights without a fault; None without any."""
    normal = [row for row in rows if row.alarms is not None and row.figures is not None]
    if not normal:
        return None
    n, hits = len(normal), sum(bool(row.alarms) for row in normal)
    flown = [row.figures for row in normal if row.figures is not None]
    share = binomtest(hits, n).proportion_ci()
    return FalseAlarms(
        flights=n,
        with_alarm=hits,
        low=float(share.low),
        high=float(share.high),
        hours=sum(f.seconds for f in flown) / 3600.0,
        told_s=sum(f.told_s for f in flown),
    )


def as_data(rows: Sequence[LoopRow]) -> dict[str, Any]:
    """Rows as JSON data; NaN and infinity become None."""
    rate = false_alarm_rate(rows)
    flights = [asdict(row) | {"ok": row.ok, "slow": row.slow} for row in rows]
    alarms = None if rate is None else asdict(rate)
    return {"flights": json_value(flights), "false_alarms": json_value(alarms)}


def read_rows(path: Path) -> tuple[LoopRow, ...]:
    """Read the rows of a ``loop.json``. `ScenarioError` for another file."""
    try:
        flights = json.loads(path.read_text(encoding="utf-8"))["flights"]
        return tuple(_row(flight) for flight in flights)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ScenarioError(f"{path}: not a loop.json of this version: {error}") from error


def _row(flight: dict[str, Any]) -> LoopRow:
    known = {k: v for k, v in flight.items() if k not in ("ok", "slow")}
    figures, alarms = known.pop("figures"), known.pop("alarms")
    if figures is not None:
        unknown = {k: math.nan for k, v in figures.items() if v is None}
        figures = LoopFigures(**(figures | unknown))
    known["held"] = tuple(LoopExpectationResult(**one) for one in known["held"])
    return LoopRow(**known, figures=figures, alarms=None if alarms is None else tuple(alarms))


def markdown(rows: Sequence[LoopRow]) -> str:
    """Markdown table of the flights, failed ones first, and below it the rate of false alarms if
    there were normal flights.
    """
    ordered = sorted(rows, key=lambda row: (row.ok, row.name, row.vehicle, row.seed))
    lines = ["| " + " | ".join(_COLUMNS) + " |", "|" + "---|" * len(_COLUMNS)]
    lines += ["| " + " | ".join(_cells(row)) + " |" for row in ordered]
    rate = false_alarm_rate(rows)
    if rate is not None:
        share = f"{rate.with_alarm} of {rate.flights} normal flights with a false alarm"
        low, high = 100 * rate.low, 100 * rate.high
        lines += ["", f"{share} ({low:.0f} to {high:.0f} %, exact 95 %), {rate.told_s:.0f} s"]
        lines[-1] += f" reported of {3600 * rate.hours:.0f} s."
    return "\n".join([*lines, ""])


def print_loop_row(console: Console, row: LoopRow) -> None:
    """Print one flight's result."""
    if row.error:
        console.print(f"[red]ERROR[/] {row.name}: {escape(row.error)}", highlight=False)
    for held in row.held:
        mark = "[green]ok[/]" if held.ok else "[red]MISSED[/]"
        console.print(f"  {mark} {escape(held.what)}: {escape(held.seen)}", highlight=False)


def _cells(row: LoopRow) -> tuple[str, ...]:
    who = f"{row.vehicle}, {row.seed}" + (f" (pace {row.pace:.2f})" if row.slow else "")
    flown = row.figures
    if flown is None:
        return (row.name, who, *["-"] * 6, f"NOT FLOWN: {row.error.splitlines()[0]}")
    missed = [f"MISSED {held.what}: {held.seen}" for held in row.held if not held.ok]
    listed = [held.seen for held in row.held if held.ok and held.listed]
    return (
        row.name,
        who,
        f"{flown.max_error_m:.1f}",
        f"{flown.untold_s:.1f}",
        f"{flown.false} of {flown.sent}",
        f"{flown.max_fix_m:.1f}" if flown.sent else "-",
        f"{flown.told_s:.0f}",
        f"{flown.rate_hz:.1f}",
        "; ".join([*(missed or ["all"]), *listed]).replace("|", "/"),
    )


_STALE_S = 2.0  # a health report older than this is none: the process is gone, and its heartbeat
_FALSE_M = 5.0


@dataclass(frozen=True)
class LoopSample:
    """State of the flight at one time, seconds since the start of the recorded part.

    error_m: horizontal EKF error, infinite while the EKF reports no position. north_m, east_m: true
    position from home. mode: of the autopilot. level, health: level and text of the companion's
    health; age_s: age of that report. findings: active findings of its monitor. rate_hz: localized
    frames per second.
    """

    at_s: float
    error_m: float
    north_m: float
    east_m: float
    mode: str
    level: str
    health: str
    age_s: float
    findings: tuple[str, ...] = ()
    rate_hz: float = 0.0

    @property
    def is_reported(self) -> bool:
        """Whether the operator sees that something is wrong: a health worse than ok, an outdated
        health report, or a finding.
        """
        return self.level != "ok" or self.age_s > _STALE_S or bool(self.findings)


@dataclass(frozen=True)
class RestartTimes:
    """Seconds from the end of a companion until its successor works; infinite: never.

    estimates_s, tracks_s: until its first accepted estimate, and the first while tracking;
    injects_s: until its first position was sent to the autopilot.
    """

    estimates_s: float
    tracks_s: float
    injects_s: float


@dataclass(frozen=True)
class LoopRecord:
    """Record of a flight. fix_errors_m: horizontal error of every injected position.

    pace, stall_s: how far the simulated vehicle was from real time, see `sitl.suite.record`. back:
    restart times after a kill or hang; None without one. shadow: the health at the start of the
    recorded part; None if injection was forced. standing: alerts raised before the recorded part
    and not cleared before it, at_s negative; only of a deployment that is wrong from the start.
    """

    samples: tuple[LoopSample, ...]
    texts: tuple[Text, ...]
    fix_errors_m: tuple[float, ...]
    pace: float = 1.0
    stall_s: float = 0.0
    back: RestartTimes | None = None
    shadow: Health | None = None
    standing: tuple[Text, ...] = ()


@dataclass(frozen=True)
class LoopFigures:
    """Figures of a flight, metres and seconds.

    max_error_m: horizontal, of the EKF, while it reports a position. blind_s: time without one.
    untold_s: see `longest_unreported_s`. false: number of the `sent` injected positions with an
    error above 5 m; max_fix_m: the largest error of an injected position. told_s: time in which the
    operator sees that something is wrong. rate_hz: median of localized frames per second.
    """

    max_error_m: float
    blind_s: float
    untold_s: float
    false: int
    sent: int
    max_fix_m: float
    told_s: float
    rate_hz: float
    seconds: float


@dataclass(frozen=True)
class LoopExpectationResult:
    """Result of one expectation: its text, whether it holds, and the observed value. listed: the
    table shows the value even if the expectation holds.
    """

    what: str
    ok: bool
    seen: str
    listed: bool = False


def longest_unreported_s(samples: Sequence[LoopSample], beyond_m: float) -> float:
    """The longest time (s) with an EKF error above beyond_m and nothing that tells the operator."""
    longest, begun = 0.0, None
    for sample in samples:
        if sample.error_m <= beyond_m or sample.is_reported:
            begun = None
            continue
        begun = sample.at_s if begun is None else begun
        longest = max(longest, sample.at_s - begun)
    return longest


def figures(record: LoopRecord, beyond_m: float) -> LoopFigures:
    """Compute the figures of a flight. beyond_m: EKF error that must be reported."""
    samples, fixes = record.samples, np.asarray(record.fix_errors_m)
    spans = [(s, after.at_s - s.at_s) for s, after in pairwise(samples)]
    known = [s.error_m for s in samples if math.isfinite(s.error_m)]
    return LoopFigures(
        max_error_m=max(known, default=math.nan),
        blind_s=sum(length for s, length in spans if not math.isfinite(s.error_m)),
        untold_s=longest_unreported_s(samples, beyond_m),
        false=int(np.sum(fixes > _FALSE_M)),
        sent=len(fixes),
        max_fix_m=float(fixes.max()) if len(fixes) else math.nan,
        told_s=sum(length for s, length in spans if s.is_reported),
        rate_hz=float(np.median([s.rate_hz for s in samples])) if samples else 0.0,
        seconds=samples[-1].at_s if samples else 0.0,
    )


def false_alarms(record: LoopRecord, *, denied: bool = False) -> tuple[str, ...]:
    """All warnings, findings and health levels worse than ok of a flight without a fault, in order
    of time.

    denied: GNSS was switched off, so the alert GNSS_LOST is true and is left out.
    """
    told = [
        (t.at_s, t.text)
        for t in record.texts
        if t.is_warning and not (denied and t.alert is AlertId.GNSS_LOST)
    ]
    before: set[str] = set()
    for sample in record.samples:
        now = {f"finding {name}" for name in sample.findings}
        if sample.level != "ok" or sample.age_s > _STALE_S:
            now.add(f"health {sample.level}")
        told += [(sample.at_s, f"{what}: {sample.health}") for what in sorted(now - before)]
        before = now
    return tuple(f"{at_s:.1f} s: {text}" for at_s, text in sorted(told))


def evaluate(
    record: LoopRecord, expect: Expectation, *, denied: bool = False
) -> tuple[LoopExpectationResult, ...]:
    """Check all expectations. denied: GNSS was switched off at the start, so the alert GNSS_LOST is
    no false alarm.
    """
    samples, flown = record.samples, figures(record, expect.beyond_m)
    held: list[LoopExpectationResult] = []

    def hold(what: str, ok: bool, seen: str) -> None:
        held.append(LoopExpectationResult(what, ok, seen))

    hold(
        f"beyond {expect.beyond_m:g} m reported within {expect.told_within_s:g} s",
        bool(samples) and flown.untold_s <= expect.told_within_s,
        f"unreported for {flown.untold_s:.1f} s at most; error up to {flown.max_error_m:.1f} m",
    )
    for mode in expect.never_modes:
        seen = [s.at_s for s in samples if s.mode == mode]
        hold(f"never {mode}", not seen, f"from {seen[0]:.0f} s" if seen else "never")
    if expect.max_error_m is not None:
        ok = flown.max_error_m <= expect.max_error_m
        hold(f"EKF within {expect.max_error_m:g} m", ok, f"{flown.max_error_m:.1f} m")
    if expect.false_fixes is not None:
        ok = flown.false <= expect.false_fixes and (flown.sent > 0 or not expect.injects)
        hold("false fixes injected", ok, f"{flown.false} of {flown.sent}")
    if record.shadow is not None:
        hold("shadow check passed", record.shadow.ready, record.shadow.shadow)
    if expect.back_within_s is not None:
        back = record.back or RestartTimes(math.inf, math.inf, math.inf)
        found = f"estimate after {back.estimates_s:.1f} s, tracks {back.tracks_s:.1f}"
        found += f", injects {back.injects_s:.1f}"
        ok = back.injects_s <= expect.back_within_s
        hold(f"back within {expect.back_within_s:g} s", ok, found)
    if expect.ends_tracking:
        last = samples[-1] if samples else None
        ok = last is not None and last.level == "ok" and not last.age_s > _STALE_S
        hold("tracks at the end", ok, last.health if last else "no samples")
    held += [_reported(record, of) for of in expect.reports]
    held += [_timed(record.texts, of) for of in expect.alerts]
    if expect.warns_first is not None:
        held.append(_warned(record.texts, expect.warns_first))
    if expect.repeats is not None:
        held.append(_repeated(record.texts, expect.repeats))
    if expect.silent:
        told = false_alarms(record, denied=denied)
        hold("no warning", not told, "; ".join(told) or "none")
    return tuple(held)


def _repeated(texts: Sequence[Text], most: int) -> LoopExpectationResult:
    """Check that no alert was raised more than `most` times, because operators ignore texts that
    alternate.
    """
    said = Counter(t.alert.words for t in texts if t.alert is not None)
    words, times = said.most_common(1)[0] if said else ("nothing", 0)
    return LoopExpectationResult(
        f"reports nothing more than {most} times", times <= most, f"{times} times {words}"
    )


def standing_alerts(texts: Sequence[Text]) -> tuple[Text, ...]:
    """The last text of each alert that was raised and not cleared, of those whose end is told.
    texts: in order of time.
    """
    last = {t.alert: t for t in texts if t.alert is not None and spec_of(t.alert).reports_end}
    return tuple(t for t in last.values() if t.raised is not None)


def _reported(record: LoopRecord, of: AlertId) -> LoopExpectationResult:
    """Check that the operator was told: in the recorded part, or before it with no clearing."""
    found = [t for t in (*record.standing, *record.texts) if t.raised and t.alert is of]
    at = f"at {found[0].at_s:.1f} s" if found else "never"
    return LoopExpectationResult(f"reports {of.words}", bool(found), at)


def _timed(texts: Sequence[Text], of: AlertExpectation) -> LoopExpectationResult:
    found = of.evaluate_texts(texts)
    span = "never" if of.absent else f"from {of.from_s:g} to {of.to_s:g} s"
    return LoopExpectationResult(
        f"{of.alert.words} {span}", found.ok, found.what, listed=not of.absent
    )


def _warned(texts: Sequence[Text], of: AlertId) -> LoopExpectationResult:
    told = [t.at_s for t in texts if t.alert is of]
    worse = [t.at_s for t in texts if t.alert in (AlertId.DEGRADED, AlertId.BRIDGING, AlertId.LOST)]
    warned, ended = min(told, default=math.inf), min(worse, default=math.inf)
    seen = f"at {warned:.1f} s, worse at {ended:.1f} s"
    return LoopExpectationResult(
        f"reports {of.words} before localization is worse", warned < ended, seen
    )
