"""What is flown over a place: the same video for every method, kept as an evaluation sequence.

A rolling shutter, vibration, automatic exposure, a calibration and time stamps that err as drawn,
cars and people that no map has. Light and weather come on top of the visit that is rendered.
"""

from __future__ import annotations

import itertools
import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.places.worlds import LIVE, OUTDATED, PLACES, GeneratedPlace, PlaceFolder
from companion.recorded.sequence import load_sequence
from localizer.evaluation.sequences import Sequence
from localizer.geometry.pose import Pose
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.render.numba_raster import NumbaRenderer
from localizer.synth.appearance.model import sample_appearance
from sitl.camera.movers import traffic
from sitl.camera.realism import CameraClock
from sitl.camera.true_motion import PoseTrack
from sitl.camera.world_camera import CameraOptions, WorldCamera
from sitl.demo.kinematic import camera_path, record_sequence
from sitl.demo.scenario import Scenario, ScenarioLeg, draw_errors

CONDITIONS = ("day", "dusk", "night", "fog", "rain/snow", "season")
HEIGHTS = ("low", "high")
FULL = 300  # frames of a whole sequence, 10 a second
HEIGHT_M = {"low": 50.0, "high": 150.0}
_PITCH_DEG = {"low": (-65.0, -75.0), "high": (-80.0, -85.0)}
_RATE_HZ = 10.0
_BEGIN_S = 2.0  # the vehicle has gathered speed


@dataclass(frozen=True)
class Cell:
    """One sequence of the table."""

    place: GeneratedPlace
    condition: str
    height: str

    @property
    def name(self) -> str:
        """Of its files."""
        words = (self.place.name, self.condition, self.height)
        return "-".join(words).replace(" ", "-").replace("/", "-")

    @property
    def seen(self) -> str:
        """The visit that the camera sees."""
        return OUTDATED if self.condition == "season" else LIVE

    @property
    def seed(self) -> int:
        """Of everything that is drawn for this sequence."""
        order = CONDITIONS.index(self.condition) * len(HEIGHTS) + HEIGHTS.index(self.height)
        return self.place.seed * 20 + order

    @property
    def weather(self) -> str:
        """Its appearance model: rain or snow by lot, and an outdated map by day."""
        if self.condition == "rain/snow":
            return ("rain", "snow")[self.seed // 2 % 2]
        return "day" if self.condition == "season" else self.condition

    @property
    def scenario(self) -> Scenario:
        """300 frames and more: straight on, two corners, straight on."""
        height, pitches = HEIGHT_M[self.height], _PITCH_DEG[self.height]
        ends = ((0.0, 70.0), (60.0, 70.0), (60.0, -70.0))
        legs = tuple(
            ScenarioLeg(east_m=e, north_m=n, height_m=height, gimbal_pitch_deg=pitches[k % 2])
            for k, (e, n) in enumerate(ends)
        )
        return Scenario(takeoff_height_m=height, speed_m_s=8.0, legs=legs, cars=8, people=8)


def cells() -> list[Cell]:
    """All of them, so ordered that any six in a row have every place and every condition once, and
    each condition its heights in turn: a part of the table is a fair part.
    """
    count = len(PLACES)
    return [
        Cell(PLACES[p], CONDITIONS[(p + r) % count], HEIGHTS[(p // 2 + r + half) % 2])
        for half, r, p in itertools.product(range(2), range(count), range(count))
    ]


def first_frame(cell: Cell, frames: int) -> int:
    """Where in the whole sequence a shorter one begins, by lot."""
    rng = np.random.default_rng([cell.seed, 3])
    return int(rng.integers(max(FULL - frames, 0) + 1))


def true_path(cell: Cell, home: PlaceFolder) -> list[tuple[int, Pose]]:
    """(time in ns, world_from_camera) of the whole sequence every 20 ms, less the vibration."""
    return list(camera_path(cell.scenario, float(home.world.ground_height(0.0, 0.0))))


def sequence_of(cell: Cell, home: PlaceFolder, folder: Path, frames: int) -> Sequence:
    """The cell's consecutive frames, rendered where they are not there yet."""
    out = folder / "sequences" / f"{cell.name}-{frames}"
    if not (out / "errors.json").exists():
        _record(cell, home, out, frames)
    return load_sequence(out, TileCache.open(home.map_cache).frame)


def _record(cell: Cell, home: PlaceFolder, out: Path, frames: int) -> None:
    """Written beside it first: a killed run leaves no half of a sequence."""
    scenario, seed = cell.scenario, cell.seed
    frame = TileCache.open(home.map_cache).frame
    path = true_path(cell, home)
    track = PoseTrack(path, keep=None)
    errors = draw_errors(scenario, seed)
    appearance = sample_appearance(np.random.default_rng([seed, 11]), cell.weather)
    movers = traffic(home.world, frame, cars=scenario.cars, people=scenario.people, seed=seed)
    begin = path[0][0] + round((_BEGIN_S + first_frame(cell, frames) / _RATE_HZ) * 1e9)
    times_ns = [begin + round(k * 1e9 / _RATE_HZ) for k in range(frames)]
    stamps, told = CameraClock(errors.realism, seed), scenario.camera.camera()
    with TileStreamer(TileCache.open(home.seen_cache)) as streamer:
        options = CameraOptions(movers, seed=seed, realism=errors.realism)
        camera = WorldCamera(NumbaRenderer(streamer, 1), errors.camera, appearance, options)
        count = record_sequence(camera, track, times_ns, frame, out, told, stamps.of)
    drawn = {"weather": cell.weather, "camera": errors.camera.to_dict(), "frames": count}
    partial = out / "errors.json.partial"
    partial.write_text(json.dumps(drawn, indent=1) + "\n")
    os.replace(partial, out / "errors.json")
