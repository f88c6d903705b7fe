"""Each leg forecast from the map alone, then flown on the desk over another visit to the place."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.common.lines import read_lines
from benchmarks.planning.legs import FORECASTS, PICTURES, TestLeg, draw_legs
from localizer.config import LocalizerConfig
from localizer.errors import SequenceError
from localizer.features.detail import DetailExtractor
from localizer.features.extractor import load_extractor
from localizer.forecast.forecast import (
    LEAST_MAP,
    WORST_M,
    Figures,
    Forecaster,
    draw_prior,
    position_sigma_m,
)
from localizer.geometry.pose import Pose
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.registration.jngo import JNGO
from localizer.render.numba_raster import NumbaRenderer
from localizer.synth.appearance.model import (
    Appearance,
    apply_appearance,
    limit_haze,
    sample_appearance,
)
from localizer.tracking.pipeline import reference_anchors, working_camera
from localizer.types import RenderedView
from sitl.demo.assets import FlightAssets

_BYTES = 96 * 2**20


@dataclass(frozen=True)
class RegisteredFrame:
    """One picture of the other visit, registered. error_m: of the position, at most `WORST_M`;
    sigma_m: as the registration tells it, one axis.
    """

    accepted: bool
    error_m: float
    sigma_m: float


@dataclass(frozen=True)
class FlownLeg:
    """A leg: what was forecast at `FORECASTS` places, and what `PICTURES` pictures gave."""

    world: str
    leg: int
    condition: str
    height_m: float
    pitch_deg: float
    figures: tuple[Figures, ...]
    rivals: tuple[float, ...]
    textures: tuple[float, ...]
    pictures: tuple[RegisteredFrame, ...]


class LegFlyer:
    """Forecasts and flies legs over one world; close it when done."""

    def __init__(self, assets: FlightAssets) -> None:
        self._stack = ExitStack()
        self._config = LocalizerConfig()
        self._map, self._live = (
            NumbaRenderer(
                self._stack.enter_context(TileStreamer(TileCache.open(cache), byte_budget=_BYTES)),
                1,
            )
            for cache in (assets.map_cache, assets.live_cache)
        )
        self._extractor = DetailExtractor(load_extractor(None, threads=1))
        self._optimizer = JNGO(self._config.registration, threads=1)

    def __enter__(self) -> LegFlyer:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def fly(self, world: str, leg: TestLeg) -> FlownLeg:
        """Both, of one leg."""
        forecaster = Forecaster(
            self._map, self._extractor, self._optimizer, leg.camera, self._config
        )
        places = [
            forecaster.at(pose, (leg.condition,), 100 * leg.number + k)[0]
            for k, pose in enumerate(leg.poses(FORECASTS))
        ]
        rng = np.random.default_rng((89, leg.number))
        look = sample_appearance(rng, leg.condition)  # one weather a leg, as a flight has it
        pictures = []
        for pose in leg.poses(PICTURES):
            camera = working_camera(leg.camera, self._config.width)
            live = self._live.render(pose, camera, wait=True)
            pictures.append(self._registered(forecaster, pose, live, look, rng))
        return FlownLeg(
            world, leg.number, leg.condition, leg.height_m, leg.pitch_deg,
            tuple(p.figures for p in places),
            tuple(p.rival.share for p in places),
            tuple(p.texture for p in places),
            tuple(pictures),
        )  # fmt: skip

    def _registered(
        self,
        forecaster: Forecaster,
        pose: Pose,
        live: RenderedView,
        look: Appearance,
        rng: np.random.Generator,
    ) -> RegisteredFrame:
        prior = draw_prior(pose, rng)
        reference = self._map.render(prior.world_from_camera, live.camera, wait=True)
        if (reference.depth > 0).mean() < LEAST_MAP:
            return RegisteredFrame(accepted=False, error_m=WORST_M, sigma_m=WORST_M)
        anchors = reference_anchors(
            reference, self._extractor, self._config.anchors, self._config.seed
        )
        look = limit_haze(look, live.depth)
        query = self._extractor.extract(apply_appearance(live.rgb, live.depth, look, rng))
        found = self._optimizer.register(query, live.camera, anchors, prior)
        error = found.world_from_camera.distance_to(pose)[0]
        accepted = forecaster.is_accepted(found, prior)
        return RegisteredFrame(accepted, float(min(error, WORST_M)), position_sigma_m(found))


def run_world(assets: FlightAssets, count: int, path: Path, more_time: Callable[[], bool]) -> int:
    """Append the legs of a world that `path` lacks; how many are left."""
    world = f"{assets.world.seed}"
    done = {f.leg for f in read(path) if f.world == world} if path.exists() else set()
    legs = draw_legs(
        assets.world.seed,
        assets.world.size_m,
        count,
        lambda e, n: float(assets.world.ground_height(e, n)),
    )
    left = [leg for leg in legs if leg.number not in done]
    with LegFlyer(assets) as flyer, path.open("a") as file:
        while left and more_time():
            file.write(json.dumps(asdict(flyer.fly(world, left.pop(0)))) + "\n")
            file.flush()
    return len(left)


def read(path: Path) -> list[FlownLeg]:
    """The legs of a file."""
    flown = []
    for row in read_lines(path):
        try:
            row["figures"] = tuple(Figures(**f) for f in row["figures"])
            row["pictures"] = tuple(RegisteredFrame(**p) for p in row["pictures"])
            row["rivals"], row["textures"] = tuple(row["rivals"]), tuple(row["textures"])
            flown.append(FlownLeg(**row))
        except (KeyError, TypeError) as error:
            raise SequenceError(
                f"{path}: not a file of this benchmark ({error}): begin anew without it"
            ) from error
    return flown
