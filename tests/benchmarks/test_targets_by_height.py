"""The paper's Table 3 from the JSON of flights: shares follow from it, another JSON is named."""

from __future__ import annotations

import json

import pytest

from benchmarks.targets.by_height import by_height
from localizer.errors import SequenceError


def _fix(kind, error_m, looked_s=0.0):
    return {"thing": "a", "kind": kind, "error_m": error_m, "horizontal_m": error_m / 2,
            "looked_s": looked_s}  # fmt: skip


def test_targets_are_pooled_by_height_and_kind(tmp_path):
    files = []
    for k, height in enumerate((40.0, 40.0, 300.0)):
        files.append(tmp_path / f"{k}.json")
        samples = [_fix("flat", 0.5), _fix("edge", 2.0, 6.0), _fix("car", 4.0)]
        last = {"kind": "all", "refused": 1, "sightings": 9}
        document = {"arguments": {"height": height}, "rows": [last], "samples": samples}
        files[-1].write_text(json.dumps(document))
    rows = by_height(files)
    assert ("40", "standing, all", "all", "4 (2)", "50.0 / 100.0 / 100.0", "1.00", "") in rows
    assert ("40", "standing, all", "from 5 s", "2 (2)", "0.0 / 100.0 / 100.0", "1.00", "") in rows
    assert ("300", "moving", "all", "1 (1)", "0.0 / 0.0 / 100.0", "2.00", "") in rows
    assert [row[-1] for row in rows if row[1] == "standing, flat"] == ["2 of 18", "1 of 9"]


@pytest.mark.parametrize("text", ["{", '{"rows": []}', "[1]"])
def test_json_of_another_benchmark_is_named(tmp_path, text):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(SequenceError, match=r"a\.json: not JSON of benchmarks\.targets"):
        by_height([path])
