"""The reference page of all alerts, made from the catalogue."""

from __future__ import annotations

import re

from mavlink_bridge.alerts.alert import (
    NOTHING,
    PREFIX,
    WHILE,
    AlertSpec,
    Inhibits,
    OutputAction,
    Severity,
)
from mavlink_bridge.alerts.companion import CONSOLE, HEALTH, TARGETS
from mavlink_bridge.alerts.injection import INJECTION
from mavlink_bridge.alerts.integrity import INTEGRITY, MONITOR, SOURCES
from mavlink_bridge.alerts.vehicle import VEHICLE
from mavlink_bridge.alerts.words import MapOffsetUse

_HEAD = f"""---
hide: [toc]
---

# Alerts

For the pilot and the operator: every text that the companion sends. Made from the catalogue by
`python -m benchmarks.site`; do not edit.

An alert is sent as STATUSTEXT `{PREFIX}TEXT`. Left: its text, its identifier in `events.csv` and
`health.json`, and the severity *error* or *critical* (others: warning or less). Right: its cause
and end, in italics its meaning and effect, in bold what to do. In a text, N is a number; other
capitals are a name, a number or a reason. `bridge.origin` and the like are keys of the deployment
file.

**Fixes:** an alert stops fixes only if its text begins with *output held* or *not sent*, or its row
says *no fixes*.

**Ends:** with *while*, an alert is active as long as this is true; with *Ends:*, until that is
true; others report one moment. The end is sent as `cleared: NAME` (checks of positions), as the
text in brackets, or by the next text, such as `injecting`, `the EKF follows` or `localization
tracking`, after 1.5 s (up to 60 s if the alert recurs).

**Repetition:** a text is sent when its alert begins, and again while it lasts only where its row
says *every N s*; *once*: not again before a restart. An unchanged localization status is sent
once; one that comes back, every 10 s at most.

**Times:** "for 2 s" means all the time. A check without data (no fix for 1 s, no frame for 2 s, no
IMU messages) leaves its alert as it is. "More than A, and more than B": both.

| term | meaning |
|---|---|
| fix | a position from vision |
| injection | fixes are sent to the autopilot: in mode inject from the shadow check on, in mode \
rc from the pilot's order until he ends it, in mode shadow never |
| shadow check | compares the fixes of the last 2 min with the EKF's position on GNSS. *Valid \
pass*: it passed at most 10 min ago, and at most 30 s before the last compared fix |
| not ready | why the shadow check has not passed: do not fly on vision. Injection then starts \
only by `bridge.injection.force`, by the pilot (mode rc), or without GNSS if the check has not \
failed. Sent in mode inject when fixes have waited for 10 s; `injecting` ends it. Limits apply \
to 50 or more fixes; without GNSS a failed check stays failed |
| not sent | why no position is sent (mode shadow: could be sent) |
| output held | fixes are made, but none is sent until the alert ends |
| reset | the first fix after *output held* increments `reset_counter`: the EKF jumps to it |
| inhibit | injection and the switch to the vision source set do not start, except by the pilot \
(mode rc) or `force`. Running injection continues. A restart within 10 min after a crash before \
injection restores the alert |
| no fixes | vision makes no fix until the alert ends |
| EKF check | the first alert from `fix_rate_low` to `ekf_rejects_fixes` whose condition is true \
for the positions sent in the last 3 s |
| accepted, rejected | the frame matches the map well enough, or not |
| odometry | motion from frame to frame; it continues the position without the map |
| good GNSS | a 3D fix, without `gnss_refused` and `gnss_vision_mismatch` |
| take over | On the ground: wait, and do not take off on vision. In flight: if the EKF uses good \
GNSS, nothing; if good GNSS is not used, select the GNSS source set; without good GNSS change to \
ALT_HOLD or STABILIZE (PX4: Altitude, Stabilized), which need no position, and land if it lasts |
| check landmarks | compare the position on the ground station's map with what pilot or video \
show; if it is wrong, take over |
| give the position | send the approximate position: *I am here* in the console, or \
MAV_CMD_EXTERNAL_POSITION_ESTIMATE to component 197. It limits the search, and is never a fix |
| armed:, in flight: | otherwise the alert ends. *In flight*: armed, and 3 m or more from the \
take-off height |
| sigma | one standard deviation of the judged value |
| protection level | radius that the position error exceeds in at most 0.1 % of fixes \
(`integrity_monitor.protection.risk`) |
| message | the value of `bridge.injection.message` |
| test ratio | of EKF_STATUS_REPORT (PX4: ESTIMATOR_STATUS): above 1 the EKF rejects positions |

Without GNSS and without fixes, ArduPilot lands after 5 to 8 s
([when vision ends](../how-to/when-vision-ends.md)).
"""
_TABLE = """
## {}

| text | raised, ends, *meaning*, **what to do** |
|---|---|
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
    OutputAction.HOLD: "",
    OutputAction.EXCLUDE_AND_RESET: "reset",
}


def alerts_page() -> str:
    """The page, Markdown."""
    return _HEAD + "".join(
        _TABLE.format(title) + "".join(map(_row, specs)) for title, specs in _GROUPS.items()
    )


def _row(spec: AlertSpec) -> str:
    shown = re.sub(r"\{\w+[^}]*\}", lambda m: _value(m.group(), spec), spec.template)
    lines = [f"*while* {spec.raised}" if spec.cleared == WHILE else spec.raised]
    if spec.cleared not in ("", WHILE):
        text = f" (`{spec.cleared_text}`)" if spec.cleared_text else ""
        lines.append(f"*Ends:* {spec.cleared}{text}")
    lines.append(f"<i>{spec.meaning}</i>")
    if spec.operator != NOTHING:
        lines.append(f"**{spec.operator}**")
    marks = (
        spec.severity.name.lower() if spec.severity <= Severity.ERROR else "",
        _ACTIONS[spec.action],
        "inhibit" if Inhibits.INJECTION in spec.inhibits else "",
        f"every {spec.repeat_s:.0f} s" if spec.repeat_s else "",
    )
    name = ", ".join([f"`{spec.id.value}`", *filter(None, marks)])
    return f"| {shown.removeprefix(PREFIX)}<br>{name} | {'<br>'.join(lines)} |\n"


def _value(field: str, spec: AlertSpec) -> str:
    name = field.strip("{}").partition(":")[0]
    kind = spec.kinds[name]
    if kind is MapOffsetUse:
        return f"[{MapOffsetUse.APPLIED}]"
    is_number = (isinstance(kind, str) and kind not in ("", "name")) or name == "ratio"
    return "N" if is_number else name.upper()
