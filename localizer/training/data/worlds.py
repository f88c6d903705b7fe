"""Pairs from generated mesh worlds, rendered by the product's own renderer from its own tile cache.

They look like what the localizer flies over: tiles at several levels of detail, textured meshes,
facades. Seeds below `FIRST_WORLD_SEED` belong to demos and tests and are never used here.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from localizer.errors import MapSourceError
from localizer.geometry.camera import Camera
from localizer.map.building.build import build_cache
from localizer.map.building.options import BuildOptions
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.render.numba_raster import NumbaRenderer
from localizer.synth.config import SURVEY, WorldConfig
from localizer.synth.visits.visit import Visit, coarser, draw_look, draw_texel
from localizer.synth.world import WorldInfo, build_visits
from localizer.training.data.pairs import (
    FIRST_WORLD_SEED,
    Pair,
    SceneConfig,
    draw_condition,
    look_at,
    moved,
)

_SIZE_M, _FLIGHT_DAYS = 800.0, 2


def world_pairs(seed: int, scenes: SceneConfig, *, count: int) -> Iterator[Pair]:
    """`count` pairs of the world of `seed`: surveyed once, seen again on other days.
    `MapSourceError` for a seed below `FIRST_WORLD_SEED`.
    """
    if seed < FIRST_WORLD_SEED:
        raise MapSourceError(f"training worlds have seeds from {FIRST_WORLD_SEED} on, got {seed}")
    rng = np.random.default_rng((seed, 7))
    with tempfile.TemporaryDirectory() as temporary, ExitStack() as stack:
        root = Path(temporary)
        looks = {root / "survey": Visit("survey", SURVEY)}
        looks |= {root / f"day{k}": Visit("live", draw_look(rng)) for k in range(_FLIGHT_DAYS)}
        info = build_visits(WorldConfig(seed, _SIZE_M), looks, processes=1)[0]
        renderers = []
        for folder in looks:
            cache = root / f"{folder.name}.cache"
            build_cache(folder, cache, BuildOptions(origin=info.origin, workers=1))
            streamer = stack.enter_context(TileStreamer(TileCache.open(cache)))
            renderers.append(NumbaRenderer(streamer, threads=1))
        survey, days = renderers[0], renderers[1:]
        made = 0
        while made < count:
            pair = _pair(rng, scenes, info, survey, days[made * _FLIGHT_DAYS // count])
            if pair is not None:
                made += 1
                yield pair


def _pair(
    rng: np.random.Generator,
    scenes: SceneConfig,
    info: WorldInfo,
    survey: NumbaRenderer,
    day: NumbaRenderer,
) -> Pair | None:
    """One pair; None when the views leave the world or see too little in common."""
    camera = Camera.from_fov(scenes.width, scenes.height, rng.uniform(40, 85))
    pitch = np.radians(90 - 60 * rng.random() ** 1.4)
    height = float(np.exp(rng.uniform(np.log(55), np.log(220))))
    east, north = rng.uniform(-0.36, 0.36, 2) * info.size_m
    target = np.array([east, north, float(info.ground_height(east, north))])
    distance = height / np.sin(pitch)
    reference = look_at(target, distance, pitch, rng)
    query = moved(rng, reference, distance, scenes.motion)
    view = survey.render(reference, camera, wait=True)
    seen = day.render(query, camera, wait=True)
    if min((view.depth > 0).mean(), (seen.depth > 0).mean()) < 0.75:
        return None
    condition = draw_condition(rng)
    return Pair(
        coarser(view.rgb, draw_texel(rng)),
        view.depth,
        seen.rgb,
        seen.depth,
        reference,
        query,
        camera,
        condition,
        False,
        "world",
    )
