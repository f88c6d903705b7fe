"""Read missions of `companion.planning.mission` for a rehearsal."""

from __future__ import annotations

from pathlib import Path

from companion.errors import MissionFileError
from companion.planning import mission as saved
from companion.planning.mission import HeightAbove, PlannedMission
from sitl.demo.scenario import ScenarioError


def read_mission(path: Path) -> PlannedMission:
    """Read a saved mission. `ScenarioError` if it is invalid or cannot be rehearsed."""
    try:
        planned = saved.read_mission(path)
    except MissionFileError as error:
        raise ScenarioError(str(error)) from error
    strange = {w.above.value for w in planned.path} - {HeightAbove.HOME.value}
    if strange:
        raise ScenarioError(
            f"{path}: waypoints above {', '.join(sorted(strange))}; a rehearsal flies heights "
            "above home (frame 3): save the mission with relative altitudes"
        )
    return planned
