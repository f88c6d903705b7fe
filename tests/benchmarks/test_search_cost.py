"""The cost of a search over an area that nobody measured."""

from __future__ import annotations

import pytest

from benchmarks.relocalization.curve import Cost, on_paper


def test_a_larger_area_lies_on_the_line_of_the_two_largest():
    made = [
        Cost(1.0, True, 5.0, 60.0, 8, 0.9, 1.0, 300.0, 2.0),
        Cost(4.0, True, 20.0, 200.0, 32, 2.0, 2.4, 400.0, 2.0),
        Cost(10.0, True, 50.0, 400.0, 80, 4.0, 4.8, 600.0, 2.0),
    ]
    paper = on_paper(made, 100.0)
    assert not paper.measured
    assert paper.cpu_s == pytest.approx(4.0 + 90 * 2.0 / 6)
    assert paper.overview_mib == pytest.approx(500.0)
    assert paper.blocks == 800
