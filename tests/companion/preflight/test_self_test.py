"""``companion self-test``: the map that it makes, and the speed that it measures."""

from __future__ import annotations

import json
import sys

import pytest
from typer.testing import CliRunner

from companion.cli.commands import app
from companion.preflight import bench, self_test
from localizer.config import LocalizerConfig


@pytest.fixture
def switch_interval():
    before = sys.getswitchinterval()
    yield
    sys.setswitchinterval(before)


def test_a_flight_over_the_made_map_is_timed(tmp_path, switch_interval):
    config = LocalizerConfig(width=64, threads=1)
    pose, frame = self_test.render_view(self_test.generate_map(tmp_path), config)
    (row,) = bench.bench(tmp_path / "map", pose, frame.camera, config, (60,), 0.25)
    assert row.offered_hz == 60
    assert 0 < row.answered_hz < 200
    assert 0 < row.p50_ms <= row.p95_ms
    assert row.cpu_ms > 0
    assert row.cores == pytest.approx(row.cpu_ms * row.answered_hz / 1e3)
    assert row.peak_mib > 50


def test_the_table_and_the_file_hold_every_rate(tmp_path, monkeypatch):
    rows = [bench.BenchRow(hz, hz - 1.0, 20.0, 31.0, 22.5, 0.7, 512.0) for hz in bench.RATES_HZ]
    report = self_test.SelfTestReport(0.01, 0.02, 30.0, 4.0, "tiny (onnxruntime, CPU) + detail")

    def tested(folder, say, *, timed):
        for row in rows if timed is not None else ():
            timed(row)
        return report

    monkeypatch.setattr(self_test, "self_test", tested)
    out = tmp_path / "figures.json"
    shown = CliRunner().invoke(app, ["self-test", "--bench", "--out", str(out)], terminal_width=120)
    assert shown.exit_code == 0, shown.output
    for row in rows:
        assert f"{row.offered_hz}" in shown.stdout
    assert "tiny (onnxruntime, CPU)" in shown.stdout
    assert [r["cpu_ms"] for r in json.loads(out.read_text())["bench"]] == [22.5] * 3
    plain = CliRunner().invoke(app, ["self-test", "--out", str(out)])
    assert plain.exit_code == 0
    assert "bench" not in json.loads(out.read_text())
