"""Latches: time to alert, release, repetition, and what no evidence does."""

from companion.integrity_monitor.debouncer import AlertDebouncer, CheckResult
from mavlink_bridge.alerts.alert import Alert, AlertSpec, Severity
from mavlink_bridge.alerts.catalogue import cleared
from mavlink_bridge.alerts.ids import AlertId

SECOND = 1_000_000_000
BAD, GOOD, UNKNOWN = CheckResult(True, 12.0), CheckResult(False), CheckResult(None)


def rule(repeat_s: float = 0.0) -> AlertSpec:
    """An alert that is raised after 1 s and cleared after 2 s."""
    return AlertSpec(
        AlertId.HEIGHT_MISMATCH, Severity.ERROR, "a fault", "fault of {metres:.0f} m",
        {"metres": "m"}, raise_s=1.0, clear_s=2.0, repeat_s=repeat_s,
    )  # fmt: skip


RAISED, OVER = Alert(AlertId.HEIGHT_MISMATCH, (12.0,)), cleared(AlertId.HEIGHT_MISMATCH)


def test_it_holds_until_good_evidence_lasts() -> None:
    """Flicker and silence do not release it."""
    debouncer = AlertDebouncer(rule())
    debouncer.update(0, BAD)
    debouncer.update(SECOND, BAD)
    assert debouncer.raised
    for k in range(2, 9):
        debouncer.update(k * SECOND, (GOOD, BAD, UNKNOWN)[k % 3])
        assert debouncer.raised
    debouncer.update(20 * SECOND, GOOD)
    assert debouncer.update(22 * SECOND, GOOD) == OVER
    assert not debouncer.raised


def test_silence_is_no_good_evidence() -> None:
    """Good once, then nothing for long, then good once more does not release it."""
    debouncer = AlertDebouncer(rule())
    debouncer.update(0, BAD)
    debouncer.update(SECOND, BAD)
    debouncer.update(2 * SECOND, GOOD)
    for k in range(3, 10):
        debouncer.update(k * SECOND, UNKNOWN)
    assert debouncer.update(10 * SECOND, GOOD) is None
    assert debouncer.raised
    assert debouncer.update(12 * SECOND, GOOD) == OVER


def test_silence_is_no_evidence_of_a_fault() -> None:
    """Bad, then nothing for long, then bad again is not a fault that lasted."""
    debouncer = AlertDebouncer(rule())
    debouncer.update(0, BAD)
    for k in range(1, 10):
        debouncer.update(k * SECOND, UNKNOWN)
    assert debouncer.update(10 * SECOND, BAD) is None
