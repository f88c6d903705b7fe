"""Single clicks anywhere in the picture against the truth: how honest a first place is.

    python -m benchmarks.targets.clicks SEED [--clicks 1000] [--draw N] [--json out.json]

Poses of a scenario's flight over a generated world, erring as a registration's do; pixels drawn
over the picture's inner part, as an operator clicks; no pictures. Rays are cast into the survey's
finest tiles, truth is on those of today's world: trees have grown, buildings have come and gone.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.common.arguments import Parser, existing, number, output, whole
from benchmarks.common.named_errors import named_errors
from benchmarks.targets.flights import FlightStep, PoseErrors, heights_of, steps
from localizer.map.cache.cache import TileCache
from localizer.map.cache.surface import MapSurface
from localizer.targets.locate import RayCaster, ray_in_world
from localizer.targets.track import TargetSettings, TargetTrack
from sitl.demo.assets import prepare
from sitl.demo.kinematic import camera_path
from sitl.demo.scenario import load_scenario

_CHI2_95 = 7.815  # of three degrees of freedom
_RIM = 0.1  # of the picture: nobody clicks at what is about to leave it
_FAR_M = 3.0  # an error that an operator notices,
_SURE_M = 1.0  # told with so small a sigma
_PIXEL_SIGMA = 1.0  # of the operator's hand
_MIDDLE_M = 0.5  # of depth, within the ring about a pixel: the middle of a surface
_RING_M = 3.0
_RING = np.array([[np.cos(a), np.sin(a)] for a in np.arange(8) * np.pi / 4])


@dataclass(frozen=True)
class FirstPosition:
    """A click's first place. sigma_m: root of the trace; middle: the map shows one smooth surface
    about it; why: it was refused.
    """

    pixel: tuple[float, float]
    distance_m: float
    error_m: float
    sigma_m: float
    nees: float
    elsewhere: float
    middle: bool
    why: str = ""


def clicked(
    step: FlightStep, known: RayCaster, seen: RayCaster, rng: np.random.Generator
) -> FirstPosition | None:
    """One click into a frame; None where there is nothing today."""
    camera = step.true.camera
    size = np.array([camera.width, camera.height])
    pixel = (_RIM + (1 - 2 * _RIM) * rng.random(2)) * size
    u, v = pixel + rng.normal(0.0, _PIXEL_SIGMA, 2)
    eye, ray = ray_in_world(step.true, (float(pixel[0]), float(pixel[1])))
    distance = float(seen(eye, ray[None]).distances[0])
    if not np.isfinite(distance):
        return None
    track = TargetTrack("click", TargetSettings(confirm_s=0.0), known)
    fix = track.see(step.told, (float(u), float(v)))
    at, middle = (float(pixel[0]), float(pixel[1])), _is_middle(step, pixel, distance, known)
    if fix is None:
        nan = float("nan")
        return FirstPosition(at, distance, nan, nan, nan, nan, middle, track.refusal)
    off = fix.position_world - (eye + distance * ray)
    return FirstPosition(
        at, distance, float(np.linalg.norm(off)), float(np.sqrt(np.trace(fix.covariance))),
        float(off @ np.linalg.solve(fix.covariance, off)), fix.elsewhere, middle,
    )  # fmt: skip


def _is_middle(step: FlightStep, pixel: np.ndarray, distance: float, known: RayCaster) -> bool:
    """Whether the map's surface goes on smoothly for 3 m to all sides."""
    around = [pixel, *(pixel + _RING_M * step.true.camera.fx / distance * _RING)]
    eye = step.true.world_from_camera.translation
    rays = np.array([ray_in_world(step.true, (float(u), float(v)))[1] for u, v in around])
    points = eye + rays * known(eye, rays).distances[:, None]
    if not np.isfinite(points).all():
        return False
    middle = points - points.mean(axis=0)
    return bool(np.abs(middle @ np.linalg.svd(middle)[2][2]).max() <= _MIDDLE_M)


def row(kind: str, told: Sequence[FirstPosition]) -> dict[str, object]:
    """One line of figures."""
    kept = [t for t in told if not t.why]
    errors, sigmas = np.array([t.error_m for t in kept]), np.array([t.sigma_m for t in kept])
    wrong = (errors > _FAR_M) & (sigmas < _SURE_M)
    return {
        "clicks at": kind,
        "clicks": len(told),
        "refused": len(told) - len(kept),
        "p50_m": float(np.quantile(errors, 0.5)),
        "p95_m": float(np.quantile(errors, 0.95)),
        "max_m": float(errors.max()),
        "within_1_3_5_m_percent": [round(100 * float(np.mean(errors <= m)), 2) for m in (1, 3, 5)],
        "inside_95_percent": 100.0 * float(np.mean([t.nees <= _CHI2_95 for t in kept])),
        "sigma_m_p50": float(np.quantile(sigmas, 0.5)),
        "sigma_m_p95": float(np.quantile(sigmas, 0.95)),
        "beyond_3_m_with_sigma_below_1_m": int(wrong.sum()),
    }


def measure(args: argparse.Namespace) -> tuple[list[FirstPosition], list[dict[str, object]]]:
    """All clicks of one world, and their figures."""
    assets, scenario = prepare(args.seed, size_m=args.size), load_scenario(args.scenario)
    scenario = heights_of(scenario, args.height)
    live, survey = TileCache.open(assets.live_cache), TileCache.open(assets.map_cache)
    path = list(camera_path(scenario, float(assets.world.ground_height(0.0, 0.0))))
    rng = np.random.default_rng([args.draw, args.seed, 31])
    flown = steps(path[::50], scenario.camera.camera(), PoseErrors(args.pose_m, args.pose_deg), rng)
    known, seen = MapSurface(survey).cast, MapSurface(live).cast
    live_from_map = live.frame.ecef_from_enu.inverse @ survey.frame.ecef_from_enu

    def today(eye: np.ndarray, rays: np.ndarray) -> object:
        return seen(live_from_map.apply(eye), rays @ live_from_map.rotation.T)

    told = []
    for _ in range(args.clicks):
        step = flown[int(rng.integers(len(flown)))]
        one = clicked(step, known, today, rng)  # type: ignore[arg-type]
        if one is not None:
            told.append(one)
    kinds = {"all": told, "middle of a surface": [t for t in told if t.middle],
             "elsewhere": [t for t in told if not t.middle]}  # fmt: skip
    return told, [row(kind, some) for kind, some in kinds.items() if some]


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("seed", type=whole(0, 10**6), help="of the world, its flight and clicks")
    parser.add_argument("--scenario", type=existing, default=Path("configs/demo_short.yaml"),
                        help="flight that is flown over it")  # fmt: skip
    parser.add_argument("--height", type=number(21, 1000), default=110.0, help="of all legs, m")
    parser.add_argument("--size", type=number(100, 10_000), default=400.0, help="of the world, m")
    parser.add_argument("--clicks", type=whole(1, 10**6), default=1000, help="in all")
    parser.add_argument("--pose-m", type=number(0, 10), default=0.06, help="sigma per axis, m")
    parser.add_argument("--pose-deg", type=number(0, 5), default=0.025, help="likewise, degrees")
    parser.add_argument("--draw", type=whole(0, 10**6), default=0, help="of noise and clicks")
    parser.add_argument("--json", type=output, help="rows and every click")
    args = parser.parse_args()
    told, rows = measure(args)
    if args.json:
        plain = {k: str(v) if isinstance(v, Path) else v for k, v in vars(args).items()}
        document = {"arguments": plain, "rows": rows, "clicks": [asdict(t) for t in told]}
        args.json.write_text(json.dumps(document), encoding="utf-8")
    for line in rows:
        print(json.dumps(line))


if __name__ == "__main__":
    with named_errors():
        main()
