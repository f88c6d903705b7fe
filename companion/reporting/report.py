"""Detects the kind of a folder and writes its report; makes that of `companion eval`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from companion.errors import RecordError, StreamDecodeError
from companion.offline.record import read_columns
from companion.reporting.content import (
    CriterionResult,
    Curve,
    MapSheet,
    MapTrack,
    Overlay,
    Plot,
    Report,
    Span,
    criterion_result,
)
from companion.reporting.demo import demo_report
from companion.reporting.layout import write_report
from companion.reporting.pictures import map_pictures, silent
from companion.reporting.record import VISION, record_report
from companion.sources.folder_source import read_image
from companion.terminal.steps import Say
from localizer.plain_files import plain_text

NAME = "report.html"
_TEXT = ("name", "state", "status", "problem")


def write_page(folder: Path, out: Path | None = None, say: Say = silent) -> Path:
    """Write the report of a record, a demo or an evaluation to `out`, or ``report.html`` in its
    folder; returns the path. say: receives the present step as text. `RecordError` as of
    `report_of`, `ReportError` if it cannot be written.
    """
    report = report_of(folder, say)
    path = out or folder / NAME
    say(f"drawing the plots and writing {path}")
    return write_report(report, path)


def report_of(folder: Path, say: Say = silent) -> Report:
    """Make the folder's report, write nothing; `RecordError` if its kind or content is wrong."""
    try:
        return _report_of(folder, say)
    # What a damaged or a foreign file raises where a report takes it apart.
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, ArithmeticError) as error:
        why = f"{type(error).__name__}: {error}"
        told = f"{folder}: its files are damaged or of another version: {why}"
        raise RecordError(told) from error


def evaluation_report(folder: Path, say: Say = silent) -> Report:
    """Make the report of `companion eval --report folder`; writes nothing. say: receives the
    present step as text. `RecordError` for another folder, or without frames.
    """
    try:
        document = json.loads(plain_text(folder / "report.json"))
        frames = read_columns(folder / "frames.csv", _TEXT)
        settings = document["settings"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise RecordError(f"{folder}: not an evaluation's folder: {error}") from error
    if not frames:
        raise RecordError(f"{folder}: frames.csv holds no frame")
    number = np.arange(len(frames["name"]), dtype=np.float64)
    accepted = np.nan_to_num(np.asarray(frames["accepted"], dtype=np.float64)) > 0
    position = np.where(accepted, frames["translation_error_m"], np.nan)
    rotation = np.where(accepted, frames["rotation_error_deg"], np.nan)
    sheet, notes = _sheet(Path(settings["map"]), frames, accepted, say)
    return Report(
        f"Evaluation of {Path(settings['sequence']).name}",
        f"{document['frames']} frames, median {_text(document['median_translation_m'], 'm')} "
        f"{_text(document['median_rotation_deg'], 'degrees')}, prior {settings['prior']}, seed "
        f"{settings['seed']}",
        _first_fault(frames, accepted, position),
        _verdicts(document),
        sheet,
        (
            Plot("position error, m", number, (Curve("3-D", position),)),
            Plot("rotation error, degrees", number, (Curve("rotation", rotation),)),
            Plot("quality", number, (Curve("quality", np.asarray(frames["quality"])),)),
        ),
        lanes=(("frames", _spans(number, accepted)),),
        overlays=_overlays(folder),
        abscissa="frame",
        settings=settings,
        versions=dict(document.get("versions", {})),
        notes=notes,
    )


def _report_of(folder: Path, say: Say) -> Report:
    if not folder.is_dir():
        there = "is a file, not a folder" if folder.exists() else "there is no such folder"
        raise RecordError(f"{folder}: {there}; give a record's, a demo's or an evaluation's")
    if (folder / "frames_report.csv").exists() and (folder / "companion").is_dir():
        return demo_report(folder, say)
    if (folder / "estimates.csv").exists():
        return record_report(folder, say)
    if (folder / "report.json").exists() and (folder / "frames.csv").exists():
        return evaluation_report(folder, say)
    raise RecordError(
        f"{folder}: neither a flight's record (estimates.csv), nor the folder of a demo or of "
        "`companion eval`"
    )


def _verdicts(document: dict[str, float]) -> tuple[CriterionResult, ...]:
    """Criteria with the same limits as for a demo flight's localizer."""
    median = document["median_translation_m"]
    return (
        criterion_result("localizer median", median, 1.0, "m", at_least=False),
        criterion_result("localizer R@3", document["recall_3"], 95.0, "%", at_least=True),
        criterion_result("completeness", document["completeness"], 99.0, "%", at_least=True),
    )


def _first_fault(frames: dict[str, np.ndarray], accepted: np.ndarray, position: np.ndarray) -> str:
    bad = np.flatnonzero(~accepted | (position > 3.0))
    if not len(bad):
        return "nothing: every frame was localized within 3 m"
    i = int(bad[0])
    problem = str(frames["problem"][i])
    why = (
        f"{position[i]:.1f} m off" if accepted[i] else problem or f"refused ({frames['status'][i]})"
    )
    return f"frame {frames['name'][i]}: {why}; {len(bad)} such frames in all"


def _spans(number: np.ndarray, accepted: np.ndarray) -> tuple[Span, ...]:
    spans: list[Span] = []
    for i, good in zip(number, accepted, strict=True):
        name = "accepted" if good else "refused"
        if spans and spans[-1].name == name:
            spans[-1] = Span(spans[-1].begin_s, float(i) + 1, name)
        else:
            spans.append(Span(float(i), float(i) + 1, name))
    return tuple(spans)


def _sheet(
    path: Path, frames: dict[str, np.ndarray], accepted: np.ndarray, say: Say
) -> tuple[MapSheet | None, list[str]]:
    with map_pictures(path, say) as pictures:
        if pictures.cache is None:
            return None, pictures.notes
        local, known = pictures.cache.frame, np.isfinite(frames["latitude_deg"]) & accepted
        rows = zip(frames["latitude_deg"], frames["longitude_deg"], frames["height_m"], strict=True)
        points = [
            local.enu_from_geodetic(*(float(x) for x in row))[:2] if k else np.full(2, np.nan)
            for row, k in zip(rows, known, strict=True)
        ]
        sheet = pictures.sheet([MapTrack("vision (camera)", VISION, 2.5, np.array(points))], ())
        return sheet, pictures.notes


def _overlays(folder: Path) -> tuple[Overlay, ...]:
    """The worst frames as `companion eval` wrote them: video and map side by side."""
    sheets = []
    for path in sorted(folder.glob("overlay-*.png")):
        try:
            rgb = read_image(path)
        except (StreamDecodeError, OSError):
            continue
        video, render = np.array_split(rgb, 2, axis=1)
        sheets.append(Overlay(video, render, f"frame {path.stem.removeprefix('overlay-')}"))
    return tuple(sheets)


def _text(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value:.2f} {unit}"
