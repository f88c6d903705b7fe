"""The whole companion through its worst faults; `python -m sitl loop` flies the rest."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from sitl.demo.assets import FlightAssets, prepare
from sitl.suite.loop.case import LoopCase, load_loop_cases
from sitl.suite.loop.flight import LoopAssets, fly
from sitl.suite.loop.judge import judge

FLOWN = tuple(case for case in load_loop_cases() if case.ci)


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
        other = prepare(105, tmp_path_factory.mktemp("elsewhere"), size_m=400.0, ideal=True)
        wrong_map = other.map_cache
    assets = LoopAssets(small_assets, wrong_map)
    with real_time():
        record = fly(case, assets, "embedded", 5, tmp_path / case.name)
        missed = [
            f"{held.what}: {held.seen}"
            for held in judge(record, case.expect, denied=case.deny)
            if not held.ok
        ]
        assert missed == []
