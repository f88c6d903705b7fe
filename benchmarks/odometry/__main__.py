"""Drift of the visual odometry over unseen stretches, and whether its covariance is honest.

    python -m benchmarks.odometry MAP [--seen CACHE] [--terrain WORLD] [--json out.json]
    python -m benchmarks.odometry --report out.json more.json [--json kept.json]

MAP is a tile cache whose geometry is known; the camera sees the cache --seen (the same place on
another day), under made light. Depth "map": from MAP's geometry; "ground": the map has neither
picture nor geometry, but the terrain's height (--terrain: folder of the generated world; without
it a plane at the height of the ground where the map was last seen) and the barometer; "plane": that
plane in any case; "range": a rangefinder's account of the ground instead (what lies straight below,
scale 1 %, noise 0.1 m, a tenth of its readings lost). Nothing of the map's picture is used by any.
Drift is the horizontal error at the end of a stretch.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from benchmarks.common.arguments import Parser, existing, number, output, whole
from benchmarks.common.figures import show_figures
from benchmarks.common.named_errors import named_errors
from benchmarks.odometry.flights import DEPTHS, FlownScene, FlownStretch, Flyer, OdometryStep
from benchmarks.odometry.report import fitted_growth, rows
from benchmarks.odometry.stretches import StretchPlan, make_stretch, start, working_pinhole
from localizer.features.detail import DetailExtractor
from localizer.features.extractor import load_extractor
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.map.inspection.kind import map_kind
from localizer.map.terrain import ground_uncertainty
from localizer.odometry.config import GrowthModel, OdometryConfig
from localizer.registration.jngo import JNGO
from localizer.render.base import MapRenderer
from localizer.render.numba_raster import NumbaRenderer
from localizer.synth.world import WorldInfo
from localizer.types import GroundUncertainty

_HIGH_M = 1500.0
_GROWTHS = ("with_map", "with_ground", "with_range", "with_plane")
_NONE = GrowthModel(scale=0.0, horizontal=0.0, vertical=0.0, tilt=0.0, heading=0.0)


@dataclass(frozen=True)
class _Terrain:
    """A generated world's terrain in the map's frame, whose origin may be at another height."""

    info: WorldInfo
    offset_m: float

    def height(self, east: ArrayLike, north: ArrayLike) -> Array:
        """See `localizer.odometry.ground.TerrainModel`."""
        return np.asarray(self.info.ground_height(east, north)) + self.offset_m


def surface_height(renderer: MapRenderer, place: Array) -> float:
    """Height of the map at east and north (2,), from a small view straight down."""
    top = Pose(np.diag([1.0, -1.0, -1.0]), np.array([*place, _HIGH_M]))
    depth = renderer.render(top, Camera.from_fov(16, 16, 4.0), wait=True).depth
    seen = depth[depth > 0]
    return _HIGH_M - float(np.quantile(seen, 0.7)) if len(seen) else 0.0


def fly(args: argparse.Namespace, known: TileStreamer, seen: TileStreamer) -> list[FlownStretch]:
    """All stretches; the file is written after each, so that what was flown is not lost."""
    camera = working_pinhole(args.width)
    terrain = None
    if args.terrain is not None:
        info = WorldInfo.load(args.terrain)
        terrain = _Terrain(info, info.origin.height_m - known.cache.frame.origin.height_m)
    renderers = NumbaRenderer(seen, 1), NumbaRenderer(known, 1)
    unknown = ground_uncertainty(known.cache.index, map_kind(known.cache))
    if args.fit:
        unknown = GroundUncertainty(0.0, 0.0, 0.0)
    scene = FlownScene(args.map.parent.name, *renderers, camera, terrain, unknown)
    extractor = DetailExtractor(load_extractor(threads=1, size=(camera.width, camera.height)))
    config = OdometryConfig()
    if args.fit:
        config = OdometryConfig(
            with_map=_NONE, with_ground=_NONE, with_range=_NONE, with_plane=_NONE
        )
    flyer = Flyer(scene, extractor, JNGO(threads=args.threads), config)
    plan = StretchPlan(args.seconds, args.rate, args.speed, args.height, tuple(args.half))
    flown: list[FlownStretch] = []
    for k in range(args.stretches):
        for index, condition in enumerate(args.conditions):
            seed = args.seed + k * len(args.conditions) + index
            ground = surface_height(scene.known, start(plan, seed)[0])
            flown += flyer.fly(make_stretch(plan, condition, seed, ground), tuple(args.depths))
            for one in flown[-len(args.depths) :]:
                last = one.steps[-1]
                print(
                    f"{one.place} {one.condition:6s} seed {one.seed} depth {one.depth:6s} "
                    f"{last.flown_m:4.0f} m: {np.hypot(last.error[0], last.error[1]):5.2f} m, "
                    f"{last.status}, told {last.drift_m:.2f} m",
                    flush=True,
                )
            if args.json:
                document = {"arguments": vars(args), "rows": rows(flown)}
                document["flown"] = [asdict(f) for f in flown]
                args.json.write_text(json.dumps(document, default=str))
    return flown


def read(path: Path) -> list[FlownStretch]:
    """The stretches of an earlier run's file."""
    return [
        FlownStretch(**{**f, "steps": tuple(OdometryStep(**step) for step in f["steps"])})
        for f in json.loads(path.read_text())["flown"]
    ]


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("map", type=existing, nargs="?", help="tile cache of known geometry")
    parser.add_argument("--report", type=existing, nargs="+", help="rows of earlier files, no run")
    parser.add_argument("--seen", type=existing, help="tile cache that the camera sees; none: MAP")
    parser.add_argument("--terrain", type=existing, help="folder of the generated world")
    parser.add_argument("--stretches", type=whole(1, 1000), default=5, help="of each condition")
    parser.add_argument("--conditions", nargs="+", default=["day", "dusk", "night"], help="light")
    parser.add_argument("--depths", nargs="+", choices=DEPTHS, default=["map", "ground"],
                        help="sources of depth, over the same pictures")  # fmt: skip
    parser.add_argument("--seconds", type=number(1, 600), default=60.0, help="of each stretch")
    parser.add_argument("--rate", type=number(0.5, 30), default=10.0, help="frames per second")
    parser.add_argument("--speed", type=number(1, 40), default=10.0, help="m/s")
    parser.add_argument("--height", type=number(20, 1000), default=110.0, help="m above ground")
    parser.add_argument("--half", nargs=2, type=number(50, 20_000), default=[600.0, 600.0],
                        help="m east and north of the origin that are flown over")  # fmt: skip
    parser.add_argument("--width", type=whole(64, 1024), default=320, help="working width, px")
    parser.add_argument("--threads", type=whole(1, 64), default=2, help="of the optimizer")
    parser.add_argument("--seed", type=whole(0, 10**6), default=100, help="of the first stretch")
    parser.add_argument("--fit", action="store_true", help="fly without growth, print what fits")
    parser.add_argument("--json", type=output, help="rows and every step")
    args = parser.parse_args()
    if args.report:
        kept = [f for path in args.report for f in read(path)]
        together = rows([replace(f, place="all") for f in kept])
        cells = [
            [f"{v:.2f}" if isinstance(v, float) else str(v) for v in row.values()]
            for row in together
        ]
        show_figures(args.json, tuple(together[0]), cells)
        return
    if args.map is None:
        parser.error("MAP is missing")
    with (
        TileStreamer(TileCache.open(args.map)) as known,
        TileStreamer(TileCache.open(args.seen or args.map)) as seen,
    ):
        flown = fly(args, known, seen)
    for row in rows(flown):
        print(json.dumps(row))
    if args.fit:
        for depth in args.depths:
            print(depth, fitted_growth([f for f in flown if f.depth == depth]))


if __name__ == "__main__":
    with named_errors():
        main()
