"""Every alert renders, fits one STATUSTEXT, and is found again from its text."""

from __future__ import annotations

import pytest

from mavlink_bridge.alerts.alert import Alert, AlertSpec, OutputAction, Severity, Value
from mavlink_bridge.alerts.catalogue import CATALOGUE, TEXT_LENGTH, alert, cleared, severity, text
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.reading import alert_of

WORDS: dict[str, Value] = {
    "direction": "north-east", "axis": "pitch", "how": "hangs (localizati)", "sender": "10.0.0.2:1",
    "output": "nothing is injected", "message": "VISION_POSITION_ESTIMATE",
    "cause": "GNSS off vision",
    "result": "temporarily_rejected", "by": "channel 12", "host": "255.255.255.255",
    "alert": "GNSS/vision mismatch", "applied": ", applied", "name": "car 12",
    "used": 200, "system": 200, "device": 200, "number": 12, "level": 88.0, "seconds": 30.0,
}  # fmt: skip
WHY = {  # the longest that is told
    AlertId.LOOK_AT_REFUSED: "no place on Earth", AlertId.SENDER_REFUSED: "not allowed",
    AlertId.SENDERS_REFUSED: "not allowed", AlertId.SOURCE_SET_HELD: "EKF with GNSS",
    AlertId.TLOG_INCOMPLETE: "Read-only file system", AlertId.NO_TARGET: "position not known",
    AlertId.TARGET_REFUSED: "the map has a hole there", AlertId.TARGET_SILENT: "moved 12 m",
    AlertId.GNSS_REFUSED: "m/s off vision", AlertId.TARGET_NOT_LOCATED: "no map under it",
}  # fmt: skip


def example(spec: AlertSpec) -> Alert:
    """The longest that its values make it."""
    words: dict[str, Value] = WORDS | {"why": WHY.get(spec.id, "")}
    if spec.id is AlertId.COMPONENT_STALLED:
        words["component"] = "integrity monitor"
    if spec.id is AlertId.FOCAL_LENGTH or spec.id is AlertId.TIME_OFFSET:
        words["direction"] = "short"
    return Alert(spec.id, tuple(words.get(name, 88.8) for name in spec.values))


@pytest.mark.parametrize("of", AlertId)
def test_every_alert_renders_and_is_read_again(of: AlertId) -> None:
    """Texts fit one STATUSTEXT: a chunked one may be cut by a lossy link just where it matters."""
    spec = CATALOGUE[of]
    raised, over = example(spec), cleared(of)
    assert (severity(raised), severity(over)) == (spec.severity, Severity.NOTICE)
    for one in (raised, over) if spec.cleared else (raised,):
        line = text(one)
        assert len(line) <= TEXT_LENGTH, line
        assert line.startswith("PiLoT: ")
        assert line.isascii()
        assert alert_of(line) == (of, one.active)
    assert ("output held" in text(raised)) is (spec.action is not OutputAction.NONE)
    for told in (spec.raised, spec.meaning, spec.operator):
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
