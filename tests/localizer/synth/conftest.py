from pathlib import Path

import pytest

from localizer.synth.config import LIVE, SURVEY, WorldConfig
from localizer.synth.world import WorldInfo, build_visits

SMALL = WorldConfig(seed=5, size_m=400.0, town_radius_m=260.0)


@pytest.fixture(scope="session")
def small_world(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, WorldInfo]]:
    """Survey and live visit to one 400 m world, painted in this process."""
    folder = tmp_path_factory.mktemp("world")
    visits = {folder / "survey": ("survey", SURVEY), folder / "live": ("live", LIVE)}
    infos = build_visits(SMALL, visits, processes=1)
    return {info.variant: (path, info) for path, info in zip(visits, infos, strict=True)}
