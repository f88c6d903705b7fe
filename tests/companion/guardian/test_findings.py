"""Latches: time to alert, release, repetition, and what no evidence does."""

import pytest

from companion.guardian.findings import (
    PREFIX,
    RULES,
    Action,
    Latch,
    Reading,
    Rule,
)

SECOND = 1_000_000_000
BAD, GOOD, UNKNOWN = Reading(True, 12.0), Reading(False), Reading(None)


def rule(**changes: float) -> Rule:
    """A rule that alerts after 1 s and is over after 2 s."""
    return Rule("a_fault", "fault of {0:.0f} m", Action.WITHDRAW, 1.0, 2.0, **changes)


@pytest.mark.parametrize("each", RULES, ids=lambda each: each.name)
def test_every_text_fits_one_statustext(each: Rule) -> None:
    """A chunked text may be cut by a lossy link just where it matters."""
    assert len(each.line(999.0)) <= 50  # STATUSTEXT.text


def test_it_alerts_once_after_its_time() -> None:
    """Not before, not again, and with the newest figure."""
    latch = Latch(rule())
    told = [latch.update(k * SECOND // 2, BAD) for k in range(6)]
    assert [text is not None for text in told] == [False, False, True, False, False, False]
    assert told[2] == f"{PREFIX}withheld: fault of 12 m"


def test_a_moment_is_no_finding() -> None:
    """Good evidence in between starts the time anew."""
    latch = Latch(rule())
    for k in range(20):
        assert latch.update(k * SECOND // 2, GOOD if k % 2 else BAD) is None
    assert not latch.raised


def test_it_holds_until_good_evidence_lasts() -> None:
    """Flicker and silence do not release it."""
    latch = Latch(rule())
    latch.update(0, BAD)
    latch.update(SECOND, BAD)
    assert latch.raised
    for k in range(2, 9):
        latch.update(k * SECOND, (GOOD, BAD, UNKNOWN)[k % 3])
        assert latch.raised
    latch.update(20 * SECOND, GOOD)
    assert latch.update(22 * SECOND, GOOD) == f"{PREFIX}over: a fault"
    assert not latch.raised


def test_silence_is_no_good_evidence() -> None:
    """Good once, then nothing for long, then good once more does not release it."""
    latch = Latch(rule())
    latch.update(0, BAD)
    latch.update(SECOND, BAD)
    latch.update(2 * SECOND, GOOD)
    for k in range(3, 10):
        latch.update(k * SECOND, UNKNOWN)
    assert latch.update(10 * SECOND, GOOD) is None
    assert latch.raised
    assert latch.update(12 * SECOND, GOOD) == f"{PREFIX}over: a fault"


def test_silence_is_no_evidence_of_a_fault() -> None:
    """Bad, then nothing for long, then bad again is not a fault that lasted."""
    latch = Latch(rule())
    latch.update(0, BAD)
    for k in range(1, 10):
        latch.update(k * SECOND, UNKNOWN)
    assert latch.update(10 * SECOND, BAD) is None


def test_what_lasts_is_told_again() -> None:
    """Every repeat_s, and not more often."""
    latch = Latch(rule(repeat_s=10.0))
    told = [k for k in range(40) if latch.update(k * SECOND, BAD) is not None]
    assert told == [1, 11, 21, 31]
