"""Parts of the image that the covariance benchmark leaves of the map."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.basin.parts import PARTS, PatchTrial, covered, part_of, report, table
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.types import RenderedView

SHARES = {"whole": 1.0, "half": 0.5, "quarter": 0.25, "band": 0.3, "discs": 0.38}


@pytest.mark.parametrize("part", PARTS)
def test_a_part_is_as_large_as_it_says_and_not_always_the_same(part):
    kept = [part_of(part, (60, 80), np.random.default_rng(k)) for k in range(12)]
    for k in kept:
        assert k.mean() == pytest.approx(SHARES[part], abs=0.04 if part != "discs" else 0.38)
    assert part == "whole" or len({k.tobytes() for k in kept}) >= 3


def test_outside_of_the_part_there_is_sky_and_no_depth():
    camera = Camera.from_fov(8, 8, 60.0)
    view = RenderedView(
        np.full((8, 8, 3), 9, np.uint8),
        np.full((8, 8), 30.0, np.float32),
        Pose(np.eye(3), np.zeros(3)),
        camera,
    )
    kept = np.zeros((8, 8), dtype=bool)
    kept[:, :4] = True
    shown = covered(view, kept)
    assert (shown.depth[:, :4] == 30).all()
    assert (shown.depth[:, 4:] == 0).all()
    assert (shown.rgb[:, :4] == 9).all()
    assert (shown.rgb[:, 4:] > 100).all()


def test_the_report_counts_those_near_the_truth_and_those_accepted_apart():
    near, wrong = (
        PatchTrial("half", 0, 0.1, 0.1, 4.0, True),
        PatchTrial("half", 1, 9.0, 0.1, 90.0, True),
    )
    line = report("half", [near, near, wrong, PatchTrial("half", 2, 0.2, 0.1, 20.0, False)])
    assert " 66.7 " in line.split("accepted")[0]
    assert "of 3, mean 9.3" in line
    assert " 66.7 " in line.split("accepted")[1]


def test_the_table_has_a_row_for_what_was_fitted_and_a_column_a_part():
    done = [
        PatchTrial(part, view, 0.1, 0.1, 4.0, True) for part in ("whole", "half") for view in (0, 1)
    ]
    done += [
        PatchTrial("half", 3, 0.1, 0.1, 90.0, True),
        PatchTrial("half", 5, 9.0, 0.1, 90.0, True),
    ]
    columns, rows = table("caliterra", done, ["whole", "half"], 25)
    assert columns == ("set", "whole", "half")
    assert [row[0] for row in rows] == [
        "caliterra, photos of even number, fitted",
        "caliterra, photos of odd number",
    ]
    assert rows[0][2].startswith("100.0 [")
    assert rows[0][2].endswith("of 1")
    assert rows[1][2].startswith("50.0 [")
    assert rows[1][2].endswith("of 2")
