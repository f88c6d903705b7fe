"""Every alert renders, fits one STATUSTEXT, and is found again from its text."""

from __future__ import annotations

import pytest

from localizer.targets.limits import RefusalReason, TargetRefusal
from mavlink_bridge.alerts.alert import (
    PREFIX,
    Alert,
    AlertSpec,
    Inhibits,
    Kind,
    OutputAction,
    Severity,
    Value,
)
from mavlink_bridge.alerts.catalogue import CATALOGUE, TEXT_LENGTH, alert, cleared, severity, text
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.reading import alert_of
from mavlink_bridge.alerts.words import ChosenSet, Name, RcChannel, Word
from mavlink_bridge.link.tlog import PART, WHOLE

NUMBERS = {
    "used": 200, "system": 200, "device": 200, "number": 12, "level": 88.0, "seconds": 30.0,
}  # fmt: skip
NAMES = {  # the longest that comes from outside
    "sender": "10.0.0.2:1", "host": "255.255.255.255", "message": "VISION_POSITION_ESTIMATE",
    "component": "integrity monitor", "what": "localizati",
    "name": "car 12",
}  # fmt: skip
REFUSED = max((str(TargetRefusal(why, 88.8)) for why in RefusalReason), key=len)
WHY = {
    AlertId.TLOG_INCOMPLETE: max(WHOLE, PART, "No space left on device", key=len),
    AlertId.TARGET_REFUSED: REFUSED, AlertId.TARGET_SILENT: REFUSED,
    AlertId.TARGET_NOT_LOCATED: REFUSED,
}  # fmt: skip


def example(spec: AlertSpec) -> Alert:
    """The longest that its values make it."""
    return Alert(spec.id, tuple(longest(spec, name, kind) for name, kind in spec.kinds.items()))


def longest(spec: AlertSpec, name: str, kind: Kind) -> Value:
    if kind == "name":
        return Name(WHY[spec.id] if name == "why" else NAMES[name])
    if isinstance(kind, str):
        return NUMBERS.get(name, 88.8)
    if kind is AlertId:
        inhibit = (one for one in CATALOGUE.values() if Inhibits.INJECTION in one.inhibits)
        return max(inhibit, key=lambda one: len(one.title)).id
    of = kind if isinstance(kind, tuple) else (kind,)
    words: list[Value] = [word for one in of if issubclass(one, Word) for word in one]
    numbered = [one(18) for one in of if issubclass(one, RcChannel | ChosenSet)]
    return max(*words, *numbered, key=lambda one: len(str(one)))


@pytest.mark.parametrize("of", AlertId)
def test_every_alert_renders_and_is_read_again(of: AlertId) -> None:
    """Texts fit one STATUSTEXT: a chunked one may be cut by a lossy link just where it matters."""
    spec = CATALOGUE[of]
    raised = example(spec)
    assert severity(raised) == spec.severity
    for one in (raised, cleared(of)) if spec.reports_end else (raised,):
        line = text(one)
        assert len(line) <= TEXT_LENGTH, line
        assert line.startswith(PREFIX)
        assert line.isascii()
        assert alert_of(line) == (of, one.active)
    assert ("output held" in text(raised)) is (spec.action is not OutputAction.NONE)
    assert spec.raised
    assert spec.meaning
    assert spec.operator


def test_only_an_alert_that_lasts_is_cleared() -> None:
    assert severity(cleared(AlertId.VIDEO_FROZEN)) == Severity.NOTICE
    assert CATALOGUE[AlertId.FC_SILENT].cleared
    for of in (AlertId.FC_REBOOTED, AlertId.FC_SILENT):  # an event; another alert says its end
        with pytest.raises(ValueError, match="its end has no text"):
            cleared(of)


def test_values_are_named_by_the_catalogue() -> None:
    with pytest.raises(ValueError, match="its values are seconds"):
        alert(AlertId.VIDEO_FROZEN, metres=3.0)
    with pytest.raises(ValueError, match="the text uses"):
        AlertSpec(AlertId.VIDEO_FROZEN, Severity.ERROR, "frozen", "frozen {seconds}", {"m": "m"})


def test_other_texts_are_no_alert() -> None:
    assert alert_of("PreArm: GPS 1: Bad fix") is None
