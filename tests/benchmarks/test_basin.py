"""The convergence benchmark's own arithmetic: starts, shares and limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.basin.axes import AXES, STEPS, limit
from benchmarks.basin.axes import table as axes_table
from benchmarks.basin.run import BasinOutcome, random_start, summary
from benchmarks.basin.tables import ablation_table, covariance_table
from localizer.geometry.pose import Pose, so3_exp

TRUTH = Pose(so3_exp([2.0, 0.3, -0.4]), np.array([10.0, -20.0, 120.0]))


def outcome(view: int, metres: float, start: str = "yaw 1", variant: str = "ours") -> BasinOutcome:
    return BasinOutcome(variant, view, start, "day", metres, 0.1, 0.1, 6.0, 10.0)


def test_a_random_start_is_exactly_as_wrong_as_it_says():
    prior = random_start(5.0, 3.0, 7).prior(TRUTH)
    metres, degrees = prior.world_from_camera.distance_to(TRUTH)
    assert metres == pytest.approx(5.0)
    assert degrees == pytest.approx(3.0)


def test_the_limit_is_where_half_of_the_first_share_is_left():
    assert limit([80, 80, 80, 20, 0, 0, 0]) == pytest.approx(4.0 + 2.0 * 40 / 60)
    assert limit([80] * 7) == np.inf


def test_a_summary_compares_the_same_views():
    mine = [outcome(0, 0.5), outcome(1, 2.0), outcome(2, 5.0), outcome(3, 0.2)]
    full = [outcome(k, 0.5) for k in range(4)]
    s = summary(mine, full)
    assert s["r1"] == 50.0
    assert s["change"] == -50.0
    assert s["change_low"] <= -50.0 <= s["change_high"]


def test_what_the_covariance_was_fitted_on_has_its_own_row():
    mine = [replace(outcome(k, 0.5), nees=4.0 + 20.0 * (k == 41)) for k in range(80)]
    far = replace(outcome(79, 4.0), nees=900.0)  # not asked for: not within 3 m
    _, rows = covariance_table("generated", [*mine, far], 0)
    assert [row[:2] for row in rows] == [
        ("generated, worlds of even number, fitted", "40"),
        ("generated, worlds of odd number", "40"),
    ]
    assert rows[0][4] == "100.0 [91, 100]"
    assert rows[1][4].startswith("97.5 [")
    assert [row[0] for row in covariance_table("caliterra", mine, 25)[1]] == [
        "caliterra, photos of even number, fitted",
        "caliterra, photos of odd number",
    ]


def test_the_ablations_table_compares_with_ours_start_by_start():
    rows = [outcome(k, 0.5, start) for k in range(4) for start in ("5 m 5°", "10 m 10°")]
    other = [replace(o, variant="one", metres=2.0 * (o.view < 2)) for o in rows]
    columns, cells = ablation_table("quito", rows + other)
    assert columns[1] == "5 m, 5°, n 4: R@1, change, median"
    assert cells[0] == ("quito: **ours**", "100.0 %, 0.50 m", "100.0 %, 0.50 m", "10")
    assert cells[1][1].startswith("50.0 %, -50.0 (-")


def test_the_axes_table_has_limits_beside_the_papers_and_shares_of_all_axes():
    reach = dict(zip(STEPS, (1.0, 1.0, 1.0, 1.0, 0.75, 0.5, 0.25), strict=True))
    made = [
        outcome(k, 0.1 if k < share * 4 else 5.0, f"{axis} {size:.0f}")
        for axis in ("all", *AXES)
        for size, share in reach.items()
        for k in range(4)
    ]
    columns, rows = axes_table(made)
    assert columns[1:] == (*AXES, "from 8 / 11 / 15 m and ° in all, %")
    assert rows[0][1] == "3.5°"
    assert rows[0][4] == "5.6 m"
    assert rows[1][0] == "**ours**"
    assert rows[1][1].startswith("11.0 [")
    assert rows[1][-1] == "75 / 50 / 25"
