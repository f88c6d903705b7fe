"""The whole companion through its worst faults; `python -m sitl loop` flies the rest."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from localizer.map.building.build import build_cache
from localizer.synth.config import WorldConfig, look_of
from localizer.synth.visits.visit import Visit
from localizer.synth.world import build_visits
from sitl.demo.assets import FlightAssets
from sitl.suite.loop.case import LoopCase, load_loop_cases
from sitl.suite.loop.evaluation import evaluate
from sitl.suite.loop.flight import LoopAssets, fly

# At 45 m instead of 80: the climb is flown in real time.
FLOWN = tuple(case.model_copy(update={"height_m": 45.0}) for case in load_loop_cases() if case.ci)


def another_place(folder: Path) -> Path:
    """Its map alone, half the work of a world: nobody flies there."""
    survey, cache = folder / "survey", folder / "survey-cache"
    build_visits(WorldConfig(105, 400.0), {survey: Visit("survey", look_of("survey"))})
    build_cache(survey / "tileset.json", cache)
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
