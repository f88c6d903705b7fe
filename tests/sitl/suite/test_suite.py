"""Scenario files, expectations, and the suite's report, without a flight."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter
from typer.testing import CliRunner

from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.catalogue import text as statustext
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import Output
from sitl import __main__ as cli
from sitl.demo.scenario import ScenarioError
from sitl.suite.case import SCENARIOS, Case, load_case, load_cases
from sitl.suite.checks import Check
from sitl.suite.flight import bridge_config, longest_stall, slowest_pace
from sitl.suite.record import CaseRecord, Doctor, Text, VehicleSample
from sitl.suite.runner import ReportRow, evaluate, markdown, summary, write_report

SHIPPED = load_cases()


def expectation(**fields: Any) -> Any:
    return TypeAdapter(Check).validate_python(fields)


def record(error: float = 0.2, seconds: float = 20.0) -> CaseRecord:
    """Errors to the north at 25 Hz, hovering in GUIDED on source set 1."""
    times = [i / 25 for i in range(int(25 * seconds))]
    samples = [
        VehicleSample(i / 10, 0.0, 0.0, "GUIDED", True, i, 1, i / 10)
        for i in range(int(10 * seconds))
    ]
    errors = [(t, error, 0.0) for t in times]
    return CaseRecord(errors=errors, samples=samples)


# --- files ----------------------------------------------------------------------------------------


def case_text(**changes: str) -> str:
    lines = {
        "title": "a case",
        "vehicle": "{sources: vision}",
        "bridge": "{injection: {rate_hz: 10}}",
        "expect": "[{check: mode, mode: GUIDED}]",
    } | changes
    return "".join(f"{key}: {value}\n" for key, value in lines.items() if value)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"vehicle": "{sources: magic}"}, "vehicle.sources"),
        ({"fixes": "{rate_hz: -1}"}, "fixes.rate_hz"),
        ({"fixes": "{sigma_m: yes}"}, "fixes.sigma_m: must not be a boolean"),
        ({"bridge": "{injection: {rate_hz: 99}}"}, "rate_hz"),
        ({"expect": "[]"}, "expect"),
        ({"expect": "[{check: horoscope}]"}, "expect.0"),
        ({"timeline": "[{at_s: 3}]"}, "nothing happens"),
        ({"timeline": "[{at_s: 3, reboot: true}, {at_s: 1, reboot: true}]"}, "order of at_s"),
        ({"flight": "{side_m: 0}"}, "needs `seconds`"),
        ({"title": "["}, "not valid YAML"),
        ({"name": "../../elsewhere"}, "named by its file"),
        ({"vehicle": "{sources: vision, parameters: {A: .nan}}"}, "vehicle.parameters.A"),
        ({"flight": "{seconds: 5}", "timeline": "[{at_s: 9, reboot: true}]"}, "flight's end"),
    ],
)
def test_a_bad_file_is_a_named_error(tmp_path: Path, changes: dict[str, str], named: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(case_text(**changes))
    with pytest.raises(ScenarioError) as caught:
        load_case(path, Case)
    assert named in str(caught.value)
    assert "bad.yaml" in str(caught.value)


def test_an_unknown_name_is_told_with_those_that_exist() -> None:
    with pytest.raises(ScenarioError, match=r"no scenario vpee.*latency-250.*vpe"):
        load_cases(["vpee"])


@pytest.mark.parametrize("case", SHIPPED, ids=lambda case: case.name)
def test_shipped_scenarios_hold_for_a_bridge_and_end(case: Case) -> None:
    assert case.title
    last = case.timeline[-1].at_s if case.timeline else 0.0
    assert case.flight.seconds is None or case.flight.seconds > last
    config = bridge_config(case, "tcp:127.0.0.1:5762")
    assert config.mode == "inject"
    assert (config.origin is None) == case.vehicle.receiver


def test_the_shipped_scenarios_cover_the_reference_tables() -> None:
    names = {case.name for case in SHIPPED}
    assert {p.stem for p in SCENARIOS.glob("*.yaml")} == names
    with_figures = [c for c in SHIPPED if any(e.check == "reference" for e in c.expect)]
    assert len(with_figures) >= 10
    assert 3 <= sum(case.ci for case in SHIPPED) <= 8


# --- expectations ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "ok", "better"),
    [(0.2, True, False), (0.249, True, False), (0.251, False, False), (0.14, True, True)],
)
def test_the_median_is_held_against_the_reference(error: float, ok: bool, better: bool) -> None:
    finding = expectation(check="reference", median=0.2).evaluate(record(error))
    assert (finding.ok, finding.better) == (ok, better)


def test_limits_of_error_and_motion_within_a_span() -> None:
    flown = record()
    flown.errors[100] = (4.0, 3.0, 4.0)
    flown.samples[100] = replace(flown.samples[100], north_m=3.0)
    for limit, ok in ((4.9, False), (5.1, True)):
        assert expectation(check="max_error", at_most=limit).evaluate(flown).ok == ok
    assert not expectation(check="max_error", at_least=5.1).evaluate(flown).ok
    assert expectation(check="max_error", from_s=5, at_most=0.3).evaluate(flown).ok
    assert expectation(check="median_below", metres=0.2).evaluate(flown).ok
    assert not expectation(check="median_below", metres=0.19).evaluate(flown).ok
    assert not expectation(check="moved", at_most=2.9).evaluate(flown).ok
    assert expectation(check="moved", from_s=11, at_most=0.1).evaluate(flown).ok
    for check in ("max_error", "moved", "injected"):
        limits = {"at_most": 9.0} if check != "injected" else {}
        assert not expectation(check=check, from_s=99, **limits).evaluate(flown).ok


def jumping(taken_s: float, peak: float) -> CaseRecord:
    flown = record()
    flown.errors = [(t, 0.0 if t < taken_s else 10.0, 0.0) for t, _, _ in flown.errors]
    i = next(i for i, (t, _, _) in enumerate(flown.errors) if t >= taken_s)
    flown.errors[i] = (flown.errors[i][0], peak, 0.0)
    return flown


@pytest.mark.parametrize(
    ("taken_s", "peak", "clean"), [(4.3, 10.5, True), (4.3, 13.0, False), (8.0, 10.5, False)]
)
def test_a_told_jump_must_be_taken_at_once_and_without_overshoot(taken_s, peak, clean):
    jump = expectation(check="jump", at_s=4, north_m=10, settled_s=0.5)
    assert jump.evaluate(jumping(taken_s, peak)).ok == clean


def test_an_untold_jump_must_be_refused_for_a_while_and_then_taken() -> None:
    unreported = expectation(check="jump_refused", at_s=4, north_m=10, after_s=5, before_s=9)
    assert unreported.evaluate(jumping(11.0, 13.0)).ok
    assert not unreported.evaluate(jumping(4.3, 10.0)).ok
    assert not unreported.evaluate(record()).ok


def test_texts_are_looked_for_by_sender_and_time() -> None:
    flown = record()
    flown.texts += [
        Text(5.0, 1, 3, "EKF Failsafe: changed to LAND Mode"),
        Text(6.0, 191, 4, statustext(alert(AlertId.POSITION_JUMP, metres=7.0))),
    ]
    said = {"check": "text", "contains": "LAND"}
    assert expectation(**said).evaluate(flown).ok
    assert not expectation(**said, to_s=4).evaluate(flown).ok
    jump = {"check": "alert", "alert": "position_jump"}
    assert expectation(**jump).evaluate(flown).ok
    assert not expectation(**jump, to_s=4).evaluate(flown).ok
    assert not expectation(check="alert", alert="ekf_follows").evaluate(flown).ok
    assert not expectation(**said, absent=True).evaluate(flown).ok
    assert not expectation(check="no_warning").evaluate(flown).ok
    assert expectation(check="no_warning", from_s=5.5).evaluate(flown).ok


def test_modes_counts_and_source_sets() -> None:
    flown = record()
    flown.samples = [
        replace(s, mode="LAND" if s.at_s > 15 else "GUIDED", source_set=2 if s.at_s > 6 else 1)
        for s in flown.samples
    ]
    assert expectation(check="mode", mode="LAND").evaluate(flown).ok
    assert expectation(check="mode", mode="GUIDED", at_s=10).evaluate(flown).ok
    assert not expectation(check="mode", mode="GUIDED").evaluate(flown).ok
    assert expectation(check="source_set", number=2, from_s=5, by_s=7).evaluate(flown).ok
    assert not expectation(check="source_set", number=2, from_s=5, by_s=6).evaluate(flown).ok
    assert not expectation(check="source_set", number=2, from_s=7, by_s=9).evaluate(flown).ok
    assert not expectation(check="source_set", number=3, from_s=5, by_s=7).evaluate(flown).ok
    assert (
        expectation(check="injected", from_s=2, to_s=4, at_least=20, at_most=20).evaluate(flown).ok
    )
    assert not expectation(check="injected", at_most=0).evaluate(flown).ok


def test_a_vehicle_whose_clock_ran_slow_owes_fewer_messages() -> None:
    wanted = expectation(check="injected", at_least=180)
    slow, idle = record(), record()
    slow.samples = [
        replace(s, injected=int(0.9 * s.injected), vehicle_s=0.9 * s.vehicle_s)
        for s in slow.samples
    ]
    idle.samples = [replace(s, injected=int(0.5 * s.injected)) for s in idle.samples]
    assert wanted.evaluate(record()).ok
    assert wanted.evaluate(slow).ok
    assert "0.90 of real time" in wanted.evaluate(slow).what
    assert not wanted.evaluate(idle).ok
    slow.samples = [replace(s, injected=s.injected // 2) for s in slow.samples]
    assert not wanted.evaluate(slow).ok


def test_arming_and_doctor() -> None:
    flown = record()
    refused = expectation(check="arming_refused", any_of=["not healthy"])
    assert not refused.evaluate(flown).ok
    flown.refusals = ["Arm: VisOdom: not healthy"]
    assert refused.evaluate(flown).ok
    flown.refusals = ["Arm: Fence"]
    assert not refused.evaluate(flown).ok
    diagnosed = expectation(check="doctor", finds=["A", "B"])
    assert not diagnosed.evaluate(flown).ok
    for doctor, ok in (
        (Doctor(("B", "A"), (), 2, 0), True),
        (Doctor(("A",), (), 2, 0), False),
        (Doctor(("A", "B"), ("clock 40 ms",), 2, 1), False),
    ):
        flown.doctor = doctor
        assert diagnosed.evaluate(flown).ok == ok


# --- report ---------------------------------------------------------------------------------------


def row(name: str, flown: CaseRecord | None, error: str = "") -> ReportRow:
    case = next(c for c in SHIPPED if c.name == name)
    return ReportRow(case, "embedded", flown, evaluate(case, flown) if flown else (), error)


def test_the_report_holds_every_flight(tmp_path: Path) -> None:
    flown = record(0.20)
    flown.texts += [
        Text(2.0, 191, 4, statustext(alert(AlertId.POSITION_JUMP, metres=7.0))),
        Text(3.0, 191, 4, statustext(alert(AlertId.GNSS_LOST, output=Output.INJECTING))),
    ]
    rows = [
        row("vpe", flown),
        row("odometry", record(0.20)),
        row("gps-input", record(0.20)),
        row("doctor", None, "PilotError: not armed | or so\nmore"),
    ]
    assert [r.verdict for r in rows] == ["pass", "FAIL", "better", "ERROR"]
    assert summary(rows) == (
        "4 flights: 1 pass, 1 better, 1 FAIL, 1 ERROR; "
        "the monitor raised alerts in 1 of 3 with honest fixes"
    )
    write_report(rows, tmp_path / "out")
    text = (tmp_path / "out/suite.md").read_text()
    assert text == markdown(rows)
    assert "| vpe | embedded | 0.23 / 0.50 / 0.89 | 0.20 / 0.20 / 0.20 |" in text
    assert "NOT: median 0.20 m, +67 % of 0.12" in text
    assert "PilotError: not armed / or so |" in text
    data = json.loads((tmp_path / "out/suite.json").read_text())
    assert [d["verdict"] for d in data] == ["pass", "FAIL", "better", "ERROR"]


@pytest.mark.parametrize(("error", "code"), [(0.2, 0), (0.9, 1)])
def test_the_commands_exit_code_is_for_scripts(tmp_path, monkeypatch, error, code):
    def flown(cases: Any, kinds: Any, *_: Any) -> list[ReportRow]:
        return [
            ReportRow(c, k, record(error), evaluate(c, record(error))) for k in kinds for c in cases
        ]

    monkeypatch.setattr(cli, "run_suite", flown)
    out = str(tmp_path / "out")
    arguments = ["suite", "--only", "vpe", "--fc", "both", "--out", out]
    result = CliRunner().invoke(cli.app, arguments, catch_exceptions=False)
    assert result.exit_code == code
    assert "ardupilot" in result.output
    assert "embedded" in result.output


def test_bad_arguments_of_the_command_are_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for arguments, named in (
        (["--only", "nonsense"], "nonsense"),
        (["--out", str(tmp_path / "file"), "--only", "vpe"], "is a file"),
        (["--scenarios", str(tmp_path)], "holds no scenario files"),
    ):
        with pytest.raises(ScenarioError, match=named):
            CliRunner().invoke(cli.app, ["suite", *arguments], catch_exceptions=False)
    refused = CliRunner().invoke(cli.app, ["suite", "--fc", "px4"])
    assert refused.exit_code == 2
    assert "'px4' is not one of" in refused.output


def test_a_vehicle_that_fell_behind_is_marked() -> None:
    """By its pace over ten seconds, and by what it lost within one."""
    steady = [(0.1 * i, 40.0 + 0.1 * i) for i in range(200)]
    late = [(t, own if t < 5.0 else own - 0.2) for t, own in steady]
    slow = [(t, 40.0 + 0.97 * t) for t, _ in steady]
    rebooted = [(t, own if t < 5.0 else t - 5.0) for t, own in steady]
    for ticks, pace, stall_s in (
        (steady, 1.0, 0.0),
        (late, 0.979, 0.2),
        (slow, 0.97, 0.03),
        (rebooted, 1.0, 0.0),
    ):
        assert slowest_pace(ticks) == pytest.approx(pace, abs=3e-3)
        assert longest_stall(ticks) == pytest.approx(stall_s, abs=5e-3)
        flown = replace(record(), pace=slowest_pace(ticks), stall_s=longest_stall(ticks))
        assert row("vpe", flown).slow == (ticks in (late, slow))
