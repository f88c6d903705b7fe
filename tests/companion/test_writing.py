"""A result never replaces what was given to be read."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import resource
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from companion.cli.commands import app
from companion.errors import FootageError, ReportError, redacted
from companion.flight.recorder import ESTIMATE_COLUMNS, EVENT_COLUMNS, TARGET_COLUMNS
from companion.recorded.autopilot_log import read_autopilot_log
from companion.reporting.content import Report
from companion.reporting.layout import write_report
from companion.sources import SourceSettings, StreamState, open_source
from companion.targets.detections import Detection, parse_detection
from companion.writing import refuse_input, result_file, write_result
from localizer.evaluation.sequences import CSV_COLUMNS, LocalizationMetrics
from localizer.geometry.camera import Camera
from localizer.geometry.trajectory import read_poses
from localizer.tracking.engine_health import EngineHealth
from localizer.types import TrackingState
from mavlink_bridge.messages import HealthLevel


def test_a_result_is_no_input_has_its_suffix_and_lies_beside_a_cache(tmp_path):
    given, cache = tmp_path / "a.json", tmp_path / "cache"
    given.write_text("{}")
    cache.mkdir()
    (cache / "index.safetensors").touch()
    with pytest.raises(ReportError, match="would replace"):
        result_file(given, "--json", (".json",), given)
    with pytest.raises(ReportError, match=r"ends in \.json"):
        result_file(tmp_path / "flight.bin", "--json", (".json",))
    with pytest.raises(ReportError, match="in a tile cache"):
        result_file(cache / "manifest.json", "--geojson", (".geojson", ".json"))
    assert result_file(tmp_path / "new.json", "--json", (".json",), given, None)
    refuse_input(tmp_path / "new.json", "--out", given)


def test_a_full_disk_leaves_the_old_report(tmp_path):
    """`report --overwrite` had emptied it before the first byte was refused."""
    path = tmp_path / "report.html"
    path.write_text("old")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))  # each write fails
    try:
        with pytest.raises(ReportError, match=r"--out .*report\.html: cannot be written"):
            write_result(path, "new", "--out")
        with pytest.raises(ReportError, match=r"report\.html: cannot be written"):
            write_report(Report("", "", ""), path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("report.html", "old")]


def test_localize_keeps_its_priors(small_assets, small_sequence, tmp_path):
    shutil.copy(small_sequence / "poses.txt", tmp_path)
    name = read_poses(tmp_path / "poses.txt")[0].name
    found = CliRunner().invoke(app, [
        "localize", str(small_sequence / "images" / name), "--map", str(small_assets.map_cache),
        "--camera", str(small_sequence / "camera.json"), "--priors", str(tmp_path / "poses.txt"),
        "--out", str(tmp_path),
    ])  # fmt: skip
    assert isinstance(found.exception, ReportError)
    assert (tmp_path / "poses.txt").read_text() == (small_sequence / "poses.txt").read_text()


@pytest.mark.parametrize(
    "command",
    ["map export area --out area/index.safetensors", "self-test --out area/manifest.json",
     "convert poses.txt area/manifest.json --from poses --to tum",
     "convert poses.txt poses.txt --from poses --to poses", "convert . . --from photos --to photos",
     "map raise dsm.tif fp.json --out dsm.tif", "map raise dsm.tif fp.json --out fp.json",
     "try photos --places r/frames.csv --report r", "doctor pg.txt --page pg.html",
     "try r --report r", "eval r --map area --report r", "klv a.ts --record r --out a.ts",
     "calibrate flight r --json r/record.json", "calibrate flight r --config d.json --json d.json",
     "calibrate board --print area/board.pdf", "map info area --kml area/a.kml"],
)  # fmt: skip
def test_a_command_replaces_none_of_its_inputs(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("companion.cli.doctor.load_config", lambda _path: None)
    for name in ("area/index.safetensors", "area/manifest.json", "poses.txt", "dsm.tif", "fp.json",
                 "r/frames.csv", "pg.txt", "photos/a.jpg", "r/record.json", "d.json",
                 "a.ts"):  # fmt: skip
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text("kept")
    found = CliRunner().invoke(app, command.split())
    assert isinstance(found.exception, ReportError)
    assert re.search("would replace|lies in a tile cache", str(found.exception))
    assert {path.read_text() for path in tmp_path.rglob("*.*") if path.is_file()} == {"kept"}


@pytest.mark.parametrize(
    ("content", "why"), [(bytes(3000), "begins with 00 00"), (b"", "is empty")]
)
def test_what_is_no_dataflash_log_is_named_in_one_line(tmp_path, capfd, content, why):
    log = tmp_path / "z.bin"
    log.write_bytes(content)
    with pytest.raises(FootageError, match=why):
        read_autopilot_log(log, None)
    assert capfd.readouterr().err == ""


# --- docs/reference/formats.md says what the code writes and reads ------------------------------


TEXT = (Path(__file__).resolve().parents[2] / "docs" / "reference" / "formats.md").read_text(
    encoding="utf-8"
)


def _section(begin, end):
    return TEXT[TEXT.index(begin) : TEXT.index(end, TEXT.index(begin) + 1)]


def _codes(text):
    return re.findall(r"`([^`\n]+)`", text)


@pytest.mark.parametrize(
    ("begin", "end", "columns"),
    [
        ("**estimates.csv**", "**targets.csv**", ESTIMATE_COLUMNS),
        ("**targets.csv**", "**events.csv**", TARGET_COLUMNS),
        ("**events.csv**", "**snapshots/", EVENT_COLUMNS),
        ("| values of `frames.csv` |", "## Trajectory", ("frames.csv", *CSV_COLUMNS)),
    ],
)
def test_columns_stand_in_their_order(begin, end, columns):
    found = [c for c in _codes(_section(begin, end)) if c in columns]
    assert tuple(found) == columns


def test_what_json_files_hold():
    report = _section("| values of `report.json` |", "| values of `frames.csv` |")
    assert {f.name for f in dataclasses.fields(LocalizationMetrics)} <= set(_codes(report))
    health = set(_codes(_section("**health.json**", "**.tlog**")))
    assert {f.name for f in dataclasses.fields(EngineHealth)} <= health
    assert {level.value for level in HealthLevel} <= health
    assert {state.value for state in TrackingState} <= set(_codes(TEXT))


def test_the_example_of_a_detection_is_one():
    example = re.search(r"```json\n(.*?)\n```", TEXT, re.DOTALL)
    detection, _ = parse_detection(example.group(1).encode())
    assert detection == Detection(**json.loads(example.group(1)))


# --- No password in what is logged, told or recorded --------------------------------------------


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("rtsp://admin:s3cret@10.0.0.2:554/live", "rtsp://***@10.0.0.2:554/live"),
        ("rtsp://admin:p@ss/w0rd@10.0.0.2/live", "rtsp://***@10.0.0.2/live"),
        ("refused: 'rtsp://a:b@c/d'; again", "refused: 'rtsp://***@c/d'; again"),
        ("rtsp://c/d?user=admin&password=x", "rtsp://c/d?user=***&password=***"),
        ("udp://10.0.0.1:5600 and me@example.org", "udp://10.0.0.1:5600 and me@example.org"),
        ("udp://@239.1.1.1:5600", "udp://@239.1.1.1:5600"),
    ],
)  # fmt: skip
def test_credentials_are_hidden_and_nothing_else(text: str, shown: str) -> None:
    assert redacted(text) == shown


def test_a_feed_never_tells_its_password(caplog: pytest.LogCaptureFixture) -> None:
    told: list[str] = []
    source: Any = None

    def on_state(state: StreamState, text: str) -> None:
        told.append(text)
        if state is StreamState.STALLED:
            source.close()

    url = "rtsp://admin:s3cret@127.0.0.1:9/none"
    source = open_source(url, Camera.from_fov(320, 240, 70.0), SourceSettings(), on_state)
    assert list(source.frames()) == []
    assert any("***@127.0.0.1:9/none: cannot connect" in text for text in told)
    assert "s3cret" not in "".join(told) + caplog.text


@pytest.fixture
def umask() -> Iterator[None]:
    before = os.umask(0o022)
    yield
    os.umask(before)


@pytest.mark.usefixtures("umask")
def test_what_a_flight_writes_is_not_for_everybody(tmp_path, monkeypatch):
    class Flying:
        def __init__(self, *_: object, **__: object) -> None:
            (tmp_path / "record").mkdir()

        def run(self) -> None:
            (tmp_path / "record" / "events.csv").write_text("x")

    monkeypatch.setattr("companion.flight.app.Companion", Flying)
    monkeypatch.setattr("signal.signal", lambda *_: None)
    deployment = Path(__file__).parents[2] / "configs" / "deployment.yaml"
    result = CliRunner().invoke(app, ["run", str(deployment)])
    assert result.exit_code == 0, result.output
    assert (tmp_path / "record").stat().st_mode & 0o777 == 0o750
    assert (tmp_path / "record" / "events.csv").stat().st_mode & 0o777 == 0o640
