"""A visit to a place: its look, changes since the survey, and errors of the survey."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from localizer.synth.config import SURVEY, VisitLook, WorldConfig
from localizer.synth.visits.changes import Changes
from localizer.synth.visits.survey import SurveyErrors

_BUILT = 0.04  # largest share of buildings gone, rebuilt, and new, each


@dataclass(frozen=True)
class Visit:
    """A visit to a place. name: of the variant. changes: since the survey; None: none. survey:
    errors of the map made at this visit; None: the true place.
    """

    name: str
    look: VisitLook
    changes: Changes | None = None
    survey: SurveyErrors | None = None


def draw_look(rng: np.random.Generator) -> VisitLook:
    """Draw the look of a random day: sun, season, traffic, missing buildings."""
    strength = rng.uniform(0.0, 1.0)
    warm = rng.uniform(0.8, 1.05)
    sky = 0.75 - 0.42 * strength
    return VisitLook(
        sun_azimuth_deg=float(rng.uniform(0, 360)),
        sun_elevation_deg=float(rng.uniform(12, 65)),
        sun_rgb=(0.95 * strength, 0.9 * strength * warm**0.5, 0.85 * strength * warm),
        sky_rgb=(sky * 0.93, sky, sky * 1.08),
        dryness=float(rng.uniform(0, 1)),
        crop=float(rng.uniform(0, 1)),
        leaf=float(rng.uniform(0, 1)),
        occupancy=float(rng.uniform(0.1, 0.9)),
        parking_seed=int(rng.integers(2, 1_000_000)),
        changed_buildings=float(rng.choice((0.0, 0.05))),
    )


def survey_and_flight_visits(config: WorldConfig) -> tuple[Visit, Visit]:
    """The visit from which the map is made, and the one that is flown over, both drawn from the
    world's seed.
    """
    rng = config.rng(62)
    survey = Visit("survey", SURVEY, survey=SurveyErrors.draw(rng))
    # What is gone is in the changes, beside what is new.
    look = replace(draw_look(rng), changed_buildings=0.0)
    gone, rebuilt, new = (float(x) for x in rng.uniform(0.01, _BUILT, 3))
    changes = Changes(
        gone, rebuilt, new, float(rng.uniform(0.02, 0.08)), seed=int(rng.integers(1 << 30))
    )
    return survey, Visit("live", look, changes)
