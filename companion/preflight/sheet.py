"""The doctor's one-page preflight sheet for the pilot's signature."""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import date, datetime, timezone
from html import escape
from pathlib import Path
from typing import Any

from companion.config import CompanionConfig
from companion.errors import ReportError
from companion.preflight.map_pin import readable_map_hash
from companion.versions import versions
from companion.writing import write_result
from localizer.errors import LocalizerError
from localizer.geometry.geo import geo_box
from localizer.map.cache.cache import TileCache
from localizer.map.inspection.kind import map_kind
from mavlink_bridge.preflight.doctor import Diagnosis
from mavlink_bridge.preflight.rules import DoctorFinding

_OLD_SHADOW_DAYS = 7
WHEN_VISION_ENDS = (
    ("degraded, bridging N s", "odometry continues: turn back over mapped ground"),
    ("lost; not sent: ...", "take over in ALT_HOLD or STABILIZE, or select GNSS if it is good"),
    ("5 to 8 s later", "ArduPilot lands (EKF Failsafe) unless somebody has taken over"),
    ("output held: ...", "no position is sent: take over, or select GNSS if it is good"),
    ("cleared: EKF jump", "select the mode again: ArduPilot stays in LAND"),
)


@dataclass(frozen=True)
class SheetRow:
    """One line of the sheet. good: None for information only."""

    name: str
    text: str
    good: bool | None = None


@dataclass(frozen=True)
class PreflightSheet:
    """The preflight sheet. fit: the doctor's result; findings: its failed checks."""

    deployment: str
    day: datetime
    fit: bool
    rows: tuple[SheetRow, ...]
    findings: tuple[DoctorFinding, ...]


def make_sheet(
    path: Path, config: CompanionConfig, diagnosis: Diagnosis, plan: Path | None, now: datetime
) -> PreflightSheet:
    """Collect the sheet's contents. path: of the deployment file `config`; plan: ``plan.json`` of
    `companion plan`, None: no forecast, which counts as not good. `ReportError` for another file.
    """
    rows = (
        _parameters(diagnosis),
        _calibration(config, now.date()),
        *_map(config, now.date()),
        _shadow(config, now),
        _forecast(plan, config.map),
        SheetRow("mode", f"{config.bridge.mode}, {config.bridge.injection.message}"),
        SheetRow("software", str(versions().get("pilot-companion", "not installed"))),
    )
    return PreflightSheet(str(path), now, diagnosis.ok, rows, diagnosis.findings)


def _parameters(diagnosis: Diagnosis) -> SheetRow:
    if not diagnosis.findings:
        return SheetRow("parameters and parts", "nothing was examined", False)
    wrong = [f.name for f in diagnosis.findings if not f.ok and f.required]
    advice = [f.name for f in diagnosis.findings if not f.ok and not f.required]
    good = len(diagnosis.findings) - len(wrong) - len(advice)
    parts = [f"{good} of {len(diagnosis.findings)} checks good"]
    parts += [f"wrong: {', '.join(wrong)}"] if wrong else []
    parts += [f"advice: {', '.join(advice)}"] if advice else []
    return SheetRow("parameters and parts", "; ".join(parts), not wrong)


def _age(day: date, today: date) -> str:
    days = (today - day).days
    return "today" if days == 0 else f"{days} days ago"


def _calibration(config: CompanionConfig, today: date) -> SheetRow:
    done = config.camera.calibrated
    if done is None:
        return SheetRow("calibration", "never by `companion calibrate`, or not stated", False)
    c = config.localizer.calibration
    text = f"{done.isoformat()} ({_age(done, today)}), focal length to {c.focal_percent:g} %, "
    text += f"stamps to {c.stamp_ms:g} ms"
    return SheetRow("calibration", text, config.camera.is_calibrated(today))


def _map(config: CompanionConfig, today: date) -> tuple[SheetRow, ...]:
    try:
        cache = TileCache.open(config.map)
        m, kind = cache.manifest, map_kind(cache)
    except LocalizerError as error:
        return (SheetRow("map", str(error), False),)
    box = geo_box(m.extent)
    pinned = "pinned by sha256" if config.map_sha256 else "not pinned: any map is flown"
    where = (
        f"{box.south:.5f} to {box.north:.5f}, {box.west:.5f} to "
        f"{box.east:.5f}; {m.gsd_m:.2f} m a texel; {pinned}"
    )
    text, recent = kind.imagery_age(today, config.map_max_age_days)
    dated = SheetRow("map's imagery", text, recent)
    half_view_deg = config.camera.model.camera().horizontal_fov_deg / 2
    advice = kind.advice(half_view_deg)
    text = f"{kind.line()}; {advice}" if advice else kind.line()
    return SheetRow("map covers", where), SheetRow("map's kind", text, not advice), dated


def _shadow(config: CompanionConfig, now: datetime) -> SheetRow:
    """Row with the shadow score of the newest record beside the record's folder."""
    folder = config.record.folder if config.record is not None else None
    if folder is None:
        return SheetRow("shadow score", "no record is kept, so none is known", False)
    kept = sorted(
        folder.parent.glob(f"{folder.name}*/health.json"), key=lambda p: p.stat().st_mtime
    )
    for path in reversed(kept):
        shadow = _read(path).get("shadow")
        if isinstance(shadow, dict):  # 0.1 wrote a line; a score that old does not count
            when = datetime.fromtimestamp(path.stat().st_mtime, timezone.utc)
            text = f"{shadow.get('text')} ({path.parent.name}, {_age(when.date(), now.date())})"
            recent = (now - when).days <= _OLD_SHADOW_DAYS
            flown = _read(path.with_name("record.json")).get("config")
            other = isinstance(flown, dict) and flown.get("map") != str(config.map)
            text += ", over another map" if other else ""
            return SheetRow(
                "shadow score", text, shadow.get("ready") is True and recent and not other
            )
    return SheetRow("shadow score", "none: fly in shadow mode first", False)


def _forecast(plan: Path | None, flown: Path) -> SheetRow:
    """Row of the forecast, which must be for the map `flown`, the deployment's."""
    if plan is None:
        return SheetRow(
            "forecast", "none: `companion plan MISSION`, then --plan plan/plan.json", False
        )
    data = _read(plan)
    legs = data.get("legs")
    if not isinstance(legs, list) or not isinstance(data.get("holds"), bool):
        raise ReportError(f"--plan {plan}: not a plan.json of `companion plan`")
    bad = [str(leg.get("name")) for leg in legs if not leg.get("holds")]
    conditions = ", ".join(map(str, data.get("conditions", ())))
    mission = Path(str(data.get("mission", "a mission without a name"))).name
    if data.get("map_sha256") != (readable_map_hash(flown) or "no map"):
        return SheetRow("forecast", f"{mission}: made over another map than {flown}", False)
    if data["holds"] and not bad:
        text = f"{mission}: vision should work on all {len(legs)} legs ({conditions})"
        return SheetRow("forecast", text, True)
    text = (
        f"{mission}: vision fails on {len(bad)} of {len(legs)} legs ({conditions}): "
        f"{', '.join(bad)}"
    )
    return SheetRow("forecast", text, False)


def _read(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return data if isinstance(data, dict) else {}


def write_sheet(sheet: PreflightSheet, path: Path) -> tuple[Path, Path]:
    """Write the sheet as HTML, with a text file of the same name (.txt) beside it; returns both
    paths. `ReportError` if that fails.
    """
    text_path = path.with_suffix(".txt")
    write_result(path, as_html(sheet), "--page")
    write_result(text_path, as_text(sheet), "--page")
    return path, text_path


def _mark(good: bool | None) -> str:
    return {True: "ok", False: "LOOK", None: ""}[good]


def _title(sheet: PreflightSheet) -> str:
    return "fit to fly" if sheet.fit else "NOT fit to fly"


def _marked(finding: DoctorFinding) -> str:
    return "ok" if finding.ok else "WRONG" if finding.required else "advice"


def as_text(sheet: PreflightSheet) -> str:
    """The sheet as text of 78 columns; long findings may exceed them."""
    lines = [
        f"BEFORE THE FLIGHT: {_title(sheet)}",
        f"{sheet.deployment}   {sheet.day.isoformat(timespec='minutes')}", "",
        *(f"[{_mark(r.good):4}] {r.name}: {r.text}" for r in sheet.rows), "",
        "IF VISION ENDS",
        *(f"  {says:30} {do}" for says, do in WHEN_VISION_ENDS), "",
        "FOUND",
        *(f"  {_marked(f):6} {f.name}: {f.found} (needed: {f.needed})" for f in sheet.findings),
        "", "Pilot ______________________  Place ______________  Time (UTC) __________", "",
    ]  # fmt: skip
    return "\n".join(lines)


_CSS = """
@page{size:A4;margin:10mm}*{box-sizing:border-box}
body{font:12.5px/1.35 system-ui,sans-serif;max-width:190mm;margin:6mm auto;padding:0 4mm;
color:#1c2430}
h1{font-size:19px;margin:0;padding:.35em .6em;border-left:7px solid #2a9d4a;background:#e8f5ec}
h1.no{border-color:#c62828;background:#fbe4e4}h2{font-size:14px;margin:1em 0 .2em}
p{margin:.3em 0;color:#5b6470}table{border-collapse:collapse;width:100%}
td{border-bottom:1px solid #d7dce2;padding:.22em .5em;vertical-align:top;overflow-wrap:anywhere}
td:first-child{width:4.6em;font-weight:700;white-space:nowrap}td:nth-child(2){width:12em}
.ends td:first-child{width:17em}.ends td:nth-child(2){width:auto}
.ok{color:#1d7a38}.LOOK,.WRONG{color:#b71c1c}.advice{color:#9a6a00}
.found{columns:2;column-gap:6mm;font-size:11px}.found div{break-inside:avoid;
overflow-wrap:anywhere;padding:.1em 0}
.sign{display:flex;gap:8mm;margin-top:12mm}.sign span{flex:1;border-top:1px solid #1c2430;
padding-top:.2em}.sign span:first-child{flex:2}
"""


def as_html(sheet: PreflightSheet) -> str:
    """The sheet as one self-contained HTML page."""

    def row(mark: str, *cells: str) -> str:
        tail = "".join(f"<td>{escape(c)}</td>" for c in cells)
        return f'<tr><td class="{mark}">{mark}</td>{tail}</tr>'

    facts = "".join(row(_mark(r.good), r.name, r.text) for r in sheet.rows)
    ends = "".join(f"<tr><td>{escape(a)}</td><td>{escape(b)}</td></tr>"
                   for a, b in WHEN_VISION_ENDS)  # fmt: skip
    found = "".join(map(_found, sorted(sheet.findings, key=lambda f: (f.ok, not f.required))))
    title = f"Before the flight: {_title(sheet)}"
    style = "" if sheet.fit else ' class="no"'
    when = f"{escape(sheet.deployment)} · {sheet.day.strftime('%Y-%m-%d %H:%M UTC')}"
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{_CSS}</style>'
        f"<h1{style}>{title}</h1><p>{when}</p><table>{facts}</table>"
        f'<h2>If vision ends</h2><table class="ends">{ends}</table>'
        f'<h2>What the doctor found</h2><div class="found">{found}</div>'
        '<div class="sign"><span>Pilot (name, signature)</span><span>Place</span>'
        "<span>Time, UTC</span></div></html>\n"
    )


def _found(finding: DoctorFinding) -> str:
    mark = _marked(finding)
    needed = "" if finding.ok else f" (needed: {escape(finding.needed)})"
    words = f"{escape(finding.name)}: {escape(finding.found)}{needed}"
    return f'<div><b class="{mark}">{mark}</b> {words}</div>'
