"""What the estimates for boards rest on: the network's operations are counted as they run."""

from __future__ import annotations

import json
import sys

import pytest

from benchmarks.throughput.boards import main, network_counts
from companion.errors import ReportError


def test_four_times_the_pixels_are_four_times_the_operations():
    (macs, moved), (four_macs, four_moved) = network_counts(64), network_counts(128)
    assert four_macs == pytest.approx(4 * macs)
    assert 3.0 * moved < four_moved < 4.0 * moved  # the weights stay the same
    assert macs * 1e6 > 64 * 48  # a multiplication a pixel, and not of pixels alone


def test_a_self_test_without_bench_has_no_stages(tmp_path, monkeypatch):
    told = tmp_path / "plain.json"
    told.write_text(json.dumps({"stages": [], "features": "tiny (onnxruntime, CPU) + detail"}))
    monkeypatch.setattr(sys, "argv", ["boards", str(told)])
    with pytest.raises(ReportError, match="--bench"):
        main()
