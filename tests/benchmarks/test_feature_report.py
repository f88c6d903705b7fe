"""The statistics of the feature benchmark, which decide what is called better."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.features.report import (
    PairOutcome,
    difference,
    read_outcomes,
    report,
    wilson,
    write_outcomes,
)
from benchmarks.features.tables import TABLES
from localizer.errors import SequenceError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.types import RenderedView


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
    assert "| all | 4 | +25.0 [" in text


def test_where_a_method_is_behind_is_said_with_its_certainty() -> None:
    # Set x: b misses all that a finds. Set y: as good, but for one place of many.
    near, far, mixed = [0.5] * 40, [2.0] * 40, [2.0] + [0.5] * 39
    made = outcomes("a", near, "x") + outcomes("a", near, "y")
    text = report(made + outcomes("b", far, "x") + outcomes("b", mixed, "y"))
    assert "| x: all | 40 | -100.0 [-100.0, -100.0] **behind** |" in text
    assert "- x: day: a, -100.0 [-100.0, -100.0], significant" in text
    assert "- y: all: a, -2.5 [-7.5, +0.0], not significant" in text
    assert "y: day: a" not in text
    assert "in 0 of" not in text
    assert "b is behind in 0 of these cells" in report(outcomes("a", near) + outcomes("b", near))


@pytest.mark.parametrize("text", ["", "a,b\n1,2\n", "method,source\nours,made\n"])
def test_a_file_that_is_no_report_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "seed0.csv"
    path.write_text(text)
    with pytest.raises(SequenceError, match=r"seed0\.csv: "):
        read_outcomes([path])


def test_the_tables_for_the_documentation_have_a_row_a_set_and_a_kind() -> None:
    one = outcomes("gradient", [2.0] * 8, "made") + outcomes("gradient", [2.0] * 4, "quito")
    two = outcomes("tiny", [0.5] * 8, "made") + outcomes("tiny", [0.5, 0.5, 2.0, 9.0], "quito")
    _, sets = TABLES["sets"](one + two)
    assert sets[0] == ("made", "8", "0 [0, 32], 100", "100 [68, 100], 100")
    assert [row[:2] for row in sets] == [("made", "8"), ("quito", "4"), ("all", "12")]
    columns, light = TABLES["light"](one + two)
    assert columns == ("light and weather", "made", "quito")
    assert light == [
        ("day", "100, 100 (n 4)", "50, 50 (n 2)"),
        ("night", "100, 100 (n 4)", "50, 100 (n 2)"),
    ]
    _, leads = TABLES["leads"](one + two)
    assert [row[0] for row in leads] == ["all", "made", "quito", "night"]
    assert leads[1][2] == "+100.0 [+100.0, +100.0]"


def test_new_weights_stand_beside_the_old_ones_with_both_leads_and_the_places() -> None:
    old = outcomes("tiny", [2.0, 9.0, 0.5, 0.5] * 4)
    new = outcomes("new.onnx", [0.5, 2.0, 0.5, 0.5] * 4)
    old, new = ([replace(o, condition=k) for o, k in zip(some, ["dusk", "day"] * 8, strict=True)]
                for some in (old, new))  # fmt: skip
    columns, rows = TABLES["against"](old + new)
    assert columns[:5] == ("pairs", "n", "places", "tiny", "new.onnx")
    assert rows == [
        ("made", "16", "4", "50, 75", "75, 100", "+25.0 [+25.0, +25.0]", "+25.0 [+25.0, +25.0]"),
        ("made: dusk", "8", "4", "50, 100", "100, 100", "+50.0 [+50.0, +50.0]",
         "+0.0 [+0.0, +0.0]"),
    ]  # fmt: skip


def test_a_narrower_pair_shows_the_same_from_the_same_place() -> None:
    pytest.importorskip("torch")
    from benchmarks.features.pairs import TestPair, narrowed

    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0)
    rgb = np.repeat(np.arange(64, dtype=np.uint8)[None, :, None], 48, 0).repeat(3, 2)
    depth = np.where(np.arange(64) < 32, 50.0, 80.0).astype(np.float32)[None].repeat(48, 0)
    wide = TestPair(RenderedView(rgb, depth, Pose.identity(), camera), rgb, Pose.identity(), "day")
    assert narrowed(wide, 64) is wide
    narrow = narrowed(wide, 32)
    assert narrow.view.rgb.shape == narrow.query.shape == (24, 32, 3)
    assert set(np.unique(narrow.view.depth)) == {50.0, 80.0}  # nothing between two surfaces
    assert (narrow.view.depth[:, :16] == 50.0).all()
    assert narrow.view.camera.fx == pytest.approx(30.0)
    assert narrow.truth == wide.truth
