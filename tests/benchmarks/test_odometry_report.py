"""What the odometry's benchmark makes of known errors."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.common.shares import exact_interval, wilson
from benchmarks.features.report import PairOutcome, difference, read_outcomes, write_outcomes
from benchmarks.features.tables import report
from benchmarks.odometry.__main__ import main
from benchmarks.odometry.flights import FlownStretch, OdometryStep
from benchmarks.odometry.report import fitted_growth, rows
from benchmarks.relocalization.counted import cells, one
from benchmarks.relocalization.motion import TrialOutcome, share, shares
from benchmarks.relocalization.motion import cells as motion_cells
from benchmarks.site.forms import tables_of
from benchmarks.targets.by_height import by_height
from localizer.errors import SequenceError

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


# --- The statistics of the feature benchmark, which decide what is called better ----------------


def outcomes(method: str, metres: list[float], source: str = "made") -> list[PairOutcome]:
    return [
        PairOutcome(method, source, 0, k, k // 4, "day" if k % 2 else "night", m, 0.1, 0.02)
        for k, m in enumerate(metres)
    ]


def test_wilson_is_the_textbooks() -> None:
    # Newcombe 1998, table 1: 81 of 263 and 0 of 20.
    assert wilson(81, 263) == pytest.approx((25.53, 36.62), abs=0.02)
    assert wilson(0, 20) == pytest.approx((0.0, 16.11), abs=0.02)


def test_the_lead_is_paired_and_its_interval_follows_the_places() -> None:
    rng = np.random.default_rng(0)
    base = rng.uniform(0.5, 1.5, 400)
    a, b = outcomes("a", (base - 0.1).tolist()), outcomes("b", base.tolist())
    gain, low, high = difference(a, b)
    assert gain == pytest.approx(10.0, abs=4.0)
    assert 0.0 < low < gain < high < 20.0
    assert difference(a, a) == (0.0, 0.0, 0.0)
    with pytest.raises(ValueError, match="zip"):
        difference(a, b[:-1])


def test_outcomes_survive_the_file_and_make_a_table(tmp_path: Path) -> None:
    made = outcomes("a", [0.5, 2.0, 0.2, 9.0]) + outcomes("b", [0.5, 0.9, 0.2, 9.0])
    write_outcomes(made, tmp_path / "out.csv")
    assert read_outcomes([tmp_path / "out.csv"]) == made
    text = report(made)
    assert "| all | 4 | 50 [15, 85], 75 | 75 [30, 95], 75 |" in text
    assert "| night | 2 | 100 " in text
    assert "| median error |  | 1.25 m, 0.10° | 0.70 m, 0.10° |" in text
    assert "| all | 4 | +25.0 [" in text


def test_leads_are_told_by_set_and_by_kind() -> None:
    # Set x: b misses all that a finds. Set y: as good, but for one place of many.
    near, far, mixed = [0.5] * 40, [2.0] * 40, [2.0] + [0.5] * 39
    made = outcomes("a", near, "x") + outcomes("a", near, "y")
    text = report(made + outcomes("b", far, "x") + outcomes("b", mixed, "y"))
    assert "| x | 40 | -100.0 [-100.0, -100.0] |" in text
    assert "| y | 40 | -2.5 [-7.5, +0.0] |" in text
    assert "| day | 40 | -50.0 [" in text
    assert "lead of" not in report(made)


@pytest.mark.parametrize("text", ["", "a,b\n1,2\n", "method,source\nours,made\n"])
def test_a_file_that_is_no_report_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "seed0.csv"
    path.write_text(text)
    with pytest.raises(SequenceError, match=r"seed0\.csv: "):
        read_outcomes([path])


# --- targets by height --------------------------------------------------------------------------


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


# --- relocalization motion ----------------------------------------------------------------------


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
