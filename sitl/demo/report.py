"""Figures and criteria of a flight: writes report.json and frames_report.csv."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from companion.config import CompanionConfig, load_config
from companion.errors import ReportError
from companion.offline.record import Columns, read_columns
from companion.reporting.content import advice, value_and_limit
from companion.versions import made_by
from companion.writing import write_result
from localizer.evaluation.sequences import LocalizationMetrics
from localizer.features.extractor import load_extractor
from localizer.map.cache.cache import TileCache
from localizer.map.inspection.kind import map_kind
from sitl.camera.detector import FixedPoint
from sitl.demo.analysis import (
    FrameErrors,
    Spread,
    TruthAt,
    bound_figures,
    ekf_errors,
    frame_errors,
    localization_summary,
    stage_latencies,
    target_errors,
    targets_inside,
)
from sitl.demo.flight import DemoRecord
from sitl.demo.scenario import Scenario

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


@dataclass(frozen=True)
class FlightReport:
    """The flight's figures over the span without GNSS.

    won: the flight in one line. localizer: the paper's columns over processed frames. localizer_m:
    errors of the accepted estimates. ekf_horizontal_m: EKF errors in GNSS's frame; ekf_in_map_m: in
    the map's frame, which is shifted by map_shift_m against GNSS. inside_bound: per cent of fixes
    within their 95 % ellipse; inside_level: within their protection level; protection_m: the
    horizontal protection levels. fixed_inside: per cent of the fixed targets' positions within
    their 95 % ellipse. targets_m: 3-D error by name, in the map's frame. map_kind: kind of the
    map's data. stages_ms: latency of each processing stage. broken: why the flight ended early;
    slow: why the computer was too slow; None otherwise.
    """

    won: str
    vehicle: str
    denied_s: float
    flown_m: float
    localizer: LocalizationMetrics
    localizer_m: Spread
    frames_sent: int
    frames_dropped: int
    ekf_horizontal_m: Spread
    ekf_in_map_m: Spread
    map_shift_m: tuple[float, float, float]
    inside_bound: float | None
    inside_level: float | None
    protection_m: Spread
    map_kind: str
    home_error_m: float
    fixed_targets_m: Spread
    fixed_inside: float | None
    targets_m: Mapping[str, Spread]
    stages_ms: Mapping[str, Spread]
    criteria: tuple[Criterion, ...]
    broken: str | None = None
    slow: str | None = None


def _tables(folder: Path) -> tuple[Columns, Columns, Columns, Columns]:
    """What the camera (truth), the companion (estimates, targets) and the vehicle left."""
    record = folder / "companion"
    for name in ("estimates.csv", "targets.csv"):  # of a companion that never came up
        if not (record / name).exists():
            raise ReportError(f"{folder}: no report of this flight: {name} was never written")
    return (
        read_columns(folder / "frames.csv"),
        read_columns(record / "estimates.csv", text=("state", "status")),
        read_columns(record / "targets.csv", text=("target_id", "visibility")),
        read_columns(folder / "vehicle.csv"),
    )


def make_report(record: DemoRecord, scenario: Scenario, seed: int) -> FlightReport:
    """Compute a flight's figures from its folder, and write report.json and frames_report.csv
    there. `ReportError` if the companion's tables are missing.
    """
    folder, span = record.folder, record.denied_ns
    truth, estimates, targets, vehicle = _tables(folder)
    errors = frame_errors(truth, estimates, span)
    shift_m = record.errors.map_shift_m
    absolute = ekf_errors(vehicle, span)
    horizontal = ekf_errors(vehicle, span, shift_m)
    true_places = _target_truth(record, targets)
    by_target = target_errors(targets, true_places, span)
    still = {t.name for t in record.targets if isinstance(t, FixedPoint)}
    fixed = [e for name, e in by_target.items() if name in still]
    by_target = {n: e for n, e in by_target.items() if n in still or len(e)}
    of_fixed = {name: places for name, places in true_places.items() if name in still}
    config = load_config(folder / "companion.yaml")
    summary = localization_summary(errors)
    fixed_targets = Spread.of(np.concatenate([*fixed, np.empty(0)]))
    bounds = bound_figures(truth, estimates, span)
    judged = FlightFigures(
        summary, Spread.of(horizontal), fixed_targets, bounds.inside_bound, bounds.inside_level,
        targets_inside(targets, of_fixed, span),
    )  # fmt: skip
    denied_s = (span[1] - span[0]) * 1e-9
    stages = stage_latencies(estimates, span) if estimates else {}
    latency = stages.get("latency", Spread(None, None, None))
    report = FlightReport(
        won=headline(judged, record.home_error_m, denied_s)
        if record.broken is None
        else f"the flight broke off after {denied_s:.0f} s: {record.broken}",
        vehicle=record.vehicle,
        denied_s=denied_s,
        flown_m=_flown(vehicle, span),
        localizer=summary,
        localizer_m=Spread.of(errors.translation_m),
        frames_sent=len(errors.processed),
        frames_dropped=int((~errors.processed).sum()),
        ekf_horizontal_m=Spread.of(absolute),
        ekf_in_map_m=judged.ekf_m,
        map_shift_m=shift_m,
        inside_bound=bounds.inside_bound,
        inside_level=bounds.inside_level,
        protection_m=bounds.level_m,
        map_kind=map_kind(TileCache.open(config.map)).line(),
        home_error_m=record.home_error_m,
        fixed_targets_m=fixed_targets,
        targets_m={name: Spread.of(e) for name, e in by_target.items()},
        stages_ms=stages,
        criteria=check_criteria(judged, satellite=scenario.satellite is not None),
        fixed_inside=judged.fixed_inside,
        broken=record.broken,
        slow=_pace(record, scenario, errors, latency, config).slow_reason(),
    )
    _write_json(folder, report, record, scenario, seed, config)
    _write_frames(folder / "frames_report.csv", errors)
    return report


def _pace(
    record: DemoRecord, scenario: Scenario, errors: FrameErrors, latency: Spread,
    config: CompanionConfig,
) -> ComputingRates:  # fmt: skip
    frames = len(errors.time_ns)
    seconds = float(errors.time_ns[-1] - errors.time_ns[0]) * 1e-9 if frames > 1 else 0.0
    return ComputingRates(
        (frames - 1) / seconds if seconds else 0.0,
        scenario.camera.rate_hz,
        float(errors.processed.mean()) if frames else 0.0,
        latency.p95,
        config.bridge.injection.delay_ms,
        record.load,
    )


def _target_truth(record: DemoRecord, targets: Columns) -> TruthAt:
    times = [int(t) for t in targets.get("exposure_time_ns", ())]
    return {t.name: {ns: t.position_at(ns) for ns in times} for t in record.targets}


def _flown(vehicle: Columns, span: tuple[int, int]) -> float:
    inside = (vehicle["time_ns"] >= span[0]) & (vehicle["time_ns"] <= span[1])
    track = np.column_stack([vehicle[k][inside] for k in ("east_m", "north_m", "up_m")])
    return float(np.linalg.norm(np.diff(track[::5], axis=0), axis=1).sum())


def _write_json(
    folder: Path,
    report: FlightReport,
    record: DemoRecord,
    scenario: Scenario,
    seed: int,
    config: CompanionConfig,
) -> None:
    document = {
        "report": asdict(report) | {"passed": all(c.ok for c in report.criteria)},
        "versions": made_by(),
        "seed": seed,
        "features": load_extractor(config.localizer.model).name,
        "scenario": scenario.model_dump(mode="json"),
        "errors": asdict(record.errors) | {"gimbal_alignment_deg": record.gimbal_alignment_deg},
        "config": config.model_dump(mode="json"),
        "texts": list(record.texts),
    }
    write_result(folder / "report.json", json.dumps(document, indent=1, default=float))


def _write_frames(path: Path, errors: FrameErrors) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(
            ("exposure_time_ns", "processed", "translation_error_m", "horizontal_error_m",
             "rotation_error_deg")
        )  # fmt: skip
        values = (errors.translation_m, errors.horizontal_m, errors.rotation_deg)
        for time_ns, processed, *row in zip(errors.time_ns, errors.processed, *values, strict=True):
            known = (f"{x:.4f}" if np.isfinite(x) else "" for x in row)
            writer.writerow((int(time_ns), int(processed), *known))


def print_report(report: FlightReport, folder: Path) -> None:
    """Print the criteria, causes of failures, and warnings."""
    console = Console()
    if report.broken is None:
        console.print(f"[bold green]{report.won}[/]", highlight=False)
    console.print(f"map: {report.map_kind}", highlight=False)
    console.print(_verdict(report))
    for criterion in (c for c in report.criteria if not c.ok):
        known = advice(criterion.name)
        console.print(f"[red]{criterion.name}[/]: {known.meaning}. Look at: {known.look}.",
                      highlight=False)  # fmt: skip
    if report.slow is not None:
        console.print(f"[yellow]warning:[/] {report.slow}", highlight=False)
    console.print(f"figures: [green]{folder}[/]/report.json")


def _verdict(report: FlightReport) -> Table:
    passed = all(c.ok for c in report.criteria)
    table = Table(title="[green]criteria held" if passed else "[red]criteria missed")
    for column in ("criterion", "found", "needed", ""):
        table.add_column(column, justify="left" if column in ("criterion", "") else "right")
    for c in report.criteria:
        value, needed = value_and_limit(c.value, c.limit, c.unit, at_least=c.at_least)
        mark = "[green]ok" if c.ok else "[red]missed"
        table.add_row(c.name, value, needed, mark)
    return table
