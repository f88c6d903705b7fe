"""Results that are kept for the documentation: from a command's JSON to the page's table."""

import json
from pathlib import Path

import pytest

from benchmarks.site.forms import tables_of
from benchmarks.site.kept import DATA, Kept, PrintedTable, load, save, with_tables
from companion.errors import ReportError

ROOT = Path(__file__).parents[1]
KEPT = Kept(
    "make x", "abc1234", "2026-11-22", "2 cores", "", PrintedTable(("a", "b"), (("1", "2"),))
)
FLIGHT = {
    "report": {
        "localizer": {"recall_1": 99.0, "recall_3": 100.0, "recall_5": 100.0, "completeness": 100.0,
                      "fps": 9.5},
        "localizer_m": {"median": 0.25, "p95": 0.5, "maximum": 0.9},
        "ekf_horizontal_m": {"median": 9.0, "p95": 9.0, "maximum": 9.0},
        "ekf_in_map_m": {"median": 0.3, "p95": 0.7, "maximum": 1.1},
        "inside_bound": 95.5, "home_error_m": 0.4,
        "fixed_targets_m": {"median": 0.16, "p95": 0.53},
        "stages_ms": {"latency": {"median": 110.0, "p95": 135.0}},
        "criteria": [
            {"name": "EKF p95", "value": 0.7, "limit": 0.6, "unit": "m", "at_least": False},
            {"name": "R@3", "value": 100.0, "limit": 100.0, "unit": "%", "at_least": True},
        ],
    }
}  # fmt: skip


def test_a_marked_table_is_made_anew_and_what_stands_around_it_stays(tmp_path):
    save(KEPT, tmp_path / "x.json")
    page = "before\n<!-- kept x -->\n| old |\n<!-- end -->\nafter\n"
    made = with_tables(page, tmp_path)
    assert made.startswith("before\n<!-- kept x -->\n| a | b |\n|---|---|\n| 1 | 2 |\n\n*Command, ")
    assert "[x](data/x.json)" in made
    assert made.endswith("<!-- end -->\nafter\n")
    assert with_tables(made, tmp_path) == made


def test_results_of_one_form_stand_together_and_others_are_refused(tmp_path):
    save(KEPT, tmp_path / "x.json")
    save(KEPT, tmp_path / "y.json")
    made = with_tables("<!-- kept x y -->\n<!-- end -->", tmp_path)
    assert made.count("| 1 | 2 |") == 2
    assert "[x](data/x.json), [y](data/y.json)" in made
    other = Kept("make x", "abc1234", "2026-11-22", "2 cores", "", PrintedTable(("c",), (("1",),)))
    save(other, tmp_path / "y.json")
    with pytest.raises(ReportError, match="differ in their columns"):
        with_tables("<!-- kept x y -->\n<!-- end -->", tmp_path)


def test_a_flights_report_is_read_in_the_maps_frame(tmp_path):
    path = tmp_path / "report.json"
    path.write_text(json.dumps(FLIGHT))
    table, criteria = tables_of([path], "seed 7")
    (row,) = table.rows
    assert row[0] == "seed 7"
    assert row[4] == "0.30 / 0.70 / 1.10"
    assert [r[3] for r in criteria.rows] == ["**missed**", "yes"]


@pytest.mark.parametrize("text", ["{}", "no json", '{"report": {}}', '{"flights": [{}]}'])
def test_what_is_no_report_is_named(tmp_path, text):
    path = tmp_path / "report.json"
    path.write_text(text)
    with pytest.raises(ReportError, match=r"report\.json"):
        tables_of([path], "x")


def test_a_kept_file_that_is_damaged_is_named(tmp_path):
    (tmp_path / "x.json").write_text("{")
    with pytest.raises(ReportError, match=r"x\.json: not a kept result"):
        with_tables("<!-- kept x -->\n<!-- end -->", tmp_path)


def test_every_kept_result_stands_on_a_page():
    pages = "".join(p.read_text(encoding="utf-8") for p in (ROOT / "docs").rglob("*.md"))
    for path in (ROOT / DATA).glob("*.json"):
        assert load(path).command
        assert f"data/{path.name}" in pages, path
