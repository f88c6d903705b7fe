"""What the integrity benchmark counts: false accepts, losses, and files that were cut short."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from benchmarks.common.shares import exact_interval
from benchmarks.integrity.fit import fit
from benchmarks.integrity.report import DISTINCT, FOCAL, LIKELY, OURS, WITHOUT, rows
from benchmarks.integrity.run import StartOutcome, read
from localizer.integrity.acceptance import IntegrityConfig

HALVES = {"right": 40, "wrong": 40}
RIGHT = StartOutcome(
    "quito", 0, "day", "near", 3.0, 3.0, True, metres=0.2, degrees=0.1, off_map_m=0.2,
    overlap=0.9, quality=0.6, sigma_m=0.2, gate=3.0, parts=60, votes=57, peak=7.0, lead=1.0,
)  # fmt: skip
WRONG = replace(
    RIGHT, kind="far", metres=40.0, off_map_m=40.0, votes=9, quality=0.1, peak=2.6, lead=0.01
)
ALIKE = replace(WRONG, votes=58, quality=0.6, peak=6.0, lead=0.1)


def of(outcomes: list[StartOutcome], acceptance: str, name: str = "all"):
    made = rows(outcomes, IntegrityConfig())
    return next(r for r in made if (r.set, r.acceptance) == (name, acceptance))


def test_what_the_votes_let_through_and_what_they_cost():
    torn = replace(RIGHT, votes=10, quality=0.1, peak=3.0, lead=0.02)
    outcomes = [
        RIGHT,
        torn,
        WRONG,
        replace(WRONG, metres=5.0, off_map_m=5.0),
        replace(WRONG, ok=False),
    ]
    before, ours = of(outcomes, WITHOUT), of(outcomes, OURS)
    assert (before.false.hits, before.false_far.hits, before.false.count) == (2, 1, 3)
    assert (before.lost.hits, before.lost.count) == (0, 2)
    assert (ours.false.hits, ours.lost.hits, ours.lost.count) == (0, 1, 2)


def test_a_right_place_from_a_wrong_beginning_is_no_false_accept():
    found = replace(RIGHT, kind="lost")
    assert of([found], OURS).false.hits == 0
    assert of([found], OURS).false.count == 1


def test_the_picture_of_a_shifted_map_is_where_it_shows():
    shifted = replace(RIGHT, set="shifted", kind="far", metres=5.1, off_map_m=0.1)
    assert of([shifted], OURS, "shifted").false.hits == 0


def test_a_wrong_focal_length_and_equal_roofs_are_counted_apart_and_in_all():
    focal = replace(ALIKE, kind="focal", metres=6.0, off_map_m=6.0)
    roofs = replace(ALIKE, set="roofs")
    assert of([focal, roofs], OURS).false.hits == 2
    assert of([focal, roofs], OURS, "all, focal length right").false.hits == 1
    assert (
        of([focal, roofs, RIGHT], OURS, "all, focal length right, no equal roofs").false.hits == 0
    )


def test_a_better_focal_length_and_a_place_that_does_not_stand_out_are_refused_by_ours():
    zoomed = replace(ALIKE, kind="focal", focal_gain=0.05)
    alike = replace(ALIKE, set="roofs", peak=5.0, prior_sigma_m=140.0)
    narrow = replace(RIGHT, set="roofs", peak=5.0, lead=0.1, prior_sigma_m=2.0)
    outcomes = [zoomed, alike, narrow]
    assert (of(outcomes, LIKELY).false.hits, of(outcomes, OURS).false.hits) == (2, 0)
    assert (of(outcomes, FOCAL).false.hits, of(outcomes, DISTINCT).false.hits) == (1, 1)
    assert (of(outcomes, OURS).lost.hits, of(outcomes, OURS).lost.count) == (0, 1)


def drawn(name: str, seed: int) -> list[StartOutcome]:
    """Outcomes of which the right ones have more quality, votes and lead, with noise."""
    rng = np.random.default_rng(seed)
    made = []
    for k in range(80):
        base, ground = (RIGHT, 0.5) if k % 2 else (WRONG, 80.0)
        quality = float(np.clip(base.quality + rng.normal(0, 0.05), 0.02, 1))
        votes = int(np.clip(base.votes + rng.normal(0, 4), 0, base.parts))
        made.append(replace(base, set=name, quality=quality, votes=votes, ground_m=ground))
    return made


def test_the_fit_tells_right_from_wrong_on_a_set_that_it_has_not_seen():
    outcomes = [*drawn("quito", 0), *drawn("forest", 1), *drawn("portugal", 2)]
    between = [replace(RIGHT, set="quito", ground_m=4.0)] * 9
    fitted = fit([*outcomes, *between])
    assert fitted["fitted_on"] == dict.fromkeys(("quito", "forest", "portugal"), HALVES)
    for judged in fitted["left_out"].values():
        assert (judged["right_accepted"], judged["wrong_accepted"]) == (1.0, 0)
    swapped = [replace(o, ground_m=80.0 if o.ground_m < 1 else 0.5) for o in outcomes]
    assert fit(swapped)["left_out"]["quito"]["right_accepted"] == 1.0  # it follows the labels
    mixed = [replace(o, ground_m=0.5 if k % 4 < 2 else 80.0) for k, o in enumerate(outcomes)]
    assert fit(mixed)["left_out"]["quito"]["wrong_accepted"] > 0  # labels that say nothing


def test_a_line_that_was_cut_short_costs_its_view_alone(tmp_path):
    path = tmp_path / "quito.jsonl"
    lines = [json.dumps(asdict(replace(RIGHT, view=k))) for k in (0, 1, 1)]
    path.write_text("\n".join(lines)[:-20])
    assert [o.view for o in read(path)] == [0]


@pytest.mark.parametrize(("hits", "count", "high"), [(0, 10_000, 0.0369), (4, 10_000, 0.1024)])
def test_intervals_are_exact(hits, count, high):
    """Upper bounds of 0 and 4 of 10,000: 1 - 0.025^(1/n), and by tables of Clopper and Pearson."""
    assert exact_interval(hits, count)[1] == pytest.approx(high, abs=2e-4)
    assert np.isclose(exact_interval(count, count)[1], 100.0)
