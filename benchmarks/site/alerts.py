"""The reference page of all alerts, made from the catalogue."""

from __future__ import annotations

import re

from mavlink_bridge.alerts.alert import PREFIX, AlertSpec, Inhibits, OutputAction
from mavlink_bridge.alerts.catalogue import CATALOGUE, body, cleared
from mavlink_bridge.alerts.words import MapOffsetUse

_HEAD = f"""# Alerts

Made from the catalogue by `python -m benchmarks.site`; do not edit. Every text begins with
`{PREFIX.strip()}`. The identifier stands in `events.csv` and `health.json`. *Output held*: nothing
is sent. *Exclude and reset*: also, the next fix increments `reset_counter`. *Inhibit*: injection
and the switch to vision do not start; injection that is running continues. *Event*: it happens once
and does not end. A text in brackets is sent when the alert is cleared; after other alerts, the next
status follows (`localization tracking`, `injecting`, `the EKF follows`, `fixes are in time again`).

| identifier | text | raised when | cleared when | severity, action |
|---|---|---|---|---|
"""
_MEANING = """
## What it means and what to do

| identifier | meaning | what the operator does |
|---|---|---|
"""
_ACTIONS = {
    OutputAction.NONE: "",
    OutputAction.HOLD: "hold",
    OutputAction.EXCLUDE_AND_RESET: "exclude and reset",
}


def alerts_page() -> str:
    """Its text, Markdown."""
    rows = "".join(_row(spec) for spec in CATALOGUE.values())
    meanings = "".join(
        f"| `{spec.id.value}` | {spec.meaning} | {spec.operator} |\n" for spec in CATALOGUE.values()
    )
    return _HEAD + rows + _MEANING + meanings


def _row(spec: AlertSpec) -> str:
    shown = re.sub(r"\{\w+[^}]*\}", lambda m: _value(m.group(), spec), spec.template)
    ended = spec.cleared or "event"
    if spec.reports_end:
        ended += f" (`{body(cleared(spec.id))}`)"
    inhibits = ["inhibit"] if Inhibits.INJECTION in spec.inhibits else []
    action = ", ".join(
        [spec.severity.name.lower(), *filter(None, [_ACTIONS[spec.action]]), *inhibits]
    )
    text = shown.removeprefix(PREFIX)
    return f"| `{spec.id.value}` | {text} | {spec.raised} | {ended} | {action} |\n"


def _value(field: str, spec: AlertSpec) -> str:
    name = field.strip("{}").partition(":")[0]
    kind = spec.kinds[name]
    if kind is MapOffsetUse:
        return f"[{MapOffsetUse.APPLIED}]"
    is_number = (isinstance(kind, str) and kind not in ("", "name")) or name == "ratio"
    return "N" if is_number else name.upper()
