"""What the monitor may find: limits in time, texts, actions, and latches that do not flap.

What forbids injection is kept over a restart: a turn or a climb showed it, and may in minutes
again, and who takes over from a killed process under denial would begin after two seconds.
"""

from __future__ import annotations

import enum
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mavlink_bridge.injection.restart_memory import RestartMemory

PREFIX = "PiLoT: "
_LARGEST = 1e4  # per cent, degrees, milliseconds; of what is kept
_LONGEST = 10  # characters of a word that is


class OutputAction(enum.IntEnum):
    """What a finding does to the fixes, mildest first.

    WITHDRAW is WITHHOLD with a reset announced on the return: the EKF holds what was wrong.
    """

    NONE = 0
    HOLD = 1
    EXCLUDE_AND_RESET = 2


@dataclass(frozen=True)
class AlertRule:
    """One line of the table in docs/explanation/integrity.md.

    text: for the operator, with one figure {0:.0f} and a word {1}. raise_s: how long the evidence
    must last; clear_s: how long it must be over. repeat_s: told again as long as it lasts; 0:
    once. forbids: while it stands, injection and a switch to vision do not begin.
    """

    name: str
    text: str
    action: OutputAction
    raise_s: float
    clear_s: float
    repeat_s: float = 0.0
    inhibits: bool = False

    @property
    def _template(self) -> str:
        held = "withheld: " if self.action is not OutputAction.NONE else ""
        return f"{PREFIX}{held}{self.text}"

    def line(self, figure: float, word: str = "") -> str:
        """The STATUSTEXT."""
        return self._template.format(figure, word)

    def is_line(self, text: str) -> bool:
        """Whether a STATUSTEXT is this rule's, whatever its figure and word."""
        fixed = re.split(r"\{[^}]*\}", self._template)
        return re.fullmatch(".+".join(re.escape(part) for part in fixed), text) is not None


VIDEO_FROZEN = AlertRule(
    "video_frozen", "video frozen {0:.0f} s", OutputAction.EXCLUDE_AND_RESET, 0.0, 2.0
)
VIDEO_REPEATS = AlertRule(
    "video_repeats", "video repeats, {0:.0f} s old", OutputAction.EXCLUDE_AND_RESET, 0.0, 5.0
)
MOTION = AlertRule(
    "motion", "motion is not the IMU's ({0:.0f} m)", OutputAction.EXCLUDE_AND_RESET, 0.2, 5.0
)
HEIGHT = AlertRule(
    "height", "height {0:.0f} m off barometer", OutputAction.EXCLUDE_AND_RESET, 2.0, 5.0
)
JUMP = AlertRule("jump", "position jumped {0:.0f} m", OutputAction.EXCLUDE_AND_RESET, 0.0, 0.0)
STEP = AlertRule(
    "step", "position stepped {0:.0f} m, unexplained", OutputAction.NONE, 0.0, 0.0, 60.0
)
TILT = AlertRule("tilt", "tilt {0:.0f} deg off the autopilot's", OutputAction.NONE, 1.0, 3.0, 60.0)
GNSS = AlertRule(
    "gnss", "GNSS {0:.0f} m from vision: neither proven", OutputAction.NONE, 2.0, 5.0, 10.0
)
EKF_REFUSES = AlertRule(
    "ekf_refuses", "EKF refuses vision ({0:.1f})", OutputAction.NONE, 2.0, 3.0, 10.0
)
EKF_JUMPED = AlertRule(
    "ekf_jumped", "EKF jumped {0:.0f} m: unconfirmed", OutputAction.NONE, 0.0, 0.0
)
CLOCK = AlertRule("clock", "video clock ran back or stands", OutputAction.HOLD, 0.5, 3.0)
LIMIT = AlertRule("limit", "position only to {0:.0f} m", OutputAction.HOLD, 1.0, 3.0)
FOCAL = AlertRule(
    "focal_length",
    "focal length looks {0:.1f} % {1}",
    OutputAction.NONE,
    2.0,
    10.0,
    60.0,
    inhibits=True,
)
BORESIGHT = AlertRule(
    "boresight", "camera {0:.0f} deg off in {1}", OutputAction.NONE, 3.0, 10.0, 60.0,
    inhibits=True,
)  # fmt: skip
TIME_OFFSET = AlertRule(
    "time_offset",
    "pictures stamped {0:.0f} ms {1}",
    OutputAction.NONE,
    1.0,
    10.0,
    60.0,
    inhibits=True,
)
FAILED = AlertRule("guardian_failed", "guardian failed", OutputAction.HOLD, 0.0, 3.0, 10.0)
UNJUDGED = AlertRule("judges", "fixes cannot be judged", OutputAction.HOLD, 0.0, 3.0, 10.0)
STANDS = AlertRule("part_stands", "{1} stands {0:.0f} s", OutputAction.NONE, 0.0, 3.0, 10.0)
RULES = (
    VIDEO_FROZEN,
    VIDEO_REPEATS,
    MOTION,
    HEIGHT,
    JUMP,
    STEP,
    TILT,
    GNSS,
    EKF_REFUSES,
    EKF_JUMPED,
    CLOCK,
    LIMIT,
    FOCAL,
    BORESIGHT,
    TIME_OFFSET,
)


@dataclass(frozen=True)
class CheckResult:
    """A detector's answer. bad: None where there is no evidence, which changes nothing."""

    bad: bool | None
    figure: float = 0.0
    word: str = ""


class AlertDebouncer:
    """A rule over time: raised after raise_s of bad evidence, released after clear_s of good.

    Time without evidence counts for neither, and nothing is told again in it: a receiver that is
    gone is no metres from vision.
    """

    def __init__(self, rule: AlertRule) -> None:
        self.rule = rule
        self.raised = False
        self.figure = 0.0
        self.word = ""
        self._since_ns: int | None = None
        self._updated_ns = 0
        self._told_ns = 0

    def update(self, now_ns: int, reading: CheckResult) -> str | None:
        """Take in a reading; the line to tell the operator, if there is news."""
        silent_ns, self._updated_ns = now_ns - self._updated_ns, now_ns
        if reading.bad is None:
            if not self.raised:
                self._since_ns = None
            elif self._since_ns is not None:
                self._since_ns += silent_ns
            return None
        if reading.bad:
            self.figure, self.word = reading.figure, reading.word
        if reading.bad == self.raised:
            self._since_ns = None
            return self._again(now_ns)
        if self._since_ns is None:
            self._since_ns = now_ns
        wait_s = self.rule.clear_s if self.raised else self.rule.raise_s
        if now_ns - self._since_ns < wait_s * 1e9:
            return self._again(now_ns)
        self._since_ns, self.raised, self._told_ns = None, not self.raised, now_ns
        return self.line() if self.raised else f"{PREFIX}over: {self.rule.name.replace('_', ' ')}"

    def restore(self, figure: float, word: str) -> None:
        """It stood in a process before this one: evidence releases it, as any other."""
        self.raised, self.figure, self.word = True, figure, word

    def line(self) -> str:
        """The operator's line, with the newest figure."""
        return self.rule.line(self.figure, self.word)

    def _again(self, now_ns: int) -> str | None:
        repeats = self.raised and self.rule.repeat_s > 0.0
        if not repeats or now_ns - self._told_ns < self.rule.repeat_s * 1e9:
            return None
        self._told_ns = now_ns
        return self.line()


ActiveAlerts = Mapping[str, tuple[float, str]]
"""Findings by the names of their rules: figure and word."""

_FORBID = frozenset(rule.name for rule in RULES if rule.inhibits)


class InhibitMemory:
    """Of the findings that stand and forbid; see `RestartMemory`."""

    def __init__(self, memory: RestartMemory) -> None:
        self._memory = memory
        self._kept: frozenset[str] = frozenset()

    def recall(self) -> ActiveAlerts:
        """What stood in the process before; empty for nothing."""
        kept = self._memory.recall()
        told = None if kept is None else kept[0].get("forbids")
        rows = told.items() if isinstance(told, dict) else ()
        found = {name: row for name, told in rows if (row := _row(told)) and name in _FORBID}
        self.note(found)
        return found

    def note(self, found: ActiveAlerts) -> None:
        """What stands now."""
        if found.keys() == self._kept:
            return
        self._kept = frozenset(found)
        if found:
            self._memory.keep({"forbids": dict(found)})
        else:
            self._memory.drop()

    def stop(self, *, clean_shutdown: bool = True) -> None:
        """The end; see `RestartMemory.stop`."""
        self._memory.stop(clean_shutdown=clean_shutdown)


def _row(told: Any) -> tuple[float, str] | None:
    if not isinstance(told, list) or len(told) != 2:
        return None
    figure, word = told
    if not isinstance(figure, float) or not abs(figure) <= _LARGEST:
        return None
    known = isinstance(word, str) and len(word) <= _LONGEST and word.isprintable()
    return (figure, word) if known else None
