"""What came of a flight: pure functions over its samples, held against what was expected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sitl.suite.loop.case import Expectation

_STALE_S = 2.0  # a health report older than this is none: the process is gone, and its heartbeat


@dataclass(frozen=True)
class LoopSample:
    """A moment of the recorded part, seconds since it began.

    error_m: the EKF's horizontal error. level, health: the companion's health; age_s: of that
    report. mode: the autopilot's.
    """

    at_s: float
    error_m: float
    north_m: float
    east_m: float
    mode: str
    level: str
    health: str
    age_s: float

    @property
    def is_told(self) -> bool:
        """Whether the operator can see that something is wrong."""
        return self.level != "ok" or self.age_s > _STALE_S


@dataclass(frozen=True)
class LoopText:
    """A status text and the MAVLink component that it came from."""

    at_s: float
    component: int
    severity: int
    text: str


@dataclass(frozen=True)
class LoopRecord:
    """What a flight left. fix_errors_m: horizontal, of every position that was injected."""

    samples: tuple[LoopSample, ...]
    texts: tuple[LoopText, ...]
    fix_errors_m: tuple[float, ...]


@dataclass(frozen=True)
class Held:
    """One expectation: what it is, whether it holds, and what was seen."""

    what: str
    ok: bool
    seen: str


def untold_s(samples: Sequence[LoopSample], beyond_m: float) -> float:
    """The longest time that an error beyond `beyond_m` stood without being told, seconds."""
    longest, begun = 0.0, None
    for sample in samples:
        if sample.error_m <= beyond_m or sample.is_told:
            begun = None
            continue
        begun = sample.at_s if begun is None else begun
        longest = max(longest, sample.at_s - begun)
    return longest


def judge(record: LoopRecord, expect: Expectation) -> tuple[Held, ...]:
    """Every expectation, held against the record."""
    samples, errors = record.samples, [s.error_m for s in record.samples]
    longest = untold_s(samples, expect.beyond_m)
    worst = max(errors, default=float("nan"))
    held = [
        Held(
            f"beyond {expect.beyond_m:g} m told within {expect.told_within_s:g} s",
            bool(samples) and longest <= expect.told_within_s,
            f"untold for {longest:.1f} s at most; error up to {worst:.1f} m",
        )
    ]
    for mode in expect.never_modes:
        seen = [s.at_s for s in samples if s.mode == mode]
        held.append(Held(f"never {mode}", not seen, f"from {seen[0]:.0f} s" if seen else "never"))
    if expect.max_error_m is not None:
        ok = worst <= expect.max_error_m
        held.append(Held(f"EKF within {expect.max_error_m:g} m", ok, f"{worst:.1f} m"))
    if expect.false_fixes is not None:
        false = int(np.sum(np.asarray(record.fix_errors_m) > 5.0))
        sent = len(record.fix_errors_m)
        ok = false <= expect.false_fixes and sent > 0
        held.append(Held("false fixes injected", ok, f"{false} of {sent}"))
    if expect.ends_tracking:
        last = samples[-1] if samples else None
        ok = last is not None and last.level == "ok" and not last.age_s > _STALE_S
        held.append(Held("tracks at the end", ok, last.health if last else "no samples"))
    held += [_said(record.texts, part) for part in expect.says]
    if expect.silent:
        told = [t.text for t in record.texts if t.component != 1 and t.severity <= 4]
        held.append(Held("no warning", not told, "; ".join(told) or "none"))
    return tuple(held)


def _said(texts: Sequence[LoopText], part: str) -> Held:
    found = [t for t in texts if t.component != 1 and part in t.text]
    return Held(f"says {part!r}", bool(found), f"at {found[0].at_s:.1f} s" if found else "never")
