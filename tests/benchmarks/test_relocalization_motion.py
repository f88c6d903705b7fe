"""What the benchmark of relocalization in motion counts, over a search and a tracker of its own."""

from __future__ import annotations

from dataclasses import asdict, replace

import pytest

from benchmarks.common.shares import exact_interval
from benchmarks.relocalization.counted import cells, one
from benchmarks.relocalization.motion import TrialOutcome, share, shares
from benchmarks.relocalization.motion import cells as motion_cells

FOUND = TrialOutcome(
    "generated", 0, "day", True, True, True, 90.0, searches=1, found_at=1, wrong=0,
    confirmed_s=1.5, given=3, false=0, worst_m=0.2, cpu_s=2.0,
)  # fmt: skip
LATE = replace(FOUND, trial=1, condition="snow", searches=3, found_at=3)
NEVER = replace(FOUND, trial=2, searches=5, found_at=0, confirmed_s=None, given=0, worst_m=None)
FALSE = replace(FOUND, trial=3, set="elsewhere", found_at=0, wrong=1, false=2, worst_m=1e6)


def row(outcomes: list[TrialOutcome], name: str, light: str = "all") -> dict[str, object]:
    return next(r for r in shares(outcomes) if (r["set"], r["light"]) == (name, light))


def test_found_in_the_first_frame_or_within_five():
    made = row([FOUND, LATE, NEVER], "generated")
    assert made["found_in_first"] == share(1, 3)
    assert made["found_within_5"] == share(2, 3)
    assert made["confirmed"] == share(2, 3)
    assert row([FOUND, LATE, NEVER], "generated", "day")["trials"] == 2


def test_a_trial_with_a_false_pose_counts_once_and_in_all_sets_together():
    made = row([FOUND, FALSE], "all")
    assert made["trials_with_false"] == share(1, 2)
    assert (made["given"], made["false_given"], made["wrong_answers"]) == (6, 2, 1)
    assert row([FOUND, FALSE], "generated")["trials_with_false"] == share(0, 1)


def test_shares_have_exact_intervals():
    low, high = exact_interval(0, 1000)
    assert share(0, 1000) == {"hits": 0, "count": 1000, "low": 0.0, "high": pytest.approx(high)}
    assert high == pytest.approx(0.368, abs=1e-3)
    assert low == 0.0
    assert "0 [0.0, 97.5]" in motion_cells(shares([FOUND]))[-1]


def test_all_relocalizations_are_counted_together_and_a_false_one_shows():
    on_a_map = {"set": "quito", "heading_known": False, "found": True, "false": False}
    elsewhere = on_a_map | {"set": "quito, not on this map", "found": False}
    rows = [asdict(FOUND), asdict(NEVER), asdict(FALSE), on_a_map, elsewhere]
    made = {line[:2]: line[2:] for line in cells([one(row) for row in rows])}
    assert made["a flight without a place", "15°"] == ("2", "1", "1", "0, 0.00 [0.00, 84.19]")
    assert made["a flight without a place of another place", "15°"][1:3] == ("0", "0")
    assert made["one frame, the whole map", "unknown"][:3] == ("1", "1", "0")
    assert made["one frame, the whole map of another place", "unknown"][:3] == ("1", "0", "1")
    assert made["all", "any"][:3] == ("5", "2", "2")
    assert made["all", "any"][3].startswith("1, 20.00 [0.51")
