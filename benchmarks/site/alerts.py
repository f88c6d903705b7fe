"""The reference page of all alerts, made from the catalogue."""

from __future__ import annotations

import re

from mavlink_bridge.alerts.alert import PREFIX, AlertSpec, Inhibits, OutputAction
from mavlink_bridge.alerts.companion import CONSOLE, HEALTH, TARGETS
from mavlink_bridge.alerts.injection import INJECTION
from mavlink_bridge.alerts.integrity import INTEGRITY, MONITOR, SOURCES
from mavlink_bridge.alerts.vehicle import VEHICLE
from mavlink_bridge.alerts.words import MapOffsetUse

_HEAD = f"""---
hide: [toc]
---

# Alerts

Made from the catalogue by `python -m benchmarks.site`; do not edit.

An alert is sent as STATUSTEXT `{PREFIX}TEXT` and written to `events.csv` and `health.json` with its
identifier. *Fix*: a position from vision; it is sent in mode inject, and in mode rc while injection
is enabled. *Sent* refers to these modes. *Output held*: no position is sent. *Exclude and
reset*: as *output held*, and the next fix increments `reset_counter`. *Inhibit*: injection and the
switch to vision do not start; injection that is running continues. If the program crashes before
injection has started, and restarts within 10 min, an alert that inhibits stays active. The pilot
(mode rc) and `bridge.injection.force` override *inhibit* and *not ready*. *Event*: it has no end.
PX4 sends ESTIMATOR_STATUS in place of EKF_STATUS_REPORT.

A *not sent* alert is raised in the modes shadow, inject and rc. A *not ready* alert is a result of
the shadow check, which compares fixes with the EKF's position on GNSS over two minutes. It becomes
a STATUSTEXT in mode inject only, if fixes come but injection has not started for 10 s. It ends
after 50 or more compared fixes; without GNSS a failed check stays failed. *Valid pass*: the check
passed at most 10 min ago, and at most 30 s before the last comparison of a fix with GNSS.

Of the six alerts `fix_rate_low` to `ekf_rejects_fixes` only one is active: the first in the table
whose condition holds.

Alerts of localization are assessed once a second; the same one is sent at most every 10 s. An alert
whose row does not mention fixes or positions has no effect on them.

*Fixes are sent* means that this alert does not stop them; another alert can.

The end of an alert of the integrity monitor is sent as `cleared: NAME`, that of some others as the
text in brackets. The end of the rest shows by the next status, for example `localization tracking`.
"""
_TABLE = """
## {}

| identifier | text | severity, action | raised when | ends when | meaning | what to do |
|---|---|---|---|---|---|---|
"""
_GROUPS = {
    "Checks of the positions (integrity monitor)": (*INTEGRITY, *MONITOR, *SOURCES),
    "Output of positions to the autopilot": INJECTION,
    "Flight controller and MAVLink": VEHICLE,
    "Localization, video and the program": HEALTH,
    "Targets": TARGETS,
    "Commands from the console": CONSOLE,
}
_ACTIONS = {
    OutputAction.NONE: "",
    OutputAction.HOLD: "hold",
    OutputAction.EXCLUDE_AND_RESET: "exclude and reset",
}


def alerts_page() -> str:
    """The page, Markdown."""
    return _HEAD + "".join(
        _TABLE.format(title) + "".join(map(_row, specs)) for title, specs in _GROUPS.items()
    )


def _row(spec: AlertSpec) -> str:
    shown = re.sub(r"\{\w+[^}]*\}", lambda m: _value(m.group(), spec), spec.template)
    ended = spec.cleared or "event"
    if spec.reports_end and spec.cleared_text is not None:
        ended += f" (`{spec.cleared_text}`)"
    inhibits = ["inhibit"] if Inhibits.INJECTION in spec.inhibits else []
    action = ", ".join(
        [spec.severity.name.lower(), *filter(None, [_ACTIONS[spec.action]]), *inhibits]
    )
    text = shown.removeprefix(PREFIX)
    cells = (f"`{spec.id.value}`", text, action, spec.raised, ended, spec.meaning, spec.operator)
    return f"| {' | '.join(cells)} |\n"


def _value(field: str, spec: AlertSpec) -> str:
    name = field.strip("{}").partition(":")[0]
    kind = spec.kinds[name]
    if kind is MapOffsetUse:
        return f"[{MapOffsetUse.APPLIED}]"
    is_number = (isinstance(kind, str) and kind not in ("", "name")) or name == "ratio"
    return "N" if is_number else name.upper()
