"""Targets against the truth: standing ones on plain ground and at edges, and moving cars.

    python -m benchmarks.targets SEED [--scenario FILE] [--json out.json]

Flies a scenario over the demo's generated world, which the first use makes, without pictures: the
poses err as a registration's do, the pixels as a detector's; an edge's pixel is within four of a
leap in depth. Rays are cast into the survey's finest tiles, truth is on those of today's world.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from benchmarks.common.arguments import Parser, existing, number, output, whole
from benchmarks.common.named_errors import named_errors
from benchmarks.targets.flights import (
    FlightStep,
    PoseErrors,
    Thing,
    heights_of,
    sightings,
    standing,
    steps,
)
from benchmarks.targets.report import FixSample, rows
from localizer.geometry.pose import Array
from localizer.map.cache.cache import TileCache
from localizer.map.cache.pick import MapSurface
from localizer.targets.track import TargetSettings, TargetTrack
from localizer.types import TargetFix
from sitl.camera.movers import traffic
from sitl.demo.assets import prepare
from sitl.demo.kinematic import camera_path
from sitl.demo.scenario import load_scenario

_SETTINGS = TargetSettings()
_LOOKED_S = 20.0  # at most: a target is looked at, then left
_NEW_S = 10.0  # out of sight for so long, a target is looked at anew


def measure(
    thing: Thing,
    flown: list[FlightStep],
    seen: MapSurface,
    known: MapSurface,
    args: argparse.Namespace,
) -> tuple[list[FixSample], int, int]:
    """The thing's fixes, how many sightings gave none, and how many there were."""
    rng = np.random.default_rng([args.draw, len(thing.name), hash_of(thing.name)])
    samples, refused, count = [], 0, 0
    track: TargetTrack | None = None
    began_ns = last_ns = 0
    for k, pixel in sightings(thing, flown, seen.cast, args.noise, rng):
        told = flown[k].told
        time_ns = told.exposure_time_ns
        if track is None or time_ns - last_ns > _NEW_S * 1e9:
            began_ns = time_ns
            track = TargetTrack(thing.name, _SETTINGS, known.cast)
        last_ns = time_ns
        if time_ns - began_ns > _LOOKED_S * 1e9:
            continue
        count += 1
        fix = track.observe(told, pixel)
        if fix is None:
            refused += 1
            continue
        samples.append(_sample(thing, k, (time_ns - began_ns) * 1e-9, fix))
    return samples, refused, count


def hash_of(name: str) -> int:
    """The same in every process."""
    return int.from_bytes(name.encode(), "little") % (1 << 31)


def _sample(thing: Thing, k: int, looked_s: float, fix: TargetFix) -> FixSample:
    error = fix.position_world - thing.positions[k]
    velocity_error, velocity_nees = float("nan"), float("nan")
    if fix.velocity is not None and fix.velocity_covariance is not None:
        off: Array = (fix.velocity - thing.velocities[k])[:2]
        velocity_error = float(np.linalg.norm(off))
        velocity_nees = float(off @ np.linalg.solve(fix.velocity_covariance[:2, :2], off))
    return FixSample(
        thing.name, thing.kind, looked_s, float(np.linalg.norm(error)),
        float(error @ np.linalg.solve(fix.covariance, error)),
        float(np.sqrt(np.trace(fix.covariance))), fix.elsewhere,
        fix.velocity is not None, velocity_error, velocity_nees, float(np.linalg.norm(error[:2])),
    )  # fmt: skip


def fly(args: argparse.Namespace) -> list[dict[str, object]]:
    """All targets of one seed; the file is written as they come."""
    assets, scenario = prepare(args.seed, size_m=args.size), load_scenario(args.scenario)
    if args.height is not None:
        scenario = heights_of(scenario, args.height)
    live, survey = TileCache.open(assets.live_cache), TileCache.open(assets.map_cache)
    camera = scenario.camera.camera()
    path = list(camera_path(scenario, float(assets.world.ground_height(0.0, 0.0))))
    every = max(1, round(50 / args.rate))
    rng = np.random.default_rng([args.draw, args.seed])
    errors = PoseErrors(args.pose_m, args.pose_deg, bias_m=(args.bias_m, 0.0))
    flown = steps(path[::every], camera, errors, rng)
    seen, known = MapSurface(live), MapSurface(survey)
    things = list(standing(flown, seen.cast, args.points, rng))
    times = [s.true.exposure_time_ns for s in flown]
    cars = traffic(assets.world, survey.frame, cars=args.cars, people=0, seed=args.seed)
    for car in cars:
        positions = np.array([car.position_at(t) for t in times])
        velocities = np.array([car.velocity_at(t) for t in times])
        things.append(Thing(car.name, "car", positions, velocities))
    samples: list[FixSample] = []
    refused = count = 0
    found: list[dict[str, object]] = []
    for thing in things:
        new, not_told, of = measure(thing, flown, seen, known, args)
        samples, refused, count = samples + new, refused + not_told, count + of
        found = rows(samples, refused, count)
        if args.json:
            document = {"arguments": vars(args), "rows": found}
            document["samples"] = [asdict(s) for s in samples]
            args.json.write_text(json.dumps(document, default=str))
    return found


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("seed", type=whole(0, 10**6), help="of the world, its cars and its points")
    parser.add_argument("--scenario", type=existing, default=Path("configs/demo_short.yaml"),
                        help="flight that is flown over it")  # fmt: skip
    parser.add_argument("--height", type=number(21, 1000), help="of all legs, m; none: its own")
    parser.add_argument("--size", type=number(100, 10_000), default=1600.0, help="of the world, m")
    parser.add_argument("--points", type=whole(0, 1000), default=20, help="plain, and at edges")
    parser.add_argument("--cars", type=whole(0, 200), default=10, help="in the world")
    parser.add_argument("--rate", type=number(0.5, 30), default=5.0, help="sightings per second")
    parser.add_argument("--noise", type=number(0, 50), default=1.0, help="of a pixel, px")
    parser.add_argument("--pose-m", type=number(0, 10), default=0.06, help="sigma per axis, m")
    parser.add_argument("--pose-deg", type=number(0, 5), default=0.025, help="likewise, degrees")
    parser.add_argument("--bias-m", type=number(0, 20), default=0.0, help="of every pose, east, m")
    parser.add_argument("--draw", type=whole(0, 10**6), default=0, help="of noise and points")
    parser.add_argument("--json", type=output, help="rows and every fix")
    for row in fly(parser.parse_args()):
        print(json.dumps(row))


if __name__ == "__main__":
    with named_errors():
        main()
