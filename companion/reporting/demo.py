"""Report of a demo flight, with the truth."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from companion.errors import RecordError
from companion.offline.record import Columns, RecordTables, poses, read_columns, read_record
from companion.reporting import figures
from companion.reporting.content import (
    INNER,
    MIDDLE,
    OUTER,
    CriterionResult,
    Curve,
    MapTrack,
    Overlay,
    Plot,
    Report,
    Span,
    Stanford,
    criterion_result,
)
from companion.reporting.pictures import map_pictures, silent
from companion.reporting.record import (
    KEPT_FRAMES,
    VISION,
    worst_frames,
)
from companion.reporting.record import uncertainty_plots as uncertainty
from companion.terminal.steps import Say
from localizer.plain_files import plain_text

_TRUTH, _EKF = "#ffffff", "#1fd1ff"
_LARGE_M = 3.0  # an error that the first-fault line names
_TARGET_LIMIT_M = 3.0


def demo_report(folder: Path, say: Say = silent) -> Report:
    """Make the report of `python -m sitl demo --out folder`; writes nothing. say: receives the
    present step as text. `RecordError` for another folder.
    """
    record = read_record(folder / "companion")
    try:
        document = json.loads(plain_text(folder / "report.json"))
        truth = read_columns(folder / "frames.csv")
        vehicle = read_columns(folder / "vehicle.csv")
        denied = read_columns(folder / "frames_report.csv")["exposure_time_ns"]
    except (OSError, ValueError, KeyError, RecursionError) as error:
        raise RecordError(f"{folder}: not a demo's folder: {error}") from error
    figures_of = document["report"]
    start_ns = int(denied[0]) if len(denied) else record.start_ns
    if not record.estimates:
        return replace(
            _empty(folder, document), verdicts=_verdicts(figures_of),
            events=figures.events(record.events, start_ns),
        )  # fmt: skip
    estimates = record.estimates
    time_s = figures.seconds(estimates["exposure_time_ns"], start_ns)
    errors = _errors(estimates, truth)
    end_s = (int(denied[-1]) - start_ns) * 1e-9 if len(denied) else 0.0
    happened = figures.events(record.events, start_ns)
    accepted = np.asarray(estimates["accepted"]) > 0
    off = np.flatnonzero(accepted & (errors["3-D"] > _LARGE_M) & (time_s >= 0))
    large = f"{time_s[off[0]]:.3f} the position was {errors['3-D'][off[0]]:.1f} m off" \
        if len(off) else ""  # fmt: skip
    with map_pictures(record.map_path, say, record.flown_map) as pictures:
        vision = figures.track("vision (camera)", VISION, INNER, estimates)
        tracks = [
            figures.track("truth", _TRUTH, OUTER, vehicle),
            figures.track("autopilot's EKF", _EKF, MIDDLE, vehicle, "ekf_"),
            MapTrack(
                vision.name, VISION, INNER, np.where(accepted[:, None], vision.points, np.nan)
            ),
        ]
        sheet = pictures.sheet(tracks, figures.target_marks(record.targets))
        goodness = np.where(accepted, -errors["3-D"], np.nan)
        overlays: tuple[Overlay, ...] = ()
        if (camera := record.camera) is not None:
            shown = worst_frames(record, goodness, "error in m", time_s)
            overlays = pictures.overlays(shown, camera)
        notes = (*record.notes, *pictures.notes, *filter(None, (figures_of.get("slow"),)))
    spans = (Span(0.0, end_s, "GNSS denied"),)
    return Report(
        f"Demo flight, seed {document.get('seed')}",
        f"{figures_of['vehicle']}, GNSS denied for {figures_of['denied_s']:.0f} s, "
        f"{figures_of['flown_m']:.0f} m flown; {record.health.get('text', '')}",
        _broken(figures_of) + figures.first_fault(estimates, time_s, happened, large, 0.0),
        _verdicts(figures_of),
        sheet,
        _plots(record, time_s, errors, vehicle, start_ns),
        _stanford(record, errors),
        (("GNSS", spans), ("state", figures.state_spans(time_s, estimates["state"]))),
        happened,
        overlays,
        figures.target_table(record.targets, _target_spreads(figures_of), _TARGET_LIMIT_M),
        figures.stage_table(estimates),
        "time since GNSS went off, s",
        {"config": document.get("config", {}), "scenario": document.get("scenario", {})},
        dict(document.get("versions", {})),
        notes,
        KEPT_FRAMES,
    )


def _broken(report: Mapping[str, Any]) -> str:
    """Text in front of the first fault, if the flight was not flown to its end; otherwise ""."""
    return f"{report['won']}; before that: " if report.get("broken") else ""


def _empty(folder: Path, document: Mapping[str, Any]) -> Report:
    return Report(
        f"Demo flight, seed {document.get('seed')}", str(folder),
        _broken(document["report"]) + "never localized",
        settings={"config": document.get("config", {})},
        versions=dict(document.get("versions", {})),
    )  # fmt: skip


def _errors(estimates: Columns, truth: Columns) -> dict[str, np.ndarray]:
    """Each estimate's errors against the true camera pose of its exposure; NaN without one."""
    found = figures.nearest(truth["exposure_time_ns"], np.asarray(estimates["exposure_time_ns"]))
    errors = {name: np.full(len(found), np.nan) for name in ("3-D", "horizontal", "rotation")}
    true, estimated = poses(truth), poses(estimates)
    for i, k in enumerate(found):
        if k >= 0:
            errors["3-D"][i], errors["rotation"][i] = estimated[i].distance_to(true[k])
            difference = estimated[i].translation - true[k].translation
            errors["horizontal"][i] = np.hypot(*difference[:2])
    return errors


def _verdicts(report: Mapping[str, Any]) -> tuple[CriterionResult, ...]:
    return tuple(
        criterion_result(c["name"], c["value"], c["limit"], c["unit"], at_least=c["at_least"])
        for c in report["criteria"]
    )


def _plots(
    record: RecordTables,
    time_s: np.ndarray,
    errors: Mapping[str, np.ndarray],
    vehicle: Columns,
    start_ns: int,
) -> tuple[Plot, ...]:
    estimates = record.estimates
    accepted = np.asarray(estimates["accepted"]) > 0
    shown = {name: np.where(accepted, values, np.nan) for name, values in errors.items()}
    off = np.hypot(
        vehicle["ekf_east_m"] - vehicle["east_m"], vehicle["ekf_north_m"] - vehicle["north_m"]
    )
    return (
        Plot(
            "position error of vision, m", time_s,
            (Curve("3-D", shown["3-D"]), Curve("horizontal", shown["horizontal"])),
        ),
        Plot(
            "position error of the autopilot's EKF, horizontal, m",
            figures.seconds(vehicle["time_ns"], start_ns), (Curve("EKF", off),),
        ),
        Plot("rotation error, degrees", time_s, (Curve("rotation", shown["rotation"]),)),
        *uncertainty(estimates, time_s),
        figures.stage_plot(estimates, time_s, record.delay_ms),
    )  # fmt: skip


def _stanford(record: RecordTables, errors: Mapping[str, np.ndarray]) -> Stanford | None:
    levels = record.estimates.get("hpl_m")
    limit = record.alert_limit_m
    if levels is None or not np.isfinite(levels).any() or limit is None:
        return None
    return Stanford(errors["horizontal"], np.asarray(levels), limit)


def _target_spreads(report: Mapping[str, Any]) -> dict[str, np.ndarray]:
    return {
        name: np.array([s[k] if s[k] is not None else np.nan for k in ("median", "p95", "maximum")])
        for name, s in report.get("targets_m", {}).items()
    }
