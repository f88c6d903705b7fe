"""What is judged of a flight with the whole companion in the loop, and that its files hold."""

from __future__ import annotations

import json
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from mavlink_bridge.alerts.catalogue import alert, text
from mavlink_bridge.alerts.catalogue import cleared as cleared_alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import Output
from sitl.__main__ import app
from sitl.demo.companion_process import FlightCompanion
from sitl.demo.scenario import ScenarioError
from sitl.errors import FlightError, SimulationError
from sitl.suite.checks import AlertExpectation
from sitl.suite.loop import runner
from sitl.suite.loop.case import Expectation, LoopCase, load_loop_cases
from sitl.suite.loop.evaluation import (
    LoopExpectationResult,
    LoopRecord,
    LoopRow,
    LoopSample,
    RestartTimes,
    as_data,
    evaluate,
    false_alarm_rate,
    false_alarms,
    figures,
    longest_unreported_s,
    markdown,
    read_rows,
    standing_alerts,
)
from sitl.suite.loop.runner import RunOptions, fly_loop, parse_seeds
from sitl.suite.record import Text

GOOD = LoopSample(0.0, 0.3, 0.0, 0.0, "AUTO", "ok", "localization tracking", 0.5)


def flight(errors_m: list[float], level: str = "ok", age_s: float = 0.5) -> tuple[LoopSample, ...]:
    """A sample every half second."""
    return tuple(
        replace(GOOD, at_s=0.5 * n, error_m=error, level=level, age_s=age_s)
        for n, error in enumerate(errors_m)
    )


def test_an_error_with_every_light_green_is_untold() -> None:
    assert longest_unreported_s(flight([0.5] * 4 + [20.0] * 11), 10.0) == pytest.approx(5.0)


@pytest.mark.parametrize("told", [{"level": "failed"}, {"age_s": 5.0}, {"findings": ("gnss",)}])
def test_a_bad_health_a_finding_or_a_silent_companion_tells_it(told: dict[str, Any]) -> None:
    assert longest_unreported_s(tuple(replace(s, **told) for s in flight([20.0] * 11)), 10.0) == 0.0


FROZEN = text(alert(AlertId.VIDEO_FROZEN, seconds=5.0))


def overloaded(hertz: float) -> str:
    return text(alert(AlertId.OVERLOADED, done=hertz, offered=8.0))


def record(samples: tuple[LoopSample, ...], errors: tuple[float, ...] = (0.2,)) -> LoopRecord:
    return LoopRecord(samples, (Text(1.0, 191, 4, FROZEN),), errors)


def test_every_expectation_can_fail() -> None:
    expect = Expectation(
        never_modes=("LAND",),
        max_error_m=3.0,
        ends_tracking=True,
        reports=(AlertId.VIDEO_FROZEN,),
        silent=True,
    )
    good = {h.what: h.ok for h in evaluate(record(flight([0.5] * 4)), expect)}
    assert [what for what, ok in good.items() if not ok] == ["no warning"]
    landed = tuple(replace(s, mode="LAND", level="failed") for s in flight([9.0] * 4))
    bad = evaluate(record(landed, errors=(0.2, 7.0)), replace_says(expect))
    assert [h.ok for h in bad] == [True, False, False, False, False, False, False]
    assert not evaluate(record((), errors=()), Expectation())[0].ok


@pytest.mark.parametrize(("cleared", "ok"), [(False, True), (True, False)])
def test_an_alert_raised_before_the_recorded_part_counts_while_it_stands(
    cleared: bool, ok: bool
) -> None:
    """As map-shifted-interlock: the alert is sent seconds before GNSS is switched off."""
    frozen = alert(AlertId.VIDEO_FROZEN, seconds=5.0)
    before = (
        Text(-3.0, 191, 4, text(frozen)),
        Text(-2.0, 191, 6, text(cleared_alert(AlertId.VIDEO_FROZEN))),
    )
    standing = standing_alerts(before if cleared else before[:1])
    flown = replace(record(flight([0.5] * 4)), texts=(), standing=standing)
    expect = Expectation(reports=(AlertId.VIDEO_FROZEN,))
    held = evaluate(flown, expect)[-1]
    assert (held.ok, held.seen) == (ok, "at -3.0 s" if ok else "never")
    only_end = replace(flown, standing=(), texts=(replace(before[1], at_s=1.0),))
    assert not evaluate(only_end, expect)[-1].ok


@pytest.mark.parametrize(("injects_s", "ok"), [(4.9, True), (5.1, False), (float("inf"), False)])
def test_who_is_back_too_late_or_never_is_missed(injects_s: float, ok: bool) -> None:
    expect = Expectation(back_within_s=5.0)
    flown = replace(record(flight([0.5] * 4)), back=RestartTimes(1.0, 2.0, injects_s))
    assert evaluate(flown, expect)[-1].ok is ok
    assert not evaluate(record(flight([0.5] * 4)), expect)[-1].ok


@pytest.mark.parametrize(("degraded_s", "ok"), [(9.0, True), (4.0, False)])
def test_the_warning_must_come_before_what_it_warns_of(degraded_s: float, ok: bool) -> None:
    dim, lost = alert(AlertId.LOW_CONTRAST, gray=1.8), alert(AlertId.LOST, seconds=1.0)
    texts = (Text(degraded_s, 191, 3, text(lost)), Text(5.0, 191, 4, text(dim)))
    expect = Expectation(warns_first=AlertId.LOW_CONTRAST)
    assert evaluate(LoopRecord(flight([0.5] * 4), texts, (0.2,)), expect)[-1].ok is ok
    assert not evaluate(record(flight([0.5] * 4)), expect)[-1].ok


def replace_says(expect: Expectation) -> Expectation:
    return expect.model_copy(update={"reports": (AlertId.BORESIGHT,)})


def test_texts_that_cycle_are_counted_figures_aside() -> None:
    """As on an overloaded machine: the same four texts, 42 times (an attack's flight)."""
    texts = tuple(
        Text(float(at_s), component, 4, overloaded(float(at_s)))
        for at_s, component in ((1, 191), (3, 191), (4, 1), (5, 191))
    )
    cycling = LoopRecord(flight([0.5] * 4), texts, (0.2,))
    held = {h.what: h for h in evaluate(cycling, Expectation(repeats=2))}
    assert not held["reports nothing more than 2 times"].ok
    assert held["reports nothing more than 2 times"].seen == "3 times overloaded"
    assert all(h.ok for h in evaluate(cycling, Expectation(repeats=3)))


def test_whatever_is_told_of_a_good_flight_is_a_false_alarm() -> None:
    quiet = LoopRecord(flight([0.5] * 4), (Text(1.0, 1, 3, "EKF3 IMU0 yaw"),), (0.2,))
    assert false_alarms(quiet) == ()
    lost = replace(
        quiet, texts=(Text(1.5, 191, 4, text(alert(AlertId.GNSS_LOST, output=Output.INJECTING))),)
    )
    assert false_alarms(lost, denied=True) == ()
    assert len(false_alarms(lost)) == 1
    degraded = (*flight([0.5] * 4), replace(GOOD, at_s=2.0, level="degraded"))
    assert false_alarms(replace(quiet, samples=degraded)) == (
        "2.0 s: health degraded: localization tracking",
    )
    found = tuple(replace(s, findings=("motion",)) for s in flight([0.5] * 4))
    assert len(false_alarms(replace(quiet, samples=found))) == 1  # told once, not at every sample
    assert false_alarms(record(flight([0.5] * 4))) == (f"1.0 s: {FROZEN}",)


def row(alarms: tuple[str, ...] | None) -> LoopRow:
    one = record(flight([0.5] * 41))
    return LoopRow("normal", "embedded", 5, (), figures(one, 10.0), alarms)


def test_the_rate_of_false_alarms_has_its_exact_interval() -> None:
    """Against the tables of Clopper and Pearson: 0 of 20, and 1 of 20."""
    quiet = false_alarm_rate([row(())] * 20 + [row(None)])
    assert (quiet.flights, quiet.with_alarm) == (20, 0)
    assert [quiet.low, quiet.high] == pytest.approx([0.0, 0.1684], abs=1e-4)
    assert quiet.hours == pytest.approx(20 * 20 / 3600)
    loud = false_alarm_rate([row(())] * 19 + [row((f"1.0 s: {FROZEN}",))])
    assert [loud.low, loud.high] == pytest.approx([0.0013, 0.2487], abs=1e-4)
    assert false_alarm_rate([row(None)]) is None


def test_what_was_missed_stands_first_and_the_json_is_strict() -> None:
    missed = replace(
        row(()), name="z", held=(LoopExpectationResult("told", False, "untold for 9 s"),)
    )
    lost = LoopRow("a", "ardupilot", 1, (), error="FlightError: no arducopter")
    lines = markdown([row(()), missed, lost]).splitlines()
    assert lines[2].startswith("| a | ardupilot, 1 |")
    assert "NOT FLOWN: FlightError" in lines[2]
    assert lines[3].startswith("| z | ")
    assert "MISSED told: untold for 9 s" in lines[3]
    unknown = LoopRecord(flight([float("inf")] * 3), (), ())
    bad = LoopRow("b", "embedded", 1, (), figures(unknown, 10.0))
    assert json.loads(json.dumps(as_data([bad]), allow_nan=False))["flights"][0]["ok"]


def test_the_flights_of_several_runs_make_one_table(tmp_path: Path) -> None:
    rows = [
        row(("1.0 s: x",)),
        replace(row(None), held=(LoopExpectationResult("told", False, "no"),)),
    ]
    rows.append(LoopRow("b", "ardupilot", 1, (), figures(LoopRecord((), (), ()), 10.0)))
    path = tmp_path / "loop.json"
    path.write_text(json.dumps(as_data(rows), allow_nan=False), encoding="utf-8")
    assert markdown(read_rows(path)) == markdown(rows)
    for damaged in ("[]", '{"flights": [5]}', "[" * 100_000):
        path.write_text(damaged, encoding="utf-8")
        with pytest.raises(ScenarioError, match=r"not a loop\.json"):
            read_rows(path)


@pytest.fixture
def flown(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Flights by name and seed, which are not flown: seed 2 is 50 m off, seed 3 cannot be flown."""
    made: list[tuple[str, int]] = []

    def fly(case: LoopCase, _assets: Any, _kind: str, seed: int, out: Path) -> LoopRecord:
        made.append((case.name, seed))
        out.mkdir(parents=True)
        if seed == 3:
            raise SimulationError("no arducopter")
        return record(flight([50.0 if seed == 2 else 0.5] * 40))

    monkeypatch.setattr(runner, "fly", fly)
    monkeypatch.setattr(runner, "loop_assets", lambda *_: None)
    return made


def test_a_resumed_run_flies_what_is_missing_and_what_was_not_flown(
    tmp_path: Path, flown: list[tuple[str, int]]
) -> None:
    cases = load_loop_cases(["killed", "frozen-hover"])

    def run(seeds: tuple[int, ...], *, resume: bool = True) -> list[int]:
        options = RunOptions(("embedded",), tmp_path, seeds, resume=resume)
        flown.clear()
        fly_loop(cases, options, lambda _row: None)
        return [seed for _, seed in flown]

    assert run((1,)) == [1, 1]
    assert [name for name, _ in flown] == ["killed", "frozen-hover"]
    assert run((1, 2)) == [2, 2]
    assert run((1, 2)) == []
    assert run((3,)) == run((3,)) == [3, 3]  # it was not flown
    kept = [(row.name, row.seed, not row.error) for row in read_rows(tmp_path / "loop.json")]
    wanted = [(case.name, seed, seed < 3) for case in cases for seed in (1, 2, 3)]
    assert sorted(kept) == sorted(wanted)
    assert run((1,), resume=False) == [1, 1]


def test_the_exit_code_is_that_of_the_flights_asked_for_whether_flown_now_or_before(
    tmp_path: Path, flown: list[tuple[str, int]]
) -> None:
    def code(seeds: str, *options: str) -> int:
        flown.clear()
        command = ["loop", "--only", "frozen-hover", "--seeds", seeds, "--out", str(tmp_path)]
        return CliRunner().invoke(app, [*command, *options]).exit_code

    for seeds, options, expected, now in (
        ("1..2", (), 1, [1, 2]),
        ("1..2", ("--resume",), 1, []),
        ("2", ("--resume",), 1, []),
        ("1", ("--resume",), 0, []),
        ("3", ("--resume",), 1, [3]),
        ("1", ("--resume",), 0, []),
    ):
        assert (code(seeds, *options), [seed for _, seed in flown]) == (expected, now)


def test_alerts_are_judged_by_their_time_and_listed() -> None:
    back = AlertExpectation(alert=AlertId.VIDEO_FROZEN, from_s=0.5, to_s=1.5)
    late, absent = (
        back.model_copy(update={"from_s": 1.1}),
        back.model_copy(update={"absent": True}),
    )
    held = evaluate(record(flight([0.5] * 4)), Expectation(alerts=(back, late, absent)))[-3:]
    assert [(h.ok, h.listed) for h in held] == [(True, True), (False, True), (False, False)]
    table = markdown([replace(row(None), held=held[:1])])
    assert "| all; bridge: video frozen 1.0 s |" in table


@pytest.mark.parametrize(("text", "seeds"), [("5", (5,)), ("1..3", (1, 2, 3))])
def test_seeds_are_one_or_a_range(text: str, seeds: tuple[int, ...]) -> None:
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize("text", ["", "1..", "3..1", "-1", "1...3", "a", "1..999999", "9" * 5000])
def test_other_seeds_are_refused(text: str) -> None:
    with pytest.raises(ScenarioError, match="seeds"):
        parse_seeds(text)


def test_the_shipped_flights_hold_together(tmp_path: Path) -> None:
    cases = {case.name: case for case in load_loop_cases()}
    assert {"normal-60s", "frozen-hover", "covered-30s", "killed", "other-map"} <= set(cases)
    flown_always = {name for name, case in cases.items() if case.ci}
    assert flown_always == {"frozen-hover", "killed-gated", "other-map"}
    normal = load_loop_cases(["normal"])
    assert len(normal) >= 6
    assert all(case.name.startswith("normal") for case in normal)
    assert all(case.expect.silent for case in normal)
    with pytest.raises(ScenarioError, match="holds no scenario files"):
        load_loop_cases(folder=tmp_path / "nowhere")
    with pytest.raises(ScenarioError, match="no scenario nowhere"):
        load_loop_cases(["nowhere"])


@pytest.mark.parametrize("signal", ["kill", "hang"])
def test_no_signal_is_sent_before_the_flight_process_has_reported(tmp_path, signal):
    """Without a report its number is 0, and signals to 0 end the caller and its siblings."""
    with ExitStack() as stack:
        companion = FlightCompanion(tmp_path / "companion.yaml", tmp_path, stack, supervised=True)
        with pytest.raises(FlightError, match="no health report"):
            getattr(companion, signal)()
