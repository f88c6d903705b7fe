"""Report of a trial: an HTML page, figures as JSON, positions as files."""

from __future__ import annotations

import csv
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from companion.integrity_monitor.config import ProtectionConfig
from companion.reporting.content import (
    INNER,
    NOTHING,
    OUTER,
    CriterionResult,
    Curve,
    MapMark,
    MapSheet,
    MapTrack,
    Overlay,
    Plot,
    Report,
    ReportTable,
    Stanford,
)
from companion.reporting.layout import write_report
from companion.reporting.pictures import MapPictures, ShownFrame, map_pictures, silent
from companion.reporting.record import VISION
from companion.terminal.steps import Say
from companion.trial.result import Trial, TrialVerdict, main_reason, spread_limit_m
from companion.versions import made_by
from companion.writing import writing
from localizer.geometry.pose import Array

_GNSS = "#1f6fd6"
_OVERLAYS = 8
_OVERLAY_PX = 960  # of an overlay's width: the page stays small
_ALERT_M = 10.0  # the plot's alert limit: half of it is a street's width
_TILT_DEG, _FOCAL_PERCENT, _SHIFT_M = 2.0, 2.0, 3.0


def write_trial(
    folder: Path, trial: Trial, verdict: TrialVerdict, map_cache: Path, say: Say = silent
) -> Path:
    """Write ``report.html``, ``trial.json``, ``frames.csv`` to an existing folder; returns the path
    of the page. `ReportError` if that fails.
    """
    with writing(folder, "--report"):
        _write_frames(folder / "frames.csv", trial)
        text = json.dumps(_figures(trial, verdict), indent=1)
        (folder / "trial.json").write_text(text, encoding="utf-8")
    with map_pictures(map_cache, say) as pictures:
        report = _report(trial, verdict, pictures)
    return write_report(report, folder / "report.html")


def _report(trial: Trial, verdict: TrialVerdict, pictures: MapPictures) -> Report:
    errors, levels = trial.errors_m(), trial.levels_m()
    is_placed = bool(np.isfinite(errors).any())
    number = np.arange(len(trial.best), dtype=np.float64)
    is_joined = trial.flight.kind != "photos"  # between photos nothing is known
    camera = trial.flight.camera
    return Report(
        f"{trial.flight.name}: {verdict.kind}",
        f"{len(trial.best)} {trial.flight.kind if trial.flight.kind == 'photos' else 'frames'}, "
        f"camera by {camera.source}, focal length {camera.camera.fx:.0f} px of "
        f"{camera.camera.width}",
        _first_fault(trial),
        _verdicts(trial, errors),
        _sheet(trial, pictures),
        (
            *([Plot(
                "horizontal distance from GNSS, m, the map's offset taken off", number,
                (Curve("distance", errors), Curve("protection level", levels)), joined=is_joined,
            )] if is_placed else []),
            Plot("quality of the registration, 0 to 1", number,
                 (Curve("as recorded", np.array([x.quality for x in trial.first])),
                  Curve("corrected", np.array([x.quality for x in trial.second]))),
                 joined=is_joined),
        ),
        Stanford(errors, levels, _ALERT_M) if is_placed else None,
        overlays=_overlays(trial, pictures),
        tables=(("Estimated camera and map", _estimates(trial)), *_failures(trial)),
        abscissa="frame",
        settings={"notes": list(trial.notes)},
        versions=made_by(),
        notes=(*trial.notes, *pictures.notes),
        verdict=verdict.sentence,
        overlays_of="Frames that failed, then localized ones, spread over the flight",
    )  # fmt: skip


def _first_fault(trial: Trial) -> str:
    if not trial.reasons:
        return f"{NOTHING}: every frame is localized"
    k = min(trial.reasons)
    return f"{trial.best[k].name}: {trial.reasons[k]}; {len(trial.reasons)} such frames in all"


def _verdicts(trial: Trial, errors: Array) -> tuple[CriterionResult, ...]:
    count = len(trial.best)
    share = 100.0 * sum(one.accepted for one in trial.best) / count
    rows = [CriterionResult("frames localized", f"{share:.0f} %", ">= 80 %", share >= 80.0,
                    f"no position for the others{main_reason(trial)}",
                    "the overlays of failed frames")]  # fmt: skip
    known = errors[np.isfinite(errors)]
    if len(known):
        own = float(np.median([p.sigma_m for p in trial.priors if p.pose is not None]))
        limit, value = spread_limit_m(trial), float(np.median(known))
        rows.append(CriterionResult(
            "distance from GNSS, median", f"{value:.1f} m", f"<= {limit:.1f} m", value <= limit,
            "positions are wrong, or the recorded ones are", "the overlays: do edges run on?",
        ))  # fmt: skip
        levels = trial.levels_m()
        both = np.isfinite(errors) & np.isfinite(levels)
        inside = 100.0 * float((errors[both] <= levels[both] + 2.0 * own).mean())
        rows.append(CriterionResult(
            "within the protection level and GNSS's own error", f"{inside:.0f} %", ">= 95 %",
            inside >= 95.0, "vision is less sure than it says", "the Stanford plot",
        ))  # fmt: skip
    searched, right, wrong = trial.search_outcome()
    if searched:
        rows.append(CriterionResult(
            "found without a position", f"{right} of {searched}, {wrong} at a wrong place",
            "none at a wrong place", wrong == 0, "two places look alike",
            "restrict the search by a region",
        ))  # fmt: skip
    return tuple(rows)


def _sheet(trial: Trial, pictures: MapPictures) -> MapSheet | None:
    sheet = pictures.sheet(_tracks(trial), _marks(trial))
    key = "circles: vision's positions with their protection levels; crosses: frames that failed"
    return None if sheet is None else replace(sheet, key=key)


def _marks(trial: Trial) -> list[MapMark]:
    """Accepted positions with protection levels, and recorded positions of failed frames."""
    levels = trial.levels_m()
    marks = []
    for k, (one, prior) in enumerate(zip(trial.best, trial.priors, strict=True)):
        if one.accepted and one.pose is not None:
            east, north = map(float, one.pose.translation[:2])
            marks.append(MapMark("", east, north, "target", float(levels[k])))
        elif prior.pose is not None:
            east, north = map(float, prior.pose.translation[:2])
            marks.append(MapMark(one.name, east, north))
    return marks


def _tracks(trial: Trial) -> list[MapTrack]:
    nowhere = np.full(2, np.nan)
    gnss = [nowhere if p.pose is None else p.pose.translation[:2] for p in trial.priors]
    vision = [
        one.pose.translation[:2] if one.accepted and one.pose is not None else nowhere
        for one in trial.best
    ]
    if trial.flight.kind == "photos":  # between them nobody knows the way
        pairs = [row for pair in zip(gnss, vision, strict=True) for row in (*pair, nowhere)]
        return [MapTrack("from GNSS, with the estimated offset, to vision", _GNSS, INNER,
                         np.array(pairs))]  # fmt: skip
    return [
        MapTrack("GNSS, with the estimated offset", _GNSS, OUTER, np.array(gnss)),
        MapTrack("vision", VISION, INNER, np.array(vision)),
    ]


def _estimates(trial: Trial) -> ReportTable:
    found = trial.estimated
    if found is None:
        return ReportTable(("quantity", "value"), (("too few frames agree to estimate", "-"),))
    up, right = found.mount_deg[1], found.mount_deg[2]
    is_assumed = sum(p.measured for p in trial.priors) <= len(trial.priors) / 2
    against = "than straight down, which was assumed" if is_assumed else "than recorded"
    rows = [
        (f"camera looks further up (ahead) {against}", f"{up:+.1f}",
         f"{found.mount_sigma_deg[1]:.1f}", "deg"),
        ("camera looks further right", f"{right:+.1f}", f"{found.mount_sigma_deg[2]:.1f}", "deg"),
        ("camera is turned about its axis", f"{found.mount_deg[0]:+.1f}",
         f"{found.mount_sigma_deg[0]:.1f}", "deg"),
    ]  # fmt: skip
    if found.focal_percent is None:
        rows.append(
            ("focal length", "not observable", f"{trial.flight.camera.focal_percent:.0f}", "%")
        )
    else:
        rows.append(("focal length", f"{found.focal_percent:+.2f}",
                     f"{found.focal_sigma_percent:.2f}", "%"))  # fmt: skip
    if found.has_shift:
        names = ("map east of GNSS", "map north of GNSS", "map above recorded heights")
        rows += [
            (name, f"{value:+.1f}", f"{sigma:.1f}", "m")
            for name, value, sigma in zip(names, found.shift_m, found.shift_sigma_m, strict=True)
            if np.isfinite(sigma)
        ]
    limits = (_TILT_DEG, _TILT_DEG, 3 * _TILT_DEG, _FOCAL_PERCENT, _SHIFT_M, _SHIFT_M, _SHIFT_M)
    bad = frozenset(
        i for i, (row, limit) in enumerate(zip(rows, limits, strict=False))
        if row[1] != "not observable" and abs(float(row[1])) > limit
    )  # fmt: skip
    note = f"By {found.frame_count} frames, against what was recorded or given."
    if found.focal_percent is None:
        note += " Over this map focal length and height cannot be separated; the given one is kept."
    elif abs(found.focal_percent) < 3.0 * found.focal_sigma_percent:
        note += " The focal length is kept as given: it differs by less than three sigmas."
    if bad:
        note += (
            f" Red: by more than {_TILT_DEG:.0f} deg ({3 * _TILT_DEG:.0f} about the axis), "
            f"{_FOCAL_PERCENT:.0f} % or {_SHIFT_M:.0f} m. deployment.yaml holds the "
            "angles that were found."
        )
    return ReportTable(("quantity", "differs by", "1 sigma", "unit"), tuple(rows), bad, note)


def _failures(trial: Trial) -> tuple[tuple[str, ReportTable], ...]:
    if not trial.reasons:
        return ()
    rows = tuple((trial.best[k].name, text) for k, text in sorted(trial.reasons.items()))
    return (("Frames that failed", ReportTable(("frame", "likely reason"), rows)),)


def _overlays(trial: Trial, pictures: MapPictures) -> tuple[Overlay, ...]:
    """Map overlays: up to half of failed frames, the others of accepted ones over the flight."""
    best = trial.best
    failed = [k for k in sorted(trial.reasons) if best[k].pose is not None][: _OVERLAYS // 2]
    good = [k for k, one in enumerate(best) if one.accepted]
    few = min(len(good), _OVERLAYS - len(failed))
    spread = [good[int(i)] for i in np.linspace(0, len(good) - 1, few).round()] if few else []
    camera = trial.estimated.camera if trial.estimated else trial.flight.camera.camera
    small = min(1.0, _OVERLAY_PX / camera.width)
    size = camera.resized(round(camera.width * small), round(camera.height * small))
    errors = trial.errors_m()
    shown = []
    for k in (*failed, *spread):
        pose = best[k].pose
        if pose is None:
            continue
        why = trial.reasons.get(k, "")
        off = f", {errors[k]:.1f} m from GNSS" if np.isfinite(errors[k]) else ""
        caption = f"{best[k].name}: {'not accepted: ' + why if why else 'localized' + off}"
        shown.append(ShownFrame(trial.flight.frames[k].path, pose, caption))
    return pictures.overlays(shown, camera, size)


def _write_frames(path: Path, trial: Trial) -> None:
    errors, levels = trial.errors_m(), trial.levels_m()
    columns = ("name", "accepted", "without_position", "quality", "from_gnss_m", "level_m",
               "reason")  # fmt: skip
    results = trial.search_results()
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        for k, one in enumerate(trial.best):
            figures = (f"{x:.2f}" if np.isfinite(x) else "" for x in (errors[k], levels[k]))
            row = (one.name, int(one.accepted), results.get(k, ""), f"{one.quality:.3f}", *figures)
            writer.writerow([*row, trial.reasons.get(k, "")])


def _figures(trial: Trial, verdict: TrialVerdict) -> dict[str, Any]:
    found = trial.estimated
    estimated: dict[str, Any] | None = None
    if found is not None:
        estimated = {
            "frames": found.frame_count, "camera": found.camera.to_dict(),
            "focal_percent": found.focal_percent,
            "focal_sigma_percent": found.focal_sigma_percent,
            "mount_deg": found.mount_deg.tolist(),
            "mount_sigma_deg": found.mount_sigma_deg.tolist(),
            "shift_m": found.shift_m.tolist() if found.has_shift else None,
        }  # fmt: skip
    searched, right, wrong = trial.search_outcome()
    return {
        "verdict": asdict(verdict), "frames": len(trial.best), "accepted": trial.accepted_count,
        "searched": searched, "found": right, "found_elsewhere": wrong, "estimated": estimated,
        "notes": list(trial.notes), "risk": ProtectionConfig().risk,
    }  # fmt: skip
