"""What the search and the tracker leave each other, over many views."""

from __future__ import annotations

from dataclasses import replace

import pytest

from benchmarks.relocalization.beside import Beside, shares

VIEW = Beside("generated", 0, True, 20.0, 12.0, 1.0, 1.5, right=True)


def test_ratios_are_of_the_same_view_and_the_worst_is_told():
    slow = replace(VIEW, view=1, alone_hz=40.0, beside_hz=9.0, alone_s=2.0, beside_s=5.0)
    middle = replace(VIEW, view=2, beside_s=1.8, right=False)
    told = shares([VIEW, slow, middle])
    assert (told["views"], told["found"]) == (3, 2)
    assert told["search_ratio"] == {"p50": pytest.approx(1.8), "worst": pytest.approx(2.5)}
    assert told["tracker_beside_hz"] == {"p50": 12.0, "worst": 9.0}
    assert told["tracker_share"] == {"p50": pytest.approx(0.6), "worst": pytest.approx(0.225)}
