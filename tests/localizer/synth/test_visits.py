"""Two visits to one place: what changed between them, and what a survey makes of it."""

import numpy as np
import pytest

from localizer.synth.config import WorldConfig
from localizer.synth.plan.layout import plan_world
from localizer.synth.plan.plan import WorldPlan
from localizer.synth.visits.changes import Changes, apply_changes
from localizer.synth.visits.survey import SurveyErrors
from localizer.synth.visits.visit import survey_and_flight_visits


@pytest.fixture(scope="module")
def plan() -> WorldPlan:
    return plan_world(WorldConfig(5, 400.0))


def test_what_is_built_later_stands_on_free_ground(plan: WorldPlan) -> None:
    assert len(plan.sites) >= 4
    for site in plan.sites:
        for other in [*plan.buildings, *(s for s in plan.sites if s is not site)]:
            away = np.hypot(*np.subtract(site.centre, other.centre))
            assert away > 0.5 * min(site.width, other.width)


def test_buildings_go_change_and_come_in_the_shares_that_are_said(plan: WorldPlan) -> None:
    after = apply_changes(plan, Changes(gone=0.2, rebuilt=0.2, new=0.04, felled=0.3, seed=3))
    before = {b.centre: b for b in plan.buildings}
    count = len(before)
    kept = [b for b in after.buildings if before.get(b.centre) == b]
    rebuilt = [b for b in after.buildings if b.centre in before and before[b.centre] != b]
    new = [b for b in after.buildings if b.centre not in before]
    assert len(new) == min(round(0.04 * count), len(plan.sites))
    assert count - len(kept) - len(rebuilt) == pytest.approx(0.2 * count, rel=0.5)
    assert len(rebuilt) == pytest.approx(0.2 * count, rel=0.5)
    assert all(b.eaves_m != before[b.centre].eaves_m for b in rebuilt)
    assert len(after.trees.xy) == pytest.approx(0.7 * len(plan.trees.xy), rel=0.15)
    assert after.trees.radius.mean() > plan.trees.radius.mean()
    assert after.shapes is plan.shapes  # streets and fields stay
    again = apply_changes(plan, Changes(gone=0.2, rebuilt=0.2, new=0.04, felled=0.3, seed=3))
    assert again.buildings == after.buildings


def test_a_survey_moves_its_surface_smoothly_and_by_what_is_said() -> None:
    survey = SurveyErrors(bumps_m=0.1, seed=4)
    points = np.random.default_rng(0).uniform(-200, 200, (4000, 3))
    off = survey.displaced(points) - points
    np.testing.assert_allclose(off.std(axis=0), 0.1, rtol=0.35)
    beside = survey.displaced(points + 0.2) - points - 0.2
    assert np.abs(beside - off).max() < 0.1  # no tears
    assert SurveyErrors().displaced(points) is points


def test_every_place_is_surveyed_and_lived_in_its_own_way() -> None:
    pairs = [survey_and_flight_visits(WorldConfig(seed, 400.0)) for seed in range(6)]
    assert len({survey.survey for survey, _ in pairs}) == 6
    for survey, live in pairs:
        assert survey.changes is None
        assert live.survey is None
        assert live.changes is not None
        assert min(live.changes.gone, live.changes.rebuilt, live.changes.new) >= 0.01
        assert live.look.changed_buildings == 0.0
