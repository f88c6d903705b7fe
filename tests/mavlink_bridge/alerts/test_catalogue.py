"""Every alert renders, fits one STATUSTEXT, and is found again from its text."""

from __future__ import annotations

import pytest

from mavlink_bridge.alerts.alert import Alert, AlertSpec, OutputAction, Severity
from mavlink_bridge.alerts.catalogue import CATALOGUE, TEXT_LENGTH, alert, cleared, severity, text
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.reading import alert_of

WORDS = {
    "direction": "short",
    "axis": "pitch",
    "component": "integrity monitor",
    "why": "m/s off vision",
}


def example(spec: AlertSpec) -> Alert:
    """The longest that its values make it."""
    return Alert(spec.id, tuple(WORDS.get(name, 188.8) for name in spec.values))


@pytest.mark.parametrize("of", AlertId)
def test_every_alert_renders_and_is_read_again(of: AlertId) -> None:
    """Texts fit one STATUSTEXT: a chunked one may be cut by a lossy link just where it matters."""
    spec = CATALOGUE[of]
    raised, over = example(spec), cleared(of)
    assert (severity(raised), severity(over)) == (spec.severity, Severity.NOTICE)
    for one in (raised, over):
        line = text(one)
        assert len(line) <= TEXT_LENGTH, line
        assert line.startswith("PiLoT: ")
        assert line.isascii()
        assert alert_of(line) == (of, one.active)
    assert ("output held" in text(raised)) is (spec.action is not OutputAction.NONE)
    for told in (spec.raised, spec.cleared, spec.meaning, spec.operator):
        assert told


def test_values_are_named_by_the_catalogue() -> None:
    with pytest.raises(ValueError, match="its values are seconds"):
        alert(AlertId.VIDEO_FROZEN, metres=3.0)
    with pytest.raises(ValueError, match="the text uses"):
        AlertSpec(AlertId.VIDEO_FROZEN, Severity.ERROR, "frozen", "frozen {seconds}", {"m": "m"})


def test_alerts_that_differ_in_numbers_only_have_one_key() -> None:
    four, nine = (alert(AlertId.VIDEO_FROZEN, seconds=s) for s in (4.0, 9.0))
    assert four.key == nine.key
    long, short = (alert(AlertId.FOCAL_LENGTH, percent=3.0, direction=d) for d in ("long", "short"))
    assert long.key != short.key


def test_other_texts_are_no_alert() -> None:
    assert alert_of("PreArm: GPS 1: Bad fix") is None
