"""The page that a pilot signs: each fact is of its source, and what is old or lacks is marked."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from datetime import date, datetime, timezone
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from companion.cli.commands import app
from companion.config import CompanionConfig, load_config
from companion.errors import ReportError
from companion.preflight import self_test
from companion.preflight.map_pin import map_hash
from companion.preflight.self_test import STAGES, StageTime, stage_times
from companion.preflight.sheet import as_html, as_text, make_sheet, write_sheet
from localizer.config import LocalizerConfig
from localizer.features.extractor import load_extractor
from localizer.map.cache.cache import MANIFEST_NAME
from localizer.tracking.opening import MapStack
from localizer.types import PosePrior
from mavlink_bridge.preflight.doctor import Diagnosis
from mavlink_bridge.preflight.rules import DoctorFinding

NOW = datetime(2026, 11, 22, 12, 0, tzinfo=timezone.utc)
GOOD = DoctorFinding("EK3_SRC2_POSXY", "6", "6", "", True, True)
SHADOW = {"ready": True, "text": "ready: 0.4 m for 120 s"}
WRONG = DoctorFinding("VISO_TYPE", "0 <b>", "1", "no vision", False, True)


@pytest.fixture
def deployment(tmp_path: Path) -> tuple[Path, CompanionConfig]:
    path = tmp_path / "deployment.yaml"
    model = {"width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240}
    document = {
        "map": "no-map",
        "camera": {"source": "udp://0.0.0.0:5600", "model": model, "calibrated": date(2026, 11, 2)},
        "bridge": {"connection": "udpin:127.0.0.1:14550", "mode": "shadow"},
        "record": {"folder": "flights/day"},
    }
    path.write_text(yaml.safe_dump(document))
    return path, load_config(path)


def lines(deployment, findings=(GOOD,), plan=None, now=NOW) -> dict[str, tuple[str, bool | None]]:
    path, config = deployment
    sheet = make_sheet(path, config, Diagnosis(tuple(findings)), plan, now)
    return {r.name: (r.text, r.good) for r in sheet.rows}


def planned(deployment, tmp_path: Path, made_over: str | None, **told: object) -> Path:
    """A plan.json over a map of that hash; "": the deployment's."""
    _, config = deployment
    config.map.mkdir(exist_ok=True)
    (config.map / MANIFEST_NAME).write_text("{}")
    whole = {"holds": True, "legs": [{"name": "1-2", "holds": True}], "mission": "there/a.plan"}
    sha = map_hash(config.map) if made_over == "" else made_over
    plan = tmp_path / "plan.json"
    plan.write_text(json.dumps(whole | told | ({} if sha is None else {"map_sha256": sha})))
    return plan


def test_each_line_is_of_its_source(deployment, tmp_path):
    _, config = deployment
    legs = [{"name": "1-2", "holds": True}, {"name": "2-3", "holds": False}]
    plan = planned(deployment, tmp_path, "", holds=False, legs=legs, conditions=["dusk"])
    record = config.record.folder.with_name("day-2")
    record.mkdir(parents=True)
    (record / "health.json").write_text(json.dumps({"shadow": SHADOW}))
    found = lines(deployment, (GOOD, WRONG), plan, datetime.now(timezone.utc))
    assert found["parameters and parts"] == ("1 of 2 checks good; wrong: VISO_TYPE", False)
    assert found["forecast"][0] == "a.plan: vision fails on 1 of 2 legs (dusk): 2-3"
    assert found["shadow score"] == ("ready: 0.4 m for 120 s (day-2, today)", True)
    assert found["map"][1] is False
    assert "2026-11-02" in found["calibration"][0]


@pytest.mark.parametrize(("made_over", "good"), [("", True), ("0" * 64, False), (None, False)])
def test_a_forecast_over_another_map_says_nothing_of_this_flight(
    deployment, tmp_path, made_over, good
):
    text, marked = lines(deployment, plan=planned(deployment, tmp_path, made_over))["forecast"]
    assert marked is good
    assert ("made over another map" in text) is not good


def test_a_score_over_another_map_is_marked(deployment):
    _, config = deployment
    record = config.record.folder
    record.mkdir(parents=True)
    (record / "health.json").write_text(json.dumps({"shadow": SHADOW}))
    for flown, good in ((str(config.map), True), ("/maps/valley", False)):
        (record / "record.json").write_text(json.dumps({"config": {"map": flown}}))
        text, marked = lines(deployment, now=datetime.now(timezone.utc))["shadow score"]
        assert marked is good
        assert text.endswith("over another map") is not good


def test_what_is_old_or_lacks_is_marked(deployment):
    path, config = deployment
    recent = lines(deployment)
    assert recent["calibration"][0].startswith("2026-11-02 (20 days ago)")
    assert recent["calibration"][1] is True
    assert lines(deployment, now=NOW.replace(year=2027))["calibration"][1] is False
    never = config.camera.model_copy(update={"calibrated": None})
    none = lines((path, config.model_copy(update={"camera": never})), ())
    assert none["calibration"][1] is False
    assert none["shadow score"] == ("none: fly in shadow mode first", False)
    assert none["parameters and parts"][1] is False


def test_the_page_escapes_and_says_unfit(deployment, tmp_path):
    path, config = deployment
    sheet = make_sheet(path, config, Diagnosis((GOOD, WRONG)), None, NOW)
    page, text = write_sheet(sheet, tmp_path / "sign.html")
    assert "NOT fit to fly" in page.read_text()
    assert "0 &lt;b&gt;" in as_html(sheet)
    assert as_html(sheet).index("VISO_TYPE: 0") < as_html(sheet).index("EK3_SRC2_POSXY")
    assert "ALT_HOLD" in text.read_text()
    assert "Pilot ____" in as_text(replace(sheet, fit=True))
    with pytest.raises(ReportError, match=r"not a plan\.json"):
        make_sheet(path, config, Diagnosis(()), tmp_path / "sign.txt", NOW)


# --- ``companion self-test``: the map that it makes, and the speed that it measures -------------


@pytest.fixture
def switch_interval():
    before = sys.getswitchinterval()
    yield
    sys.setswitchinterval(before)


def test_a_flight_over_the_made_map_is_timed(tmp_path, switch_interval):
    config = LocalizerConfig(width=64, threads=1)
    pose, frame = self_test.render_view(self_test.generate_map(tmp_path), config)
    (row,) = self_test.bench(tmp_path / "map", pose, frame.camera, config, (60,), 0.25)
    assert row.offered_hz == 60
    assert 0 < row.answered_hz < 200
    assert 0 < row.p50_ms <= row.p95_ms
    assert row.cpu_ms > 0
    assert row.cores == pytest.approx(row.cpu_ms * row.answered_hz / 1e3)
    assert row.peak_mib > 50


def test_every_stage_is_timed_and_the_odometry_goes_on(tmp_path):
    config = LocalizerConfig(width=64, threads=1)
    pose, frame = self_test.render_view(self_test.generate_map(tmp_path), config)
    frames = [replace(frame, exposure_time_ns=10**9 + 10**8 * k, sequence=k) for k in range(12)]
    stack = MapStack(tmp_path / "map", config)
    try:
        start = PosePrior.around(pose, 1.0, 1.0, frames[0].exposure_time_ns)
        found = stage_times(stack, frames, start, config, load_extractor(threads=1))
    finally:
        stack.close()
    assert [time.stage for time in found] == list(STAGES)
    by_stage = {time.stage: time.cpu_ms for time in found}
    assert min(by_stage.values()) > 0
    assert by_stage["odometry, off the map"] > by_stage["undistort and shrink"]


def test_the_table_and_the_file_hold_every_rate(tmp_path, monkeypatch):
    rows = [
        self_test.BenchRow(hz, hz - 1.0, 20.0, 31.0, 22.5, 0.7, 512.0) for hz in self_test.RATES_HZ
    ]
    stages = [StageTime(w, name, w / 100, w / 64) for w in (320, 640) for name in STAGES]
    report = self_test.SelfTestReport(0.01, 0.02, 30.0, 4.0, "tiny (onnxruntime, CPU) + detail")

    def tested(folder, say, *, timed):
        return replace(report, bench=tuple(rows), stages=tuple(stages)) if timed else report

    monkeypatch.setattr(self_test, "self_test", tested)
    out = tmp_path / "figures.json"
    shown = CliRunner().invoke(app, ["self-test", "--bench", "--out", str(out)], terminal_width=120)
    assert shown.exit_code == 0, shown.output
    for row in rows:
        assert f"{row.offered_hz}" in shown.stdout
    assert "tiny (onnxruntime, CPU)" in shown.stdout
    for cell in (*STAGES, "3.2 / 5.0", "6.4 / 10.0"):
        assert cell in shown.stdout
    figures = json.loads(out.read_text())
    assert [r["cpu_ms"] for r in figures["bench"]] == [22.5] * 3
    assert [r["stage"] for r in figures["stages"]] == [*STAGES, *STAGES]
    assert "instructions" in figures["versions"]
    plain = CliRunner().invoke(app, ["self-test", "--out", str(out)])
    assert plain.exit_code == 0
    figures = json.loads(out.read_text())
    assert figures["bench"] == figures["stages"] == []
