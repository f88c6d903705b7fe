"""When the map is back in view, and when it was found again."""

from __future__ import annotations

import numpy as np

from benchmarks.relocalization.returned import Return, returns

TIMES = np.arange(0.0, 40.0, 0.5)
SHARES = np.where((TIMES >= 10) & (TIMES < 20), 0.1, 1.0)


def found(tracked: list[float]) -> list[Return]:
    return list(returns("f", list(TIMES), list(SHARES), tracked, 0.5))


def test_counts_from_the_map_in_view_to_the_first_tracked_frame():
    assert found([5.0, 21.5, 22.0]) == [Return("f", 10.0, 1.5)]


def test_what_was_tracked_before_the_gap_is_no_return():
    assert found([5.0, 11.0]) == [Return("f", 10.0, None)]


def test_a_map_that_was_found_at_its_edge_counts_as_at_once():
    assert found([19.5]) == [Return("f", 10.0, 0.0)]


def test_a_short_gap_is_none():
    shares = np.where((TIMES >= 10) & (TIMES < 12), 0.1, 1.0)
    assert not list(returns("f", list(TIMES), list(shares), [5.0], 0.5))
