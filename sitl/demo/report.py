"""A flight's report: numbers, plots, overlays and tables in one folder."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from companion.config import CompanionConfig, load_config
from companion.errors import ReportError
from companion.offline.plots import (
    ErrorSeries,
    MapPicture,
    overlay_sheet,
    plot_errors,
    plot_tracks,
    save_image,
)
from companion.offline.tables import Columns, poses, read_columns
from companion.reporting.figures import LATENCY
from companion.reporting.verdicts import advice, compared
from companion.versions import made_by
from localizer.evaluation.metrics import LocalizationMetrics
from localizer.features.extractor import load_extractor
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.map.inspection.kind import map_kind
from localizer.pictures import read_rgb
from localizer.render.numba_raster import NumbaRenderer
from localizer.tracking.pipeline import Undistorter
from localizer.types import Frame
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
from sitl.demo.criteria import (
    ComputingRates,
    Criterion,
    FlightFigures,
    headline,
    judge,
    latency_warning,
)
from sitl.demo.flight import DemoRecord
from sitl.demo.scenario import Scenario

_OVERLAYS = 4
_MAP_MARGIN_M = 90.0
_MAP_PICTURE_PX = 900


@dataclass(frozen=True)
class FlightReport:
    """The flight's figures over the span without GNSS.

    localizer: the paper's columns over processed frames, and the spreads of its accepted
    estimates' errors; completeness_sent: per cent of all frames that the camera sent in the
    span with an accepted estimate. ekf_in_map_m: against where the map shows the vehicle,
    ekf_horizontal_m: against where GNSS would have it; the map lies map_shift_m beside GNSS.
    inside_bound: per cent of fixes within their own 95 % ellipse; inside_level: within their
    protection level, of which protection_m are the horizontal ones. fixed_inside: per cent of
    the standing targets' fixes within their own 95 % ellipse. map_kind: what the map can show.
    targets: name to 3-D error, in the map's frame. warning: of late estimates. won: the flight
    in one line; broken: why it was not flown to its end; slow: what the computer did not keep
    up with.
    """

    won: str
    vehicle: str
    denied_s: float
    flown_m: float
    localizer: LocalizationMetrics
    localizer_m: Spread
    localizer_horizontal_m: Spread
    localizer_deg: Spread
    completeness_sent: float
    frames_sent: int
    frames_dropped: int
    ekf_horizontal_m: Spread
    ekf_in_map_m: Spread
    map_shift_m: tuple[float, float, float]
    inside_bound: float | None
    inside_level: float | None
    protection_m: Spread
    map_kind: str
    ekf_vertical_m: Spread
    home_error_m: float
    fixed_targets_m: Spread
    fixed_inside: float | None
    moving_targets_m: Spread
    targets_m: Mapping[str, Spread]
    target_fixes: Mapping[str, int]
    stages_ms: Mapping[str, Spread]
    camera_ms: Mapping[str, tuple[float, float]]
    criteria: tuple[Criterion, ...]
    warning: str | None
    broken: str | None = None
    slow: str | None = None


@dataclass(frozen=True)
class _Tables:
    """A flight's records as they are read from its folder."""

    truth: Columns
    estimates: Columns
    targets: Columns
    vehicle: Columns

    @classmethod
    def read(cls, folder: Path) -> _Tables:
        """What the camera, the companion and the vehicle left."""
        record = folder / "companion"
        for name in ("estimates.csv", "targets.csv"):  # of a companion that never came up
            if not (record / name).exists():
                raise ReportError(f"{folder}: no report of this flight: {name} was never written")
        return cls(
            read_columns(folder / "frames.csv"),
            read_columns(record / "estimates.csv", text=("state", "status")),
            read_columns(record / "targets.csv", text=("target_id", "visibility")),
            read_columns(folder / "vehicle.csv"),
        )


def make_report(record: DemoRecord, scenario: Scenario, seed: int) -> FlightReport:
    """Measure the records and write report.json, frames, plots and overlays into their folder."""
    folder, span = record.folder, record.denied_ns
    tables = _Tables.read(folder)
    truth, estimates, targets, vehicle = (
        tables.truth, tables.estimates, tables.targets, tables.vehicle
    )  # fmt: skip
    errors = frame_errors(truth, estimates, span)
    shift_m = record.errors.map_shift_m
    _, absolute, _ = ekf_errors(vehicle, span)
    ekf_times, horizontal, vertical = ekf_errors(vehicle, span, shift_m)
    by_target = _target_errors(record, targets)
    still = {t.name for t in record.targets if isinstance(t, FixedPoint)}
    fixed = [e for name, e in by_target.items() if name in still]
    moving = {name: e for name, e in by_target.items() if name not in still}
    by_target = {n: e for n, e in by_target.items() if n in still or len(e)}
    accepted = np.isfinite(errors.translation_m)
    config = load_config(folder / "companion.yaml")
    summary = localization_summary(errors)
    fixed_targets = Spread.of(np.concatenate([*fixed, np.empty(0)]))
    bounds = bound_figures(truth, estimates, span)
    judged = FlightFigures(
        summary, Spread.of(horizontal), fixed_targets, bounds.inside_bound, bounds.inside_level,
        _fixed_inside(record, targets, still),
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
        localizer_horizontal_m=Spread.of(errors.horizontal_m),
        localizer_deg=Spread.of(errors.rotation_deg),
        completeness_sent=100.0 * float(accepted.mean()) if len(accepted) else 0.0,
        frames_sent=len(accepted),
        frames_dropped=int((~errors.processed).sum()),
        ekf_horizontal_m=Spread.of(absolute),
        ekf_in_map_m=judged.ekf_m,
        map_shift_m=shift_m,
        inside_bound=bounds.inside_bound,
        inside_level=bounds.inside_level,
        protection_m=bounds.level_m,
        map_kind=map_kind(TileCache.open(config.map)).line(),
        ekf_vertical_m=Spread.of(vertical),
        home_error_m=record.home_error_m,
        fixed_targets_m=fixed_targets,
        moving_targets_m=Spread.of(np.concatenate([*moving.values(), np.empty(0)])),
        targets_m={name: Spread.of(e) for name, e in by_target.items()},
        target_fixes={name: len(e) for name, e in by_target.items()},
        stages_ms=stages,
        camera_ms=record.camera.stage_ms,
        criteria=judge(judged, satellite=scenario.satellite is not None),
        fixed_inside=judged.fixed_inside,
        warning=latency_warning(latency, config.bridge.injection.delay_ms),
        broken=record.broken,
        slow=_pace(record, scenario, errors, latency, config).complaint(),
    )
    _write_json(folder, report, record, scenario, seed, config)
    _write_frames(folder / "frames_report.csv", errors)
    if estimates:
        _plot(record, tables, (ekf_times, horizontal), config)
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


def _target_errors(record: DemoRecord, targets: Columns) -> dict[str, Array]:
    if not len(targets):
        return {t.name: np.empty(0) for t in record.targets}
    return target_errors(targets, _target_truth(record, targets), record.denied_ns)


def _fixed_inside(record: DemoRecord, targets: Columns, still: set[str]) -> float | None:
    if not len(targets):
        return None
    truth = {k: v for k, v in _target_truth(record, targets).items() if k in still}
    return targets_inside(targets, truth, record.denied_ns)


def _target_truth(record: DemoRecord, targets: Columns) -> TruthAt:
    times = [int(t) for t in targets["exposure_time_ns"]]
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
    (folder / "report.json").write_text(json.dumps(document, indent=1, default=float))


def _write_frames(path: Path, errors: FrameErrors) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(
            ("exposure_time_ns", "processed", "translation_error_m", "horizontal_error_m",
             "rotation_error_deg")
        )  # fmt: skip
        values = (errors.translation_m, errors.horizontal_m, errors.rotation_deg)
        for time_ns, processed, *row in zip(errors.time_ns, errors.processed, *values, strict=True):
            writer.writerow((int(time_ns), int(processed), *(_cell(x) for x in row)))


def _cell(value: float) -> str:
    return f"{value:.4f}" if np.isfinite(value) else ""


def _plot(
    record: DemoRecord, tables: _Tables, ekf: tuple[Array, Array], config: CompanionConfig
) -> None:
    """ekf: times in ns and horizontal errors."""
    folder, start = record.folder, record.denied_ns[0]
    estimates, vehicle = tables.estimates, tables.vehicle
    all_errors = frame_errors(tables.truth, estimates, (0, 2**62))
    exposed_s = _seconds(all_errors.time_ns, start)
    series = [
        ErrorSeries("localizer", exposed_s, all_errors.translation_m, "3-D position error, m"),
        ErrorSeries("localizer", exposed_s, all_errors.horizontal_m, "horizontal error, m"),
        ErrorSeries("autopilot's EKF", _seconds(ekf[0], start), ekf[1], "horizontal error, m"),
        ErrorSeries("localizer", exposed_s, all_errors.rotation_deg, "rotation error, °"),
    ]
    end = (record.denied_ns[1] - start) * 1e-9
    plot_errors(
        folder / "errors.png", series, [(0.0, end, "GNSS denied")], "time since GNSS went off, s"
    )
    cache = TileCache.open(config.map)
    streamer = TileStreamer(cache)
    try:
        renderer = NumbaRenderer(streamer)
        accepted = np.asarray(estimates["accepted"]) > 0
        tracks = {
            "truth": _track(vehicle, ""),
            "autopilot's EKF": _track(vehicle, "ekf_"),
            "localizer (camera)": _track(estimates, "")[accepted],
        }
        fixed = (t for t in record.targets if isinstance(t, FixedPoint))
        marks = {t.name: t.position_at(start) for t in fixed}
        denied = min(int(np.searchsorted(vehicle["time_ns"], start)), len(tracks["truth"]) - 1)
        marks["GNSS off"] = tracks["truth"][denied]
        picture = _map_picture(renderer, tracks.values())
        plot_tracks(folder / "tracks.png", tracks, picture, marks, _located(tables.targets))
        _overlays(folder, (estimates, all_errors), renderer, config, start)
    finally:
        streamer.close()


def _seconds(time_ns: Array, start: int) -> Array:
    return np.asarray((np.asarray(time_ns) - start) * 1e-9, dtype=np.float64)


def _track(columns: Columns, prefix: str) -> Array:
    return np.column_stack([columns[f"{prefix}{k}_m"] for k in ("east", "north", "up")])


def _map_picture(renderer: NumbaRenderer, tracks: Iterable[Array]) -> MapPicture:
    """The map about the tracks from high above through a long lens: nearly an orthophoto."""
    height = 6000.0
    size = max(float(np.abs(t[:, :2]).max()) for t in tracks if len(t)) + _MAP_MARGIN_M
    fov = float(np.degrees(2 * np.arctan(size / height)))
    camera = Camera.from_fov(_MAP_PICTURE_PX, _MAP_PICTURE_PX, fov)
    pose = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, height]))
    view = renderer.render(pose, camera, wait=True)
    return MapPicture(view.rgb, -size, size, -size, size)


def _located(targets: Columns) -> dict[str, Array]:
    """Every fix of each target."""
    if not len(targets):
        return {}
    names = np.asarray(targets["target_id"])
    places = _track(targets, "")
    return {f"{name}, located": places[names == name] for name in dict.fromkeys(map(str, names))}


def _overlays(
    folder: Path,
    measured: tuple[Columns, FrameErrors],
    renderer: NumbaRenderer,
    config: CompanionConfig,
    start: int,
) -> None:
    """The recorded video frames with the largest errors against the map rendered at their estimated
    poses; times from start.
    """
    estimates, errors = measured
    stamps = np.asarray(estimates["exposure_time_ns"])
    accepted = np.asarray(estimates["accepted"]) > 0
    estimated = poses(estimates)
    camera = config.camera.model.camera()
    target = camera.without_distortion()
    undistort = Undistorter(camera, target)
    usable = []
    for path in sorted((folder / "companion" / "snapshots").glob("*.jpg")):
        k = int(np.argmin(np.abs(stamps - int(path.stem))))
        i = int(np.argmin(np.abs(errors.time_ns - int(path.stem))))
        error_m = float(errors.translation_m[i])
        if accepted[k] and abs(int(stamps[k]) - int(path.stem)) < 2_000_000:
            usable.append((path, k, error_m if np.isfinite(error_m) else 0.0))
    usable.sort(key=lambda item: -item[2])
    for number, (path, k, error_m) in enumerate(usable[:_OVERLAYS]):
        image = read_rgb(path)
        video = undistort(Frame(image, int(path.stem), camera, 0))
        view = renderer.render(estimated[k], target, wait=True)
        caption = f"t = {(int(path.stem) - start) * 1e-9:.1f} s, {error_m:.2f} m off"
        save_image(folder / f"overlay-{number}.png", overlay_sheet(video, view.rgb, caption))


def print_report(report: FlightReport, folder: Path) -> None:
    """The tables that end a flight."""
    console = Console()
    if report.broken is None:
        console.print(f"[bold green]{report.won}[/]", highlight=False)
    m = report.localizer
    table = Table(title=f"GNSS denied for {report.denied_s:.0f} s, {report.flown_m:.0f} m flown "
                        f"({report.vehicle})")  # fmt: skip
    table.add_column("")
    for column in ("median", "p95", "max", ""):
        table.add_column(column, justify="right")
    add_spread(table, "localizer 3-D, m", report.localizer_m,
         f"R@1/3/5 {m.recall_1:.1f}/{m.recall_3:.1f}/{m.recall_5:.1f} %")  # fmt: skip
    add_spread(table, "localizer horizontal, m", report.localizer_horizontal_m, "")
    add_spread(table, "protection level, m", report.protection_m,
         f"{_figure(report.inside_level, 1)} % of fixes inside, "
         f"{_figure(report.inside_bound, 1)} % inside their 95 % bound")  # fmt: skip
    add_spread(table, "localizer rotation, °", report.localizer_deg,
         f"completeness {m.completeness:.1f} % ({report.completeness_sent:.1f} % of sent)",
         )  # fmt: skip
    add_spread(
        table,
        "EKF horizontal, m",
        report.ekf_in_map_m,
        f"{report.home_error_m:.1f} m from home at end",
    )
    shift_m = float(np.hypot(*report.map_shift_m[:2]))
    if shift_m > 0:
        add_spread(table, "EKF against GNSS, m", report.ekf_horizontal_m,
                   f"the map lies {shift_m:.1f} m beside GNSS")  # fmt: skip
    add_spread(table, "EKF vertical, m", report.ekf_vertical_m, "")
    add_spread(table, "fixed targets, m", report.fixed_targets_m,
         f"3-D; {_figure(report.fixed_inside, 1)} % inside their 95 % bound")  # fmt: skip
    add_spread(table, "moving targets, m", report.moving_targets_m, "3-D, every car seen")
    for name, spread in report.targets_m.items():
        add_spread(table, f"  {name}, m", spread, f"{report.target_fixes[name]} fixes")
    console.print(table)
    console.print(f"map: {report.map_kind}", highlight=False)
    stages = Table(title=f"{m.fps:.1f} localized frames/s, {report.frames_dropped} of "
                         f"{report.frames_sent} frames dropped")  # fmt: skip
    stages.add_column("stage while GNSS was denied, ms")
    stages.add_column("p50", justify="right")
    stages.add_column("p95", justify="right")
    for name, spread in report.stages_ms.items():
        stages.add_row(
            LATENCY if name == "latency" else name, _figure(spread.median, 0),
            _figure(spread.p95, 0),
        )  # fmt: skip
    for name, (p50, p95) in report.camera_ms.items():
        stages.add_row(f"world camera: {name}", f"{p50:.0f}", f"{p95:.0f}")
    console.print(stages)
    console.print(_verdict(report))
    for criterion in (c for c in report.criteria if not c.ok):
        known = advice(criterion.name)
        console.print(f"[red]{criterion.name}[/]: {known.meaning}. Look at: {known.look}.",
                      highlight=False)  # fmt: skip
    if report.warning is not None:
        console.print(f"[yellow]warning:[/] {report.warning}", highlight=False)
    if report.slow is not None:
        console.print(f"[yellow]warning:[/] {report.slow}", highlight=False)
    console.print(f"report: [green]{folder}[/]/report.json, tracks.png, errors.png, overlay-*.png")


def _verdict(report: FlightReport) -> Table:
    passed = all(c.ok for c in report.criteria)
    table = Table(title="[green]criteria held" if passed else "[red]criteria missed")
    for column in ("criterion", "found", "needed", ""):
        table.add_column(column, justify="left" if column in ("criterion", "") else "right")
    for c in report.criteria:
        value, needed = compared(c.value, c.limit, c.unit, at_least=c.at_least)
        mark = "[green]ok" if c.ok else "[red]missed"
        table.add_row(c.name, value, needed, mark)
    return table


def add_spread(table: Table, name: str, spread: Spread, note: str) -> None:
    """A row of a table of errors."""
    figures = (spread.median, spread.p95, spread.maximum)
    table.add_row(name, *(_figure(x, 2) for x in figures), note)


def _figure(value: float | None, digits: int) -> str:
    return "none" if value is None else f"{value:.{digits}f}"
