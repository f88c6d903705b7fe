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

For the pilot and the operator: every text that the companion sends, its cause, its effect and what
to do. Made from the catalogue by `python -m benchmarks.site`; do not edit.

An alert is sent as STATUSTEXT `{PREFIX}TEXT`. `events.csv` and `health.json` contain its
identifier. In a text, N is a number, and other capitals are a name, a number or a reason. Names
such as `bridge.origin` are keys of the deployment file; limits without a key are fixed.

| term | meaning |
|---|---|
| fix | a position from vision. Injection sends it to the autopilot: in mode inject after the \
shadow check (see *Not ready*), in mode rc after the pilot's order. In mode shadow none is sent |
| fixes continue | this alert does not stop fixes; another alert can |
| no fixes | vision makes no fix, so none is sent, until the alert ends |
| output held; hold | fixes are made, but none is sent, until the alert ends |
| exclude and reset | as *hold*; the first fix afterwards also increments `reset_counter`, which \
tells the EKF to jump |
| inhibit | injection and the switch to the vision source set do not start. Injection that runs \
continues. If the program crashes before injection has started, and restarts within 10 min, the \
alert stays active |
| one-off | the alert reports one moment; nothing has to end |
| good GNSS | GNSS has a 3D fix, and neither `gnss_refused` nor `gnss_vision_mismatch` is active |
| take over | On the ground: wait, and do not take off on vision. In flight: if the EKF uses good \
GNSS, do nothing; if GNSS is good but not used, select the GNSS source set; without good GNSS \
change to ALT_HOLD or STABILIZE (PX4: Altitude, Stabilized), which need no position |
| compare with landmarks | compare the position on the ground station's map with what the pilot or \
the video shows. If it is wrong, take over |
| in flight | armed, and 3 m or more above or below the take-off height |
| sigma | one standard deviation of the value or difference that is judged |
| protection level | radius that the position error exceeds in at most 0.1 % of fixes \
(`integrity_monitor.protection.risk`) |
| message | the value of `bridge.injection.message` |

Without GNSS and without fixes, ArduPilot's EKF has no input. ArduPilot then lands after 5 to 8 s
([when vision ends](../how-to/when-vision-ends.md)). PX4 sends
ESTIMATOR_STATUS in place of EKF_STATUS_REPORT.

**Not sent:** the EKF receives no position; the alert says why. In mode shadow it says why none
could be sent.

**Effect:** a row that names no effect on fixes has none.

**Not ready:** such an alert says why the shadow check has not passed. Until it passes, injection
does not start, with three exceptions: `bridge.injection.force`; the pilot (mode rc); no GNSS, if
the check has not failed (`injection_unchecked`). The first two also override *inhibit*. The check
compares the fixes of the last two minutes with the EKF's position on GNSS. Such an alert is sent
as a text only in mode inject, if fixes are made but injection has not started for 10 s. It ends
when 50 or more compared fixes meet the limit; without GNSS a failed check stays failed. *Valid
pass*: the check passed at most 10 min ago, and at most 30 s before the last compared fix.

**Fixes and EKF:** `fix_rate_low` to `ekf_rejects_fixes` need 3 s or more of sent fixes. Only the
first of these six whose condition holds is active.

**Repeats and ends:** statuses of localization are assessed once a second; the same one is sent at
most every 10 s. The end of a check of positions is sent as `cleared: NAME`, that of some others as
the text in brackets. Other alerts have no such text: the next status, for example `localization
tracking`, shows their end.
"""
_TABLE = """
## {}

| identifier | text | severity, action | raised when | ends when | meaning | what to do |
|---|---|---|---|---|---|---|
"""
_GROUPS = {
    "Checks of positions (integrity monitor)": (*INTEGRITY, *MONITOR, *SOURCES),
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
    ended = spec.cleared or "one-off"
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
