"""Writes a report as one self-contained HTML file."""

from __future__ import annotations

import base64
import json
import math
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from companion.errors import ReportError
from companion.reporting.content import (
    NOTHING,
    RIM,
    MapSheet,
    MapTrack,
    Plot,
    Report,
    ReportTable,
    Stanford,
)
from companion.writing import write_result
from localizer.types import Image


def vendored(name: str) -> str:
    """The text of a file of companion/console/static/vendor."""
    folder = resources.files("companion") / "console" / "static" / "vendor"
    return (folder / name).read_text(encoding="utf-8")


def licence_of(package: str) -> str:
    """The licence in the package's files."""
    return vendored(f"LICENSE.{package}.txt")


_JPEG_QUALITY = 82
_MOST_POINTS = 3000  # of a curve or track: beyond it nobody sees them
_LETTER = 0.65  # of a sans serif's size, the widest mean of a name's letters
_COLOURS = {
    "tracking": "#2a9d4a", "initializing": "#8a8f98", "degraded": "#e0a100",
    "bridging": "#d97706", "lost": "#c62828", "refused": "#c62828", "accepted": "#2a9d4a",
    "GNSS denied": "#5b6b8c",
}  # fmt: skip


def write_report(report: Report, path: Path) -> Path:
    """Write the page into an existing folder and return `path`; `ReportError` if that fails."""
    write_result(path, render(report))
    return path


def render(report: Report) -> str:
    """The HTML text of a report."""
    page = resources.files("companion.reporting") / "page"
    body = "\n".join(part for part in _sections(report) if part)
    data = {"plots": [_plot_data(p) for p in report.plots], "abscissa": report.abscissa}
    text = (
        (page / "report.html").read_text(encoding="utf-8")
        .replace("{{title}}", escape(report.title))
        .replace("{{css}}", vendored("uPlot.min.css") + (page / "report.css").read_text("utf-8"))
        .replace("{{licence}}", escape(licence_of("uplot")))
        .replace("{{body}}", body)
        .replace("{{data}}", _embedded(data))
        .replace("{{js}}", vendored("uPlot.iife.min.js") + (page / "report.js").read_text("utf-8"))
    )  # fmt: skip
    # Names of files and texts of JSON may hold half a character (a lone surrogate).
    return text.encode("utf-8", "replace").decode("utf-8")


def _embedded(data: Any) -> str:
    """JSON for a script element, escaped so that it cannot end the element."""
    return json.dumps(data, allow_nan=False).replace("<", "\\u003c")


def _sections(report: Report) -> list[str]:
    fine = " fine" if report.first.startswith(NOTHING) else ""
    return [
        f"<h1>{escape(report.title)}</h1><p class=sub>{escape(report.subtitle)}</p>",
        f"<p class=verdict>{escape(report.verdict)}</p>" if report.verdict else "",
        f'<p class="first{fine}"><b>What went wrong first:</b> {escape(report.first)}</p>'
        if report.first
        else "",
        "".join(f"<p class=note>{escape(note)}</p>" for note in report.notes),
        _verdicts(report),
        *(_section(title, _table(table)) for title, table in report.tables),
        *(_section(title, _picture(title, rgb)) for title, rgb in report.pictures),
        _section("Map", _map(report.sheet)) if report.sheet else "",
        _section("Timeline", _timeline(report)) if report.lanes or report.events else "",
        _section("Errors and figures", _plots(report)) if report.plots else "",
        _section("Protection levels", _stanford(report.stanford)) if report.stanford else "",
        _section("Frames and map", _overlays(report)) if report.overlays else "",
        _section("Targets", _table(report.targets)) if report.targets else "",
        _section("Latency by stage, ms", _table(report.stages)) if report.stages else "",
        _section("Settings and versions", _settings(report)),
    ]


def _section(title: str, body: str) -> str:
    name = title.split(",", maxsplit=1)[0].lower().replace(" ", "-")
    return f'<section id="{name}"><h2>{escape(title)}</h2>{body}</section>'


def _picture(title: str, rgb: Image) -> str:
    return f'<img class=picture alt="{escape(title)}" src="{data_uri(rgb)}">'


def _verdicts(report: Report) -> str:
    if not report.verdicts:
        return ""
    rows = []
    for v in report.verdicts:
        why = "" if v.ok else f"<br><small>{escape(v.meaning)}. Look at: {escape(v.look)}.</small>"
        mark = "ok" if v.ok else "missed"
        rows.append(
            f"<tr class={mark}><td>{escape(v.name)}{why}</td>{_cell(v.value)}"
            f"{_cell(v.needed)}<td class=mark>{mark}</td></tr>"
        )
    missed = sum(not v.ok for v in report.verdicts)
    head = "all criteria held" if not missed else f"{missed} of {len(rows)} criteria missed"
    return _section(
        f"Verdict: {head}",
        "<table><tr><th>criterion<th>found<th>needed<th></tr>" + "".join(rows) + "</table>",
    )


def _map(sheet: MapSheet) -> str:
    """SVG in metres, north up, over the top view."""
    width, height = sheet.east - sheet.west, sheet.north - sheet.south
    size = max(width, height)

    def xy(east: float, north: float) -> str:
        return f"{east - sheet.west:.2f},{sheet.north - north:.2f}"

    parts = []
    if sheet.rgb is not None:
        image = data_uri(sheet.rgb)
        parts.append(f'<image href="{image}" width="{width:.2f}" height="{height:.2f}"/>')
    else:
        parts.append(f'<rect width="{width:.2f}" height="{height:.2f}" fill="#9aa3ad"/>')
    for track in sheet.tracks:
        runs = [[xy(*p) for p in run] for run in _runs(track.points)]
        parts += [_polyline(track, run) for run in runs]
    for mark in sheet.marks:
        x, y = mark.east_m - sheet.west, sheet.north - mark.north_m
        arm = size / 90
        parts.append(
            f'<g class="mark {escape(mark.kind)}">'
            f'<circle cx="{x:.2f}" cy="{y:.2f}" r="{max(mark.sigma_m, size / 180):.2f}"/>'
            f'<path d="M{x - arm:.2f} {y:.2f}h{2 * arm:.2f}M{x:.2f} {y - arm:.2f}v{2 * arm:.2f}"/>'
            f"{_label(mark.name, (x, y), arm, width)}</g>"
        )
    tens = 10 ** math.floor(math.log10(max(size / 4, 1e-9)))
    bar = max(step * tens for step in (1, 2, 5) if step * tens <= max(size / 4, tens))
    legend = "".join(
        f'<span><i style="background:{t.colour}"></i>{escape(t.name)}</span>' for t in sheet.tracks
    )
    return (
        f"<div class=legend>{legend}<span>{escape(sheet.key)}</span>"
        f"<span>scale {bar:g} m</span></div>"
        f'<svg class=map viewBox="0 0 {width:.2f} {height:.2f}" role=img '
        f'aria-label="map with tracks">{"".join(parts)}'
        f'<path class=scale d="M{size * 0.03:.2f} {height - size * 0.03:.2f}h{bar:g}"/></svg>'
    )


def _label(name: str, at: tuple[float, float], arm: float, width: float) -> str:
    """SVG of a mark's name, on the side where the map has room for it."""
    font = 2.0 * arm
    x, y = at
    ends = x + arm + _LETTER * font * len(name) > width
    height = y + arm + font if y - arm < font else y - arm
    left, anchor = (x - arm, "end") if ends else (x + arm, "start")
    return (
        f'<text x="{left:.2f}" y="{height:.2f}" font-size="{font:.2f}" text-anchor="{anchor}">'
        f"{escape(name)}</text>"
    )


def _polyline(track: MapTrack, points: list[str]) -> str:
    """SVG of a track with a dark rim, which is visible on any ground."""
    line = " ".join(points)
    return (
        f'<polyline points="{line}" class=rim stroke-width="{track.width + RIM}"/>'
        f'<polyline points="{line}" stroke="{track.colour}" stroke-width="{track.width}"/>'
    )


def _timeline(report: Report) -> str:
    spans = [s for _, lane in report.lanes for s in lane]
    times = [t for s in spans for t in (s.begin_s, s.end_s)] + [e.time_s for e in report.events]
    begin, end = min(times, default=0.0), max(times, default=1.0)
    length = max(end - begin, 1e-6)
    lanes = []
    for name, lane in report.lanes:
        blocks = "".join(
            f'<i style="left:{100 * (s.begin_s - begin) / length:.3f}%;'
            f"width:{100 * (s.end_s - s.begin_s) / length:.3f}%;"
            f'background:{_COLOURS.get(s.name, "#5b6b8c")}" '
            f'title="{escape(s.name)} {s.begin_s:.1f} to {s.end_s:.1f}"></i>'
            for s in lane
        )
        names = ", ".join(dict.fromkeys(s.name for s in lane))
        lanes.append(f"<div class=lane><b>{escape(name)}</b><div>{blocks}</div>"
                     f"<small>{escape(names)}</small></div>")  # fmt: skip
    rows = "".join(
        f"<tr class={escape(e.level)}><td>{e.time_s:.1f}<td>{escape(e.level)}<td>{escape(e.text)}"
        for e in report.events
    )
    events = f"<div class=scroll><table><tr><th>s<th>level<th>event{rows}</table></div>"
    return "".join(lanes) + (events if rows else "")


def _plots(report: Report) -> str:
    return "".join(
        f"<h3>{escape(p.title)}</h3><div class=plot data-plot={i}></div>"
        for i, p in enumerate(report.plots)
    )


def _plot_data(plot: Plot) -> dict[str, Any]:
    keep = _kept(len(plot.x))
    return {
        "title": plot.title,
        "limit": plot.limit,
        "joined": plot.joined,
        "x": [round(float(v), 4) for v in plot.x[keep]],
        "curves": [
            {"label": c.label, "values": [_number(v) for v in c.values[keep]]} for c in plot.curves
        ],
    }


def _number(value: float) -> float | None:
    return float(f"{value:.5g}") if math.isfinite(value) else None


def _kept(count: int) -> np.ndarray:
    chosen = np.linspace(0, max(count - 1, 0), min(count, _MOST_POINTS)).astype(int)
    return np.asarray(np.unique(chosen))


def _runs(points: np.ndarray) -> list[np.ndarray]:
    """Split points at unknown (NaN) ones, so that gaps are not drawn."""
    known = np.isfinite(points).all(axis=1)
    runs = np.split(np.arange(len(points)), np.flatnonzero(np.diff(known)) + 1)
    step = -(-len(points) // _MOST_POINTS)
    return [points[[*run[:-1:step], run[-1]]] for run in runs if len(run) and known[run[0]]]


def _stanford(data: Stanford) -> str:
    """SVG: error (abscissa), protection level (ordinate), both to twice the alert limit."""
    side, top = 420.0, 2.0 * data.alert_limit_m
    scale = side / top
    dots = "".join(
        f'<circle cx="{min(e, top) * scale:.1f}" cy="{side - min(level, top) * scale:.1f}" r=2 />'
        for e, level in zip(
            data.error_m[_kept(len(data.error_m))],
            data.level_m[_kept(len(data.level_m))],
            strict=True,
        )
        if math.isfinite(e) and math.isfinite(level)
    )
    known = np.isfinite(data.error_m) & np.isfinite(data.level_m)
    error, level = data.error_m[known], data.level_m[known]
    usable = level <= data.alert_limit_m
    misleading = int((usable & (error > level)).sum())
    dangerous = int((usable & (error > data.alert_limit_m)).sum())
    limit = data.alert_limit_m * scale
    return (
        f"<p>{len(error)} fixes: {int(usable.sum())} within the alert limit of "
        f"{data.alert_limit_m:g} m; {misleading} of them are further off than their level "
        f"(misleading), {dangerous} beyond the limit (hazardous). A misleading "
        "fix is worse than the program states; a hazardous one is also too far off to fly on.</p>"
        f'<svg class=stanford viewBox="-50 -10 {side + 70:.0f} {side + 55:.0f}" role=img '
        'aria-label="Stanford diagram">'
        f'<rect class=bad x=0 y="{side - limit:.1f}" width="{side}" height="{limit:.1f}"/>'
        f'<path class=good d="M0 {side}L{limit:.1f} {side - limit:.1f}H0Z"/>'
        f'<path class=axis d="M0 0V{side}H{side}M0 {side}L{side} 0M0 {side - limit:.1f}H{side}"/>'
        f"{dots}{_ticks(side, top)}"
        f"<text x={side / 2:.0f} y={side + 35:.0f}>error, m (to {top:g})</text>"
        f'<text transform="rotate(-90)" x={-side / 2:.0f} y=-32>protection level, m</text></svg>'
    )


def _ticks(side: float, top: float) -> str:
    """SVG numbers along both axes of the diagram, at every quarter."""
    texts = []
    for k in range(5):
        value, at = f"{top * k / 4:g}", side * k / 4
        texts.append(f'<text x="{at:.0f}" y="{side + 16:.0f}">{value}</text>')
        texts.append(f'<text x=-14 y="{side - at + 5:.0f}">{value}</text>')
    return "".join(texts)


def _overlays(report: Report) -> str:
    sheets = []
    for i, o in enumerate(report.overlays):
        sheets.append(
            f'<figure class=overlay data-hidden="{int(i > 0)}"><div class=pair>'
            f'<img src="{data_uri(o.video)}" alt="video">'
            f'<img class=top src="{data_uri(o.render)}" alt="map at the estimated pose"></div>'
            f"<figcaption>{escape(o.caption)}</figcaption></figure>"
        )
    return (
        f"<p class=sub>{escape(report.overlays_of)}. The second slider uncovers the map as the "
        "estimated pose sees it: if the pose is right, edges run on.</p>"
        "<div class=controls><label>frame <input type=range id=which min=0 "
        f"max={len(sheets) - 1} value=0></label> <label>map <input type=range id=share "
        "min=0 max=100 value=50> video</label></div>" + "".join(sheets)
    )


def _cell(text: str) -> str:
    """Table cell in which a number and its unit stay on one line."""
    number = len(text) < 24 and any(character.isdigit() for character in text)
    return f"<td{' class=n' if number else ''}>{escape(text)}</td>"


def _table(table: ReportTable) -> str:
    head = "".join(f"<th>{escape(h)}" for h in table.headings)
    rows = "".join(
        f"<tr{' class=missed' if i in table.bad else ''}>" + "".join(_cell(cell) for cell in row)
        for i, row in enumerate(table.rows)
    )
    note = f"<p class=sub>{escape(table.note)}</p>" if table.note else ""
    return f"{note}<div class=scroll><table><tr>{head}{rows}</table></div>"


def _settings(report: Report) -> str:
    rows = "".join(
        f"<tr><td>{escape(k)}<td>{escape(str(v))}" for k, v in {**report.versions}.items()
    )
    settings = escape(json.dumps(report.settings, indent=1, default=str))
    return (
        f"<table>{rows}</table><details><summary>settings</summary><pre>{settings}</pre></details>"
    )


def data_uri(rgb: Image) -> str:
    """An RGB image as a data URI (JPEG). `ReportError` if it cannot be encoded."""
    done, jpeg = cv2.imencode(
        ".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    )
    if not done:
        raise ReportError("an image of the report cannot be encoded")
    return "data:image/jpeg;base64," + base64.b64encode(jpeg.tobytes()).decode("ascii")
