"""One HTML file about a flight: what it says, and that it needs nothing else."""

import json
import os
import re

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from companion.cli.commands import app
from companion.errors import RecordError
from companion.flight.recorder import ESTIMATE_COLUMNS, EVENT_COLUMNS, TARGET_COLUMNS
from companion.offline.record import read_record
from companion.reporting.content import INNER, MapSheet, MapTrack, Report, ReportEvent, Stanford
from companion.reporting.figures import first_fault
from companion.reporting.layout import render
from companion.reporting.record import record_report, worst_frames
from companion.reporting.report import report_of, write_page
from localizer.map.cache.cache import TileCache
from mavlink_bridge.alerts.ids import AlertId
from tests.companion.console.record_of import write_rows

MODEL = {"width": 64, "height": 48, "fx": 60, "fy": 60, "cx": 32, "cy": 24}
START_NS = 1_000_000_000


def _estimate(i, state="tracking", accepted=1, **more):
    return {
        "exposure_time_ns": START_NS + i * 100_000_000, "sequence": i, "east_m": 2.0 * i,
        "qw": 1.0, "quality": 0.8, "state": state, "status": "OK", "accepted": accepted,
        "latency_ms": 90.0, "hpl_m": 2.0, "vpl_m": 2.0, "sigma_east_m": 0.1, "sigma_north_m": 0.1,
    } | more  # fmt: skip


@pytest.fixture
def record(small_assets, tmp_path):
    """A flight that was lost after two seconds, with a target and a picture per frame."""
    folder = tmp_path / "flight"
    (folder / "snapshots").mkdir(parents=True)
    rows = [_estimate(i) for i in range(20)]
    rows += [_estimate(i, "lost", 0, quality=0.1) for i in range(20, 25)]
    rows[7]["quality"] = 0.3
    origin = TileCache.open(small_assets.map_cache).manifest.origin
    rows[0] |= {
        "latitude_deg": origin.latitude_deg, "longitude_deg": origin.longitude_deg,
        "height_m": origin.height_m,
    }  # fmt: skip
    write_rows(folder / "estimates.csv", ESTIMATE_COLUMNS, rows)
    targets = [
        {"exposure_time_ns": START_NS, "target_id": n, "sigma_horizontal_m": 1} for n in "AB"
    ]
    write_rows(folder / "targets.csv", TARGET_COLUMNS, targets)
    events = [
        {
            "time_ns": START_NS,
            "level": "warning",
            "text": "forced",
            "alert": AlertId.INJECTION_FORCED.value,
        },
        {"time_ns": START_NS + 2_500_000_000, "level": "warning", "text": "<script>alert(1)"},
    ]
    write_rows(folder / "events.csv", EVENT_COLUMNS, events)
    for i in range(25):
        picture = np.full((48, 64, 3), 10 * i, np.uint8)
        name = f"{START_NS + i * 100_000_000}.jpg"
        cv2.imwrite(str(folder / "snapshots" / name), picture)
    document = {
        "monotonic_ns": START_NS, "utc_ns": 2 * START_NS, "versions": {"python": "3"},
        "config": {
            "map": str(small_assets.map_cache), "camera": {"model": MODEL}, "of": "another version",
            "bridge": {"injection": {"delay_ms": 80.0, "alert_limit_m": 10.0}},
        },
    }  # fmt: skip
    (folder / "record.json").write_text(json.dumps(document))
    (folder / "health.json").write_text(json.dumps({"level": "ended", "text": "stopped"}))
    return folder


def test_it_says_what_went_wrong_first_and_what_each_miss_means(record):
    report = record_report(record)
    assert report.first == "at 2.0 s: tracking ended in state lost"
    verdicts = {v.name: v for v in report.verdicts}
    assert verdicts["ended in order"].ok
    late = verdicts["exposure to estimate p95"]
    assert (late.ok, late.value, late.needed) == (False, "90 ms", "<= 80 ms")
    assert "older than delay_ms" in render(report)
    assert not verdicts["frames accepted once tracking"].ok  # 20 of 25


def test_what_came_before_gnss_was_denied_is_no_headline_of_the_denial() -> None:
    """It stood in amber above a flight without a fault."""
    time_s = np.arange(-5.0, 5.0)
    estimates = {"state": np.full(10, "tracking"), "time": time_s}
    early = (ReportEvent(-3.0, "warning", "video feed stalled"),)
    told = first_fault(estimates, time_s, early, "", 0.0)
    assert told == "nothing while GNSS was denied; before, at -3.0 s: video feed stalled"
    late = (*early, ReportEvent(2.0, "warning", "withheld"))
    assert first_fault(estimates, time_s, late, "", 0.0) == "at 2.0 s: withheld"
    assert first_fault(estimates, time_s, (), "", 0.0).startswith("nothing: ")
    assert '<p class="first fine">' in render(Report("a flight", "", told))
    assert '<p class="first">' in render(Report("a flight", "", "at 2.0 s: withheld"))


def test_a_report_never_replaces_a_file_without_a_word(record, tmp_path):
    out = tmp_path / "kept.html"
    out.write_text("somebody's")
    words = ["report", str(record), "--out", str(out)]
    refused = CliRunner().invoke(app, words)
    assert "is there already; --overwrite replaces it" in str(refused.exception)
    assert out.read_text() == "somebody's"
    done = CliRunner().invoke(app, [*words, "--overwrite"])
    assert "in place of the one before" in done.stdout
    assert out.read_text() != "somebody's"
    assert " s drawing" not in done.stdout  # steps go to standard error


def test_the_page_needs_nothing_else_and_runs_nothing_of_the_record(record):
    told: list[str] = []
    path = write_page(record, say=told.append)
    assert [text.split()[0] for text in told].count("drawing") >= 2  # the map, and the plots
    text = path.read_text()
    assert path == record / "report.html"
    addresses = set(re.findall(r"""(?:src|href)=["']?([^"'\s>]{0,12})""", text))
    assert {a[:5] for a in addresses} == {"data:"}
    assert "default-src 'none'" in text
    assert "<script>alert(1)" not in text
    assert "&lt;script&gt;alert(1)" in text
    assert text.count("<figure") == 8


def test_the_worst_frames_come_first_and_refused_ones_take_half_the_places(record):
    tables = read_record(record)
    quality = tables.estimates["quality"]
    seconds = (tables.estimates["exposure_time_ns"] - START_NS) * 1e-9
    shown = worst_frames(tables, quality, "quality", seconds)
    assert shown[0].caption == "t = 0.7 s, quality 0.30, tracking, accepted"
    assert sum(not s.caption.endswith(", accepted") for s in shown) == 4
    assert shown[0].world_from_camera.translation[0] == 14.0


def test_each_target_has_its_own_line_and_its_place_on_the_map(record):
    report = record_report(record)
    assert [row[:2] for row in report.targets.rows] == [("A", "1"), ("B", "1")]
    assert [m.name for m in report.sheet.marks] == ["A", "B"]
    assert report.sheet.rgb.std() > 5  # the map was drawn


def test_a_track_is_not_drawn_where_it_is_not_known():
    points = np.array([[0.0, 0.0], [10.0, 0.0], [np.nan, np.nan], [30.0, 0.0], [40.0, 0.0]])
    sheet = MapSheet(None, 0.0, 100.0, 0.0, 100.0, (MapTrack("way", "#123456", INNER, points),))
    page = render(Report("", "", "", sheet=sheet))
    drawn = re.findall(r'<polyline points="([^"]*)" stroke="#123456"', page)
    assert drawn == ["0.00,100.00 10.00,100.00", "30.00,100.00 40.00,100.00"]


def test_a_damaged_record_still_gives_what_it_holds(record):
    """Power is lost in flight: a half row, no health, no settings."""
    with (record / "estimates.csv").open("a") as file:
        file.write("12345,2")
    (record / "record.json").write_text("{")
    (record / "health.json").unlink()
    report = record_report(record)
    assert not report.verdicts[0].ok
    assert any("record.json cannot be read" in note for note in report.notes)
    assert any("map" in note for note in report.notes)
    assert "no health.json" in render(report)


def test_a_record_keeps_no_reader_waiting(record):
    """A foreign record may hold a pipe that nobody writes into, or lead to a device."""
    (record / "health.json").unlink()
    os.mkfifo(record / "health.json")
    (record / "record.json").unlink()
    (record / "record.json").symlink_to("/dev/zero")
    assert "no health.json" in render(record_report(record))
    (record / "events.csv").unlink()
    os.mkfifo(record / "events.csv")
    with pytest.raises(RecordError, match=r"is not a plain file: .*events\.csv"):
        read_record(record)


def test_a_flight_that_localized_nothing_has_a_report(record):
    write_rows(record / "estimates.csv", ESTIMATE_COLUMNS, [])
    assert "never localized" in render(record_report(record))


def test_a_folder_that_is_none_is_named(tmp_path):
    with pytest.raises(RecordError, match="neither a flight's record"):
        report_of(tmp_path)
    with pytest.raises(RecordError, match="there is no such folder"):
        report_of(tmp_path / "typo")
    (tmp_path / "file").touch()
    with pytest.raises(RecordError, match="is a file, not a folder"):
        report_of(tmp_path / "file")


def test_the_stanford_diagram_counts_what_misleads():
    from companion.reporting.content import Report

    levels = np.array([2.0, 2.0, 2.0, 15.0, np.nan])
    errors = np.array([1.0, 3.0, 12.0, 20.0, 1.0])
    text = render(Report("t", "s", "f", stanford=Stanford(errors, levels, 10.0)))
    assert "4 fixes: 3 within the alert limit of 10 m; 2 of them are further off" in text
    assert "(misleading), 1 beyond the limit (hazardous)" in text


HOSTILE = "<img src=x onerror=alert(1)>\"'&</script><!--"


def _changed(path, change):
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("estimates.csv", "a,b\n1,2\n"), ("targets.csv", "a,b\n1,2\n"),
        ("events.csv", "a,b\n1,2\n"), ("estimates.csv", "a,b\n" + "x" * 200_000 + ",1\n"),
        ("estimates.csv", "\0\0\0\n\0\n"),
    ],
)  # fmt: skip
def test_a_foreign_table_is_one_named_line(record, file, content):
    (record / file).write_text(content)
    with pytest.raises(RecordError, match="not a table of a record") as told:
        report_of(record)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("value", [None, 5, "x", [1], [[1, 2]], float("nan"), 10**400, "\ud800"])
@pytest.mark.parametrize("key", ["config", "versions", "monotonic_ns", "utc_ns"])
def test_a_manifest_of_nonsense_costs_what_it_would_have_told(record, key, value):
    def change(document):
        document["config"]["map"] = "missing"
        document[key] = value

    _changed(record / "record.json", change)
    assert "Verdict" in render(report_of(record))


@pytest.mark.parametrize("value", ["", "nan", "inf"])
def test_numbers_that_are_none_cost_their_own_figure(record, value):
    _changed(record / "record.json", lambda d: d["config"]["bridge"].update(
        injection={"delay_ms": float("nan"), "alert_limit_m": 10**400}))  # fmt: skip
    rows = [
        _estimate(i, latency_ms=value, quality=value, qw=value, sigma_east_m=value)
        for i in range(9)
    ]
    write_rows(record / "estimates.csv", ESTIMATE_COLUMNS, rows)
    target = {"exposure_time_ns": START_NS, "target_id": "A", "east_m": value}
    write_rows(record / "targets.csv", TARGET_COLUMNS, [target])
    (record / "snapshots" / "\N{SUPERSCRIPT TWO}.jpg").write_bytes(b"")
    (record / "snapshots" / f"{'9' * 40}.jpg").write_bytes(b"")
    assert "nan ms" in render(report_of(record))


def test_nothing_of_a_record_becomes_markup(record):
    def change(document):
        document["versions"] = {HOSTILE: HOSTILE}
        document["config"] |= {HOSTILE: HOSTILE, "map": HOSTILE}

    _changed(record / "record.json", change)
    (record / "health.json").write_text(
        json.dumps({"level": "ended", "text": HOSTILE + "\ud800", "shadow": HOSTILE})
    )
    target = {"exposure_time_ns": START_NS, "target_id": HOSTILE}
    write_rows(record / "targets.csv", TARGET_COLUMNS, [target])
    event = {"time_ns": START_NS, "level": HOSTILE, "text": HOSTILE}
    write_rows(record / "events.csv", EVENT_COLUMNS, [event])
    write_rows(
        record / "estimates.csv", ESTIMATE_COLUMNS, [_estimate(0, HOSTILE, 1, status=HOSTILE)]
    )
    record = record.rename(record.with_name("<img src=x onerror=alert(1)>"))
    page = write_page(record).read_text(encoding="utf-8")
    assert "<img src=x" not in page
    assert "&lt;img src=x" in page
