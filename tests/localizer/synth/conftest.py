from pathlib import Path

import pytest

from localizer.synth.world import WorldInfo
from sitl.demo.assets import FlightAssets


@pytest.fixture(scope="session")
def small_world(small_assets: FlightAssets) -> dict[str, tuple[Path, WorldInfo]]:
    """Tilesets of the survey and of the live visit to the tests' 400 m world."""
    home = small_assets.map_cache.parent
    return {visit: (home / visit, WorldInfo.load(home / visit)) for visit in ("survey", "live")}
