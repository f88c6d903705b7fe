"""Expectations of a scenario, checked against the flight's record."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from mavlink_bridge.alerts.catalogue import CATALOGUE
from mavlink_bridge.alerts.ids import AlertId
from sitl.suite.record import CaseRecord, Text

FOREVER = math.inf


@dataclass(frozen=True)
class ExpectationResult:
    """Result of an expectation. what: the measured value; better: below the reference range."""

    ok: bool
    what: str
    better: bool = False


class _Expectation(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    @abstractmethod
    def evaluate(self, record: CaseRecord) -> ExpectationResult:
        """Compare the flight's record with the expectation."""


class _Span(_Expectation):
    from_s: float = 0.0
    to_s: float = FOREVER


class AccuracyExpectation(_Span):
    """The median of the horizontal EKF error exceeds the reference `median` (m) by at most
    within_percent.

    An error that is smaller by more than within_percent passes and is marked `better`. p95 and max:
    reference values (m), shown in the report only.
    """

    check: Literal["reference"]
    median: float = Field(gt=0)
    p95: float | None = None
    max: float | None = None
    within_percent: float = Field(25.0, gt=0)

    def evaluate(self, record: CaseRecord) -> ExpectationResult:
        errors = record.horizontal(self.from_s, self.to_s)
        if len(errors) < 100:
            return ExpectationResult(False, f"only {len(errors)} EKF positions")
        median = float(np.median(errors))
        change = 100.0 * (median / self.median - 1.0)
        what = f"median {median:.2f} m, {change:+.0f} % of {self.median:.2f}"
        return ExpectationResult(change <= self.within_percent, what, change < -self.within_percent)


class MedianExpectation(_Span):
    """The median of the horizontal EKF error stays at or below a limit."""

    check: Literal["median_below"]
    metres: float

    def evaluate(self, record: CaseRecord) -> ExpectationResult:
        errors = record.horizontal(self.from_s, self.to_s)
        if not len(errors):
            return ExpectationResult(False, "no EKF positions")
        median = float(np.median(errors))
        return ExpectationResult(median <= self.metres, f"median {median:.2f} of {self.metres:g} m")


class MaxErrorExpectation(_Span):
    """The largest horizontal EKF error lies between two limits."""

    check: Literal["max_error"]
    at_least: float = 0.0
    at_most: float = FOREVER

    def evaluate(self, record: CaseRecord) -> ExpectationResult:
        errors = record.horizontal(self.from_s, self.to_s)
        if not len(errors):
            return ExpectationResult(False, "no EKF positions")
        largest = float(errors.max())
        what = f"max {largest:.2f} m, wanted {self.at_least:g} to {self.at_most:g}"
        return ExpectationResult(self.at_least <= largest <= self.at_most, what)


class JumpExpectation(_Expectation):
    """After the jump at at_s the EKF's north error reaches north_m within settled_s, stays for 2 s,
    and never overshoots by more than overshoot_m.
    """

    check: Literal["jump"]
    at_s: float
    north_m: float
    settled_s: float
    tolerance_m: float = 1.0
    overshoot_m: float = 2.0

    def evaluate(self, record: CaseRecord) -> ExpectationResult:
        begin = self.at_s + self.settled_s
        there = record.north(begin, begin + 2.0)
        whole = record.north(self.at_s, begin + 2.0)
        if len(there) < 10:
            return ExpectationResult(False, "no EKF positions after the jump")
        median = float(np.median(there))
        beyond = float(np.max((whole - self.north_m) * math.copysign(1.0, self.north_m)))
        ok = abs(median - self.north_m) <= self.tolerance_m and beyond <= self.overshoot_m
        what = f"{median:.1f} m {self.settled_s:g} s after a jump of {self.north_m:g} m"
        return ExpectationResult(ok, f"{what}, overshoot {beyond:.1f}")


class RefusedJumpExpectation(_Expectation):
    """An unannounced jump is refused for a while: the north error stays below half of north_m until
    after_s and has passed it by before_s (seconds after at_s).
    """

    check: Literal["jump_refused"]
    at_s: float
    north_m: float
    after_s: float
    before_s: float

    def evaluate(self, record: CaseRecord) -> ExpectationResult:
        taken = [
            t - self.at_s
            for t, north, _ in record.errors
            if t >= self.at_s and abs(north) > abs(self.north_m) / 2
        ]
        wanted = f"wanted {self.after_s:g} to {self.before_s:g} s"
        if not taken:
            return ExpectationResult(math.isinf(self.before_s), "jump never taken")
        return ExpectationResult(
            self.after_s <= taken[0] <= self.before_s,
            f"jump taken after {taken[0]:.1f} s, {wanted}",
        )


class TextExpectation(_Span):
    """The vehicle sent a STATUSTEXT with `contains` in the span (with `absent`: sent none)."""

    check: Literal["text"]
    contains: str
    absent: bool = False

    def evaluate(self, record: CaseRecord) -> ExpectationResult:
        times = [
            t.at_s
            for t in record.texts
            if not t.is_ours and self.contains in t.text and self.from_s <= t.at_s <= self.to_s
        ]
        said = f"{times[0]:.1f} s" if times else "never"
        return ExpectationResult(bool(times) != self.absent, f"vehicle: '{self.contains}' {said}")


class AlertExpectation(_Span):
    """The bridge raised this alert in the span (with `absent`: did not). values: the alert's text
    must show these.
    """

    check: Literal["alert"] = "alert"
    alert: AlertId
    values: dict[str, str] = {}
    absent: bool = False

    def evaluate(self, record: CaseRecord) -> ExpectationResult:
        return self.evaluate_texts(record.texts)

    def evaluate_texts(self, texts: Iterable[Text]) -> ExpectationResult:
        """Compare the texts of a flight with the expectation."""
        times = [
            t.at_s for t in texts
            if t.raised is not None and t.raised[0] is self.alert
            and self.values.items() <= t.raised[1].items()
            and self.from_s <= t.at_s <= self.to_s
        ]  # fmt: skip
        said = f"{times[0]:.1f} s" if times else "never"
        return ExpectationResult(bool(times) != self.absent, f"bridge: {self.alert.words} {said}")


class ErrorAlertExpectation(_Span):
    """The bridge raises an alert that holds output at most within_s after the horizontal EKF error
    first exceeds limit_m. A flight whose error stays below limit_m passes.
    """

    check: Literal["alerted"]
    limit_m: float = Field(gt=0)
    within_s: float = Field(ge=0)

    def evaluate(self, record: CaseRecord) -> ExpectationResult:
        beyond = [
            t
            for t, north, east in record.errors
            if self.from_s <= t <= self.to_s and math.hypot(north, east) > self.limit_m
        ]
        told = [
            t.at_s
            for t in record.texts
            if t.raised is not None and CATALOGUE[t.raised[0]].action and t.at_s >= self.from_s
        ]
        said = f"reported at {told[0]:.1f} s" if told else "never reported"
        if not beyond:
            return ExpectationResult(True, f"never beyond {self.limit_m:g} m; {said}")
        ok = bool(told) and told[0] <= beyond[0] + self.within_s
        return ExpectationResult(ok, f"beyond {self.limit_m:g} m at {beyond[0]:.1f} s, {said}")


class NoWarningExpectation(_Span):
    """No STATUSTEXT of the vehicle within the span contains any of the words."""

    check: Literal["no_warning"]
    words: tuple[str, ...] = ("EKF variance", "Failsafe", "rror", "ailed", "litch", "nhealthy")

    def evaluate(self, record: CaseRecord) -> ExpectationResult:
        heard = [
            t.text
            for t in record.texts
            if not t.is_ours
            and self.from_s <= t.at_s <= self.to_s
            and any(word in t.text for word in self.words)
        ]
        return ExpectationResult(not heard, "; ".join(heard[:3]) or "vehicle: no warning")


class ModeExpectation(_Expectation):
    """The vehicle is in flight mode `mode` at at_s; None: at the end of the flight."""

    check: Literal["mode"]
    mode: str
    at_s: float | None = None

    def evaluate(self, record: CaseRecord) -> ExpectationResult:
        sample = record.at(FOREVER if self.at_s is None else self.at_s)
        mode = sample.mode if sample else "none"
        when = "at the end" if self.at_s is None else f"at {self.at_s:g} s"
        return ExpectationResult(mode == self.mode, f"{mode} {when}")


class MovementExpectation(_Span):
    """In the span, the true position stays within at_most (m) of its place at from_s."""

    check: Literal["moved"]
    at_most: float

    def evaluate(self, record: CaseRecord) -> ExpectationResult:
        inside = [s for s in record.samples if self.from_s <= s.at_s <= self.to_s]
        if not inside:
            return ExpectationResult(False, "no samples")
        a = inside[0]
        far = max(math.hypot(s.north_m - a.north_m, s.east_m - a.east_m) for s in inside)
        return ExpectationResult(far <= self.at_most, f"moved {far:.2f} of {self.at_most:g} m")


class InjectionExpectation(_Span):
    """Number of messages that the bridge injected within the span.

    at_least is reduced in proportion if the vehicle's clock ran slower than real time, because
    fewer fixes were due.
    """

    check: Literal["injected"]
    at_least: int = 0
    at_most: float = FOREVER

    def evaluate(self, record: CaseRecord) -> ExpectationResult:
        inside = [s for s in record.samples if self.from_s <= s.at_s <= self.to_s]
        if not inside:
            return ExpectationResult(False, "no samples")
        # A counter that falls has started anew with the bridge; ours lives as long as the case.
        first, last = inside[0], inside[-1]
        sent, due_s = last.injected - first.injected, last.at_s - first.at_s
        lived_s = last.vehicle_s - first.vehicle_s  # negative after a reboot
        share = min(lived_s / due_s, 1.0) if lived_s > 0 and due_s > 0 else 1.0
        ok = share * self.at_least <= sent <= self.at_most
        what = f"{sent} injected"
        return ExpectationResult(
            ok, what if share > 0.99 else f"{what} at {share:.2f} of real time"
        )


class SourceSetExpectation(_Expectation):
    """The bridge first considers EKF source set `number` active between from_s and by_s."""

    check: Literal["source_set"]
    number: int
    from_s: float
    by_s: float

    def evaluate(self, record: CaseRecord) -> ExpectationResult:
        reached = [
            s.at_s for s in record.samples if s.at_s >= self.from_s and s.source_set == self.number
        ]
        if not reached:
            return ExpectationResult(False, f"never on source set {self.number}")
        ok = self.from_s < reached[0] <= self.by_s
        return ExpectationResult(ok, f"source set {self.number} at {reached[0]:.1f} s")


class ArmingRefusedExpectation(_Expectation):
    """On the ground: the vehicle refuses to arm, and its texts contain one of any_of."""

    check: Literal["arming_refused"]
    any_of: tuple[str, ...]

    def evaluate(self, record: CaseRecord) -> ExpectationResult:
        if record.refusals is None:
            return ExpectationResult(False, "arming was accepted")
        told = "; ".join(record.refusals) or "without a text"
        return ExpectationResult(any(text in told for text in self.any_of), f"refused: {told}")


class DoctorExpectation(_Expectation):
    """`companion doctor` finds exactly these parameters wrong, and nothing after its --fix."""

    check: Literal["doctor"]
    finds: tuple[str, ...]

    def evaluate(self, record: CaseRecord) -> ExpectationResult:
        d = record.doctor
        if d is None:
            return ExpectationResult(False, "the doctor was not asked")
        ok = set(d.found) == set(self.finds) and d.exit_before == 2 and d.exit_after == 0
        what = f"found {', '.join(d.found)}; exit {d.exit_before} before, {d.exit_after} after"
        if d.left:
            what += f" ({', '.join(d.left)})"
        return ExpectationResult(ok, what)


Check = (
    AccuracyExpectation
    | MedianExpectation
    | MaxErrorExpectation
    | JumpExpectation
    | RefusedJumpExpectation
    | TextExpectation
    | AlertExpectation
    | ErrorAlertExpectation
    | NoWarningExpectation
    | ModeExpectation
    | MovementExpectation
    | InjectionExpectation
    | SourceSetExpectation
    | ArmingRefusedExpectation
    | DoctorExpectation
)
