"""What the odometry's benchmark makes of known errors."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from benchmarks.odometry.__main__ import main
from benchmarks.odometry.flights import FlownStretch, OdometryStep
from benchmarks.odometry.report import fitted_growth, rows
from benchmarks.site.forms import tables_of

SIGMA = np.diag([0.05, 0.05, 0.05]) ** 2


def step(
    flown_m: float, error: np.ndarray, covariance: np.ndarray, status: str = "OK"
) -> OdometryStep:
    return OdometryStep(
        status, tuple(error), tuple(map(tuple, covariance)), (flown_m, 0.0, 0.0), flown_m,
        1.0, 0.8, 1.0, 10.0,
    )  # fmt: skip


def stretches(scale: float, walk: float, count: int, *, told: bool) -> list[FlownStretch]:
    """Stretches due east whose errors follow the model of growth; told: so does the covariance."""
    rng = np.random.default_rng(5)
    flown = []
    for seed in range(count):
        share, steps, walked = rng.normal(0, scale), [], np.zeros(2)
        for way in np.arange(10.0, 601.0, 10.0):
            walked = walked + rng.normal(0, walk * np.sqrt(10.0), 2)
            error = np.array([share * way, 0.0, 0.0])
            error[:2] += walked
            growth = np.diag([scale**2 * way**2 + walk**2 * way, walk**2 * way, 0.0])
            steps.append(step(way, error, SIGMA + growth * told))
        flown.append(FlownStretch("somewhere", "day", seed, "map", tuple(steps)))
    return flown


def test_the_growth_that_made_the_errors_is_found():
    found = fitted_growth(stretches(0.01, 0.03, 60, told=False))
    assert found["scale"] == pytest.approx(0.01, rel=0.35)
    assert found["horizontal"] == pytest.approx(0.03, rel=0.35)


def test_an_honest_covariance_holds_and_a_bold_one_does_not():
    honest = rows(stretches(0.01, 0.03, 60, told=True))[-1]
    bold = rows(stretches(0.01, 0.03, 60, told=False))[-1]
    assert honest["inside_95_percent"] == pytest.approx(95, abs=4)
    assert float(str(bold["inside_95_percent"])) < 40
    assert honest["end_percent_p95"] == pytest.approx(2.0, abs=0.6)


def test_what_was_not_carried_on_is_counted():
    lost = FlownStretch("somewhere", "night", 0, "map", (
        step(100.0, np.zeros(3), SIGMA),
        step(110.0, np.array([30.0, 0, 0]), SIGMA, "LOST"),
    ))  # fmt: skip
    row = rows([lost])[-1]
    assert row["carried_to_the_end"] == 0
    assert row["usable_percent"] == 50
    assert row["end_m_p50"] == pytest.approx(30)  # its error counts all the same


def test_the_report_of_several_runs_can_be_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    runs, kept = [tmp_path / "1.json", tmp_path / "2.json"], tmp_path / "kept.json"
    for run in runs:
        flown = [asdict(f) for f in stretches(0.01, 0.03, 2, told=True)]
        run.write_text(json.dumps({"flown": flown}))
    monkeypatch.setattr("sys.argv", ["", "--report", *map(str, runs), "--json", str(kept)])
    main()
    table, _ = tables_of([kept], "")
    assert [row[:4] for row in table.rows] == [("all", "map", c, "4") for c in ("day", "all")]
