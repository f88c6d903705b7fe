"""The statistics of the feature benchmark, which decide what is called better."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.common.shares import wilson
from benchmarks.features.report import (
    PairOutcome,
    difference,
    read_outcomes,
    write_outcomes,
)
from benchmarks.features.tables import report
from localizer.errors import SequenceError


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
