"""The catalogue: one row for each alert. All texts and tables are made from it."""

from __future__ import annotations

from mavlink_bridge.alerts.alert import PREFIX, Alert, AlertSpec, Severity, Value
from mavlink_bridge.alerts.companion import CONSOLE, HEALTH, TARGETS
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.injection import INJECTION
from mavlink_bridge.alerts.integrity import INTEGRITY, MONITOR, SOURCES
from mavlink_bridge.alerts.vehicle import VEHICLE

_GROUPS = (INTEGRITY, MONITOR, SOURCES, INJECTION, VEHICLE, HEALTH, TARGETS, CONSOLE)

CATALOGUE: dict[AlertId, AlertSpec] = {spec.id: spec for group in _GROUPS for spec in group}
TEXT_LENGTH = 50  # STATUSTEXT.text


def spec_of(alert: Alert | AlertId) -> AlertSpec:
    """The catalogue row of an alert or identifier."""
    return CATALOGUE[alert.id if isinstance(alert, Alert) else alert]


def alert(of: AlertId, **values: Value) -> Alert:
    """An active alert with values by name; ValueError for names that differ from the catalogue."""
    names = CATALOGUE[of].values
    if set(values) != set(names):
        raise ValueError(f"{of}: its values are {', '.join(names) or 'none'}, not {values}")
    return Alert(of, tuple(values[name] for name in names))


def cleared(of: AlertId) -> Alert:
    """The end of an alert; ValueError if the catalogue has no text for its end."""
    if not CATALOGUE[of].reports_end:
        raise ValueError(f"{of}: its end has no text")
    return Alert(of, active=False)


def severity(of: Alert) -> Severity:
    """MAV_SEVERITY of the text; NOTICE for the end of an alert."""
    return spec_of(of).severity if of.active else Severity.NOTICE


def body(of: Alert) -> str:
    """The text without the prefix, as a part of another line."""
    return text(of).removeprefix(PREFIX)


def reason(of: Alert) -> str:
    """The text without prefix and lead ("not ready: "), for a list of reasons."""
    return body(of).removeprefix(spec_of(of).lead)


def values_by_name(of: Alert) -> dict[str, Value | str]:
    """The alert's values by name, {} for a cleared one; a value that is an alert as its title."""
    shown = (CATALOGUE[v].title if isinstance(v, AlertId) else v for v in of.values)
    return dict(zip(spec_of(of).values, shown, strict=True)) if of.active else {}


def text(of: Alert) -> str:
    """The STATUSTEXT, with the prefix and not cut; of a cleared alert, the text of its end."""
    spec = spec_of(of)
    if of.active:
        return spec.template.format(**values_by_name(of))
    return PREFIX + (f"cleared: {spec.title}" if spec.cleared_text is None else spec.cleared_text)
