"""Generates worlds: `build_world` writes 3D Tiles 1.1 and the truth about the place."""

from __future__ import annotations

import json
import multiprocessing
import pickle
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from localizer.errors import MapSourceError
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Array
from localizer.synth.config import BLOCK_M, TOP_M, Variant, WorldConfig, look_of
from localizer.synth.plan.layout import plan_world
from localizer.synth.plan.planner import PlannedTarget, WorldPlan
from localizer.synth.plan.terrain import River, Terrain
from localizer.synth.tiles.bake import (
    Baker,
    TilePart,
    assemble_root,
    assemble_top,
    bake_block,
    start_worker,
)
from localizer.synth.tiles.scene import TileScene, make_scene
from localizer.synth.tiles.write import write_tileset
from localizer.synth.visits.visit import Visit

_FORMAT = 1
_INFO, _HEIGHTS = "world.json", "heights.npy"


@dataclass(frozen=True)
class WorldInfo:
    """Truth about a generated world besides its tiles.

    targets: named static points on surfaces, ENU. roads: right-hand lanes of the main roads as
    polylines (N, 3) ENU, longest first. buildings: how many stand there, sheds included.
    """

    seed: int
    variant: str
    size_m: float
    origin: Geodetic
    geoid_separation_m: float
    targets: tuple[PlannedTarget, ...]
    roads: tuple[Array, ...]
    buildings: int
    terrain: Terrain

    def ground_height(self, east: ArrayLike, north: ArrayLike) -> Array:
        """Terrain height (ENU z, metres); exact on the finest tiles."""
        return self.terrain.height(east, north)

    @property
    def frame(self) -> LocalFrame:
        """The ENU frame of the world."""
        return LocalFrame(self.origin)

    def save(self, folder: Path) -> None:
        """Write world.json and the terrain grid to an existing folder."""
        document = {
            "format": _FORMAT,
            "seed": self.seed,
            "variant": self.variant,
            "size_m": self.size_m,
            "origin": asdict(self.origin),
            "geoid_separation_m": self.geoid_separation_m,
            "buildings": self.buildings,
            "terrain_spacing_m": self.terrain.spacing_m,
            "targets": [{"name": t.name, "enu_m": t.position.tolist()} for t in self.targets],
            "roads_enu_m": [np.round(r, 3).tolist() for r in self.roads],
        }
        np.save(folder / _HEIGHTS, self.terrain.heights)
        (folder / _INFO).write_text(json.dumps(document, indent=1))

    @classmethod
    def load(cls, folder: Path) -> WorldInfo:
        """Read what `save` wrote; the terrain is without its river. `MapSourceError` if a file is
        missing, malformed or of another format.
        """
        path = Path(folder) / _INFO
        try:
            data = json.loads(path.read_text())
            heights = np.load(Path(folder) / _HEIGHTS)
            if data["format"] != _FORMAT:
                raise MapSourceError(
                    f"{path}: format {data['format']}, expected {_FORMAT}; build the world again"
                )
            none = River(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
            return cls(
                seed=int(data["seed"]),
                variant=str(data["variant"]),
                size_m=float(data["size_m"]),
                origin=Geodetic(**data["origin"]),
                geoid_separation_m=float(data["geoid_separation_m"]),
                targets=tuple(
                    PlannedTarget(t["name"], np.array(t["enu_m"], float)) for t in data["targets"]
                ),
                roads=tuple(np.array(r, float).reshape(-1, 3) for r in data["roads_enu_m"]),
                buildings=int(data["buildings"]),
                terrain=Terrain(heights, float(data["terrain_spacing_m"]), none),
            )
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise MapSourceError(
                f"{path}: not a generated world ({error}); build it with `companion world build`"
            ) from error


def world_origin(config: WorldConfig) -> Geodetic:
    """Geodetic origin of a seed's world, on the Swiss plateau."""
    rng = config.rng(3)
    latitude = 47.4 + float(rng.uniform(-0.2, 0.2))
    longitude = 8.5 + float(rng.uniform(-0.4, 0.4))
    return Geodetic(round(latitude, 6), round(longitude, 6), round(450 + rng.uniform(-60, 90), 1))


def build_world(
    seed: int,
    out: Path,
    *,
    variant: Variant = "survey",
    size_m: float = 1600.0,
    processes: int = 2,
) -> WorldInfo:
    """Generate a world and write it to the folder `out` as tileset.json, GLB tiles and world.json;
    those already there are deleted first.

    variant: "survey" is what the map shows, "live" the same place at another visit. processes:
    number that paint in parallel; more than one needs the usual ``if __name__ == "__main__"`` guard
    in a script.
    """
    visit = Visit(variant, look_of(variant))
    return build_visits(WorldConfig(seed, size_m), {Path(out): visit}, processes)[0]


def build_visits(
    config: WorldConfig,
    visits: dict[Path, Visit],
    processes: int = 2,
    progress: Callable[[float], None] = lambda _: None,
) -> list[WorldInfo]:
    """Generate visits to one world, each as by `build_world` in its folder; the plan is made once.

    progress: called with the share of the work that is done, 0 to 1.
    """
    plan = plan_world(config)
    infos = []
    for number, (folder, visit) in enumerate(visits.items()):
        info = _info(plan, visit.name)
        for share in _write_visit(plan, visit, folder, info, processes):
            progress((number + share) / len(visits))
        infos.append(info)
    return infos


def _info(plan: WorldPlan, variant: str) -> WorldInfo:
    config = plan.config
    return WorldInfo(
        seed=config.seed,
        variant=variant,
        size_m=config.size_m,
        origin=world_origin(config),
        geoid_separation_m=config.geoid_separation_m,
        targets=plan.targets,
        roads=plan.roads,
        buildings=len(plan.buildings),
        terrain=plan.terrain,
    )


def _write_visit(
    plan: WorldPlan, visit: Visit, folder: Path, info: WorldInfo, processes: int
) -> Iterator[float]:
    """Writes a visit; yields the share of it that is painted."""
    folder.mkdir(parents=True, exist_ok=True)
    for stale in (*folder.glob("*.glb"), folder / "tileset.json", folder / _INFO):
        stale.unlink(missing_ok=True)
    scene = make_scene(plan, visit)
    baker = Baker(scene, folder)
    count = round(plan.config.size_m / BLOCK_M)
    places = [(column, row) for row in range(count) for column in range(count)]
    waiting: dict[tuple[int, int], list[TilePart]] = defaultdict(list)
    tops: dict[tuple[int, int], TilePart] = {}
    per_top = round(TOP_M / BLOCK_M)
    with painted_blocks(scene, folder, places, processes) as done:
        for number, ((column, row), part) in enumerate(done, start=1):
            yield number / len(places)
            key = (column // per_top, row // per_top)
            waiting[key].append(part)
            if len(waiting[key]) == per_top**2:
                parts = sorted(waiting.pop(key), key=lambda p: (p.north, p.west))
                tops[key] = assemble_top(baker, *key, parts)
    root = assemble_root(baker, [tops[key] for key in sorted(tops)])
    extras = {"geoid_separation_m": info.geoid_separation_m, "generator_seed": info.seed}
    write_tileset(folder / "tileset.json", root, info.frame.ecef_from_enu, extras)
    info.save(folder)


@contextmanager
def painted_blocks(
    scene: TileScene, folder: Path, places: list[tuple[int, int]], processes: int
) -> Iterator[Iterable[tuple[tuple[int, int], TilePart]]]:
    """Context manager: iterates over (block, its part) as finished, here or in a pool."""
    if processes <= 1:
        baker = Baker(scene, folder)
        yield ((place, baker.block(*place)) for place in places)
        return
    with tempfile.TemporaryDirectory() as temporary:
        scene_file = Path(temporary) / "scene.pickle"
        scene_file.write_bytes(pickle.dumps(scene, pickle.HIGHEST_PROTOCOL))
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(
            processes, context, initializer=start_worker, initargs=(scene_file, folder)
        ) as pool:
            try:
                futures = [pool.submit(bake_block, place) for place in places]
                yield (future.result() for future in as_completed(futures))
            except BaseException:  # interrupted, say: nobody wants the blocks that wait
                pool.shutdown(wait=False, cancel_futures=True)
                raise
