"""Tables from the JSON of benchmarks: their shares follow from it, another JSON is named."""

from __future__ import annotations

import json

import pytest

from benchmarks.tables import ablation_table, axes_table, section, targets_table, throughput_table
from localizer.errors import SequenceError


def _written(path, document):
    path.write_text(json.dumps(document))
    return path


def _fix(kind, error_m, looked_s=0.0, thing="a"):
    return {"thing": thing, "kind": kind, "error_m": error_m, "horizontal_m": error_m / 2,
            "looked_s": looked_s}  # fmt: skip


def test_targets_are_pooled_by_height_and_kind(tmp_path):
    rows = [{"kind": "all", "refused": 1, "sightings": 9}]
    files = [
        _written(tmp_path / f"{k}.json", {
            "arguments": {"height": height}, "rows": rows,
            "samples": [_fix("flat", 0.5), _fix("edge", 2.0, 6.0), _fix("car", 4.0)],
        })
        for k, height in enumerate((40.0, 40.0, 300.0))
    ]  # fmt: skip
    lines = list(targets_table(files))
    (standing,) = [x for x in lines if x.startswith("| 40 | standing, all | all")]
    assert "| 4 (2) | 50.0 / 100.0 / 100.0 |" in standing
    (later,) = [x for x in lines if x.startswith("| 40 | standing, all | from 5 s")]
    assert "| 2 (2) | 0.0 / 100.0 / 100.0 | 1.00 |" in later
    (cars,) = [x for x in lines if x.startswith("| 300 | moving | all")]
    assert "0.0 / 0.0 / 100.0" in cars
    assert any("2 of 18" in x for x in lines)
    assert any("*90.8 / 94.3 / 96.9*" in x for x in lines)  # the paper's, as such


def test_the_ablation_has_an_interval_for_every_share(tmp_path):
    outcomes = [
        {"variant": v, "start": "5 m 5°", "metres": 0.5 if k < hits else 3.0, "degrees": 0.2}
        for v, hits in (("ours", 10), ("one hypothesis", 4))
        for k in range(10)
    ]
    text = "\n".join(ablation_table(_written(tmp_path / "a.json", outcomes)))
    assert "| ours | 100.0 [69.2, 100.0] of 10 |" in text
    assert "| one hypothesis | 40.0 [12.2, 73.8] of 10 |" in text


def test_the_axes_are_ordered_by_their_error(tmp_path):
    outcomes = [
        {"variant": "ours", "start": f"yaw {s}", "metres": 0.1, "degrees": 0.1 if s < 9 else 2.0}
        for s in (10, 2)
    ]
    lines = list(axes_table(_written(tmp_path / "a.json", outcomes)))
    assert "| 2 | 10 |" in lines[0]
    assert lines[2] == "| ours | yaw | 100 | 0 |"


def test_the_throughput_has_rates_and_stages(tmp_path):
    run = {"width": 320, "cores": 2, "offered": "real time", "frames_per_s": 29.9,
           "latency_p50_ms": 30.0, "latency_p95_ms": 50.0, "cpu_ms_per_frame": 40.0,
           "share_percent": 60.0, "median_m": 0.2}  # fmt: skip
    stages = {"width": 320, "cores": 1, "offered": "stages", "stage_ms": {"render": 9.0, "all": 66}}
    text = "\n".join(throughput_table([_written(tmp_path / "a.json", {"rows": [run, stages]})]))
    assert "| 320 | 2 | real time | 29.9 | 30 / 50 | 40.0 | 60 % | 0.20 |" in text
    assert "| render | 9.0 |" in text


def test_json_of_another_benchmark_is_named(tmp_path):
    path = _written(tmp_path / "a.json", {"rows": []})
    with pytest.raises(SequenceError, match="another benchmark"):
        section("Table 3", lambda: targets_table([path]))
