"""What the guardian may find: limits in time, texts, actions, and latches that do not flap.

What forbids injection is kept over a restart: a turn or a climb showed it, and may in minutes
again, and who takes over from a killed process under denial would begin after two seconds.
"""

from __future__ import annotations

import enum
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mavlink_bridge.injection.gate_memory import RestartMemory

PREFIX = "PiLoT: "
_LARGEST = 1e4  # per cent, degrees, milliseconds; of what is kept
_LONGEST = 10  # characters of a word that is


class Action(enum.IntEnum):
    """What a finding does to the fixes, mildest first.

    WITHDRAW is WITHHOLD with a reset announced on the return: the EKF holds what was wrong.
    """

    NONE = 0
    WITHHOLD = 1
    WITHDRAW = 2


@dataclass(frozen=True)
class Rule:
    """One line of the table in docs/explanation/integrity.md.

    text: for the operator, with one figure {0:.0f} and a word {1}. alert_s: how long the evidence
    must last; release_s: how long it must be over. repeat_s: told again as long as it lasts; 0:
    once. forbids: while it stands, injection and a switch to vision do not begin.
    """

    name: str
    text: str
    action: Action
    alert_s: float
    release_s: float
    repeat_s: float = 0.0
    forbids: bool = False

    @property
    def _template(self) -> str:
        withheld = "withheld: " if self.action is not Action.NONE else ""
        return f"{PREFIX}{withheld}{self.text}"

    def line(self, figure: float, word: str = "") -> str:
        """The STATUSTEXT."""
        return self._template.format(figure, word)

    def is_line(self, text: str) -> bool:
        """Whether a STATUSTEXT is this rule's, whatever its figure and word."""
        fixed = re.split(r"\{[^}]*\}", self._template)
        return re.fullmatch(".+".join(re.escape(part) for part in fixed), text) is not None


VIDEO_FROZEN = Rule("video_frozen", "video frozen {0:.0f} s", Action.WITHDRAW, 0.0, 2.0)
VIDEO_REPEATS = Rule("video_repeats", "video repeats, {0:.0f} s old", Action.WITHDRAW, 0.0, 5.0)
MOTION = Rule("motion", "motion is not the IMU's ({0:.0f} m)", Action.WITHDRAW, 0.2, 5.0)
HEIGHT = Rule("height", "height {0:.0f} m off barometer", Action.WITHDRAW, 2.0, 5.0)
JUMP = Rule("jump", "position jumped {0:.0f} m", Action.WITHDRAW, 0.0, 0.0)
STEP = Rule("step", "position stepped {0:.0f} m, unexplained", Action.NONE, 0.0, 0.0, 60.0)
TILT = Rule("tilt", "tilt {0:.0f} deg off the autopilot's", Action.NONE, 1.0, 3.0, 60.0)
GNSS = Rule("gnss", "GNSS {0:.0f} m from vision: neither proven", Action.NONE, 2.0, 5.0, 10.0)
EKF_REFUSES = Rule("ekf_refuses", "EKF refuses vision ({0:.1f})", Action.NONE, 2.0, 3.0, 10.0)
EKF_JUMPED = Rule("ekf_jumped", "EKF jumped {0:.0f} m: unconfirmed", Action.NONE, 0.0, 0.0)
CLOCK = Rule("clock", "video clock ran back or stands", Action.WITHHOLD, 0.5, 3.0)
LIMIT = Rule("limit", "position only to {0:.0f} m", Action.WITHHOLD, 1.0, 3.0)
FOCAL = Rule(
    "focal_length", "focal length looks {0:.1f} % {1}", Action.NONE, 2.0, 10.0, 60.0, forbids=True
)
BORESIGHT = Rule(
    "boresight", "camera {0:.0f} deg off in {1}", Action.NONE, 3.0, 10.0, 60.0,
    forbids=True,
)  # fmt: skip
TIME_OFFSET = Rule(
    "time_offset", "pictures stamped {0:.0f} ms {1}", Action.NONE, 1.0, 10.0, 60.0, forbids=True
)
FAILED = Rule("guardian_failed", "guardian failed", Action.WITHHOLD, 0.0, 3.0, 10.0)
UNJUDGED = Rule("judges", "fixes cannot be judged", Action.WITHHOLD, 0.0, 3.0, 10.0)
STANDS = Rule("part_stands", "{1} stands {0:.0f} s", Action.NONE, 0.0, 3.0, 10.0)
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
class Reading:
    """A detector's answer. bad: None where there is no evidence, which changes nothing."""

    bad: bool | None
    figure: float = 0.0
    word: str = ""


class Latch:
    """A rule over time: raised after alert_s of bad evidence, released after release_s of good.

    Time without evidence counts for neither, and nothing is told again in it: a receiver that is
    gone is no metres from vision.
    """

    def __init__(self, rule: Rule) -> None:
        self.rule = rule
        self.raised = False
        self.figure = 0.0
        self.word = ""
        self._since_ns: int | None = None
        self._updated_ns = 0
        self._told_ns = 0

    def update(self, now_ns: int, reading: Reading) -> str | None:
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
        wait_s = self.rule.release_s if self.raised else self.rule.alert_s
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


Found = Mapping[str, tuple[float, str]]
"""Findings by the names of their rules: figure and word."""

_FORBID = frozenset(rule.name for rule in RULES if rule.forbids)


class ForbidMemory:
    """Of the findings that stand and forbid; see `RestartMemory`."""

    def __init__(self, memory: RestartMemory) -> None:
        self._memory = memory
        self._kept: frozenset[str] = frozenset()

    def recall(self) -> Found:
        """What stood in the process before; empty for nothing."""
        kept = self._memory.recall()
        told = None if kept is None else kept[0].get("forbids")
        rows = told.items() if isinstance(told, dict) else ()
        found = {name: row for name, told in rows if (row := _row(told)) and name in _FORBID}
        self.note(found)
        return found

    def note(self, found: Found) -> None:
        """What stands now."""
        if found.keys() == self._kept:
            return
        self._kept = frozenset(found)
        if found:
            self._memory.keep({"forbids": dict(found)})
        else:
            self._memory.drop()

    def stop(self, *, in_order: bool = True) -> None:
        """The end; see `RestartMemory.stop`."""
        self._memory.stop(in_order=in_order)


def _row(told: Any) -> tuple[float, str] | None:
    if not isinstance(told, list) or len(told) != 2:
        return None
    figure, word = told
    if not isinstance(figure, float) or not abs(figure) <= _LARGEST:
        return None
    known = isinstance(word, str) and len(word) <= _LONGEST and word.isprintable()
    return (figure, word) if known else None
