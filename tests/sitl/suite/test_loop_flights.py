"""The whole companion through its worst faults; `python -m sitl loop` flies the rest."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from localizer.map.building.build import build_cache
from localizer.map.building.options import BuildOptions
from localizer.synth.config import WorldConfig, look_of
from localizer.synth.visits.visit import Visit
from localizer.synth.world import build_visits
from sitl.demo.assets import FlightAssets
from sitl.suite.loop.case import LoopCase, load_loop_cases
from sitl.suite.loop.evaluation import evaluate
from sitl.suite.loop.flight import LoopAssets, fly


def _short(case: LoopCase) -> LoopCase:
    """A quick climb to 45 m instead of 80, and events 5 s sooner: all is flown in real time."""
    sooner_s = 5.0 if case.timeline else 0.0
    return case.model_copy(
        update={
            "height_m": 45.0,
            "vehicle": case.vehicle | {"WPNAV_SPEED_UP": 800, "WPNAV_ACCEL_Z": 250},
            "seconds": case.seconds - sooner_s,
            "timeline": tuple(
                event.model_copy(update={"at_s": event.at_s - sooner_s}) for event in case.timeline
            ),
        }
    )


FLOWN = tuple(_short(case) for case in load_loop_cases() if case.ci)


def another_place(folder: Path) -> Path:
    """Its map alone, half the work of a world: nobody flies there."""
    survey, cache = folder / "survey", folder / "survey-cache"
    build_visits(WorldConfig(105, 400.0), {survey: Visit("survey", look_of("survey"))}, 1)
    build_cache(survey / "tileset.json", cache, BuildOptions(workers=1))
    return cache


@pytest.mark.parametrize("case", FLOWN, ids=lambda case: case.name)
def test_nothing_wrong_is_believed_untold(
    case: LoopCase,
    real_time: Callable[[], AbstractContextManager[None]],
    small_assets: FlightAssets,
    tmp_path_factory: pytest.TempPathFactory,
    tmp_path: Path,
) -> None:
    wrong_map = None
    if case.wrong.other_map:
        wrong_map = another_place(tmp_path_factory.mktemp("elsewhere"))
    assets = LoopAssets(small_assets, wrong_map)
    with real_time():
        record = fly(case, assets, "embedded", 5, tmp_path / case.name)
        missed = [
            f"{held.what}: {held.seen}"
            for held in evaluate(record, case.expect, denied=case.deny)
            if not held.ok
        ]
        assert missed == []
