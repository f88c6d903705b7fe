"""A clicked car followed through two occlusions of two seconds, on rendered pictures.

    python -m benchmarks.targets.follow SEED [--draw N] [--seconds 60] [--json out.json]

A camera flies along with a car over today's generated world; two roofs that the map does not know
hide it. Poses err as a registration's do. Clicks and tracks are the companion's own; there is no
vehicle and no video link. A run passes when the car is reported until the end, as itself.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.common.arguments import Parser, number, output, whole
from benchmarks.common.named_errors import named_errors
from companion.config import TargetConfig
from companion.targets.detections import clicked_name
from companion.targets.target_manager import Click, TargetEstimate, TargetManager
from localizer.geometry.pose import Pose, so3_exp
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.map.cache.surface import MapSurface
from localizer.render.numba_raster import NumbaRenderer
from localizer.synth.appearance.model import sample_appearance
from localizer.targets.follow import Gray
from localizer.targets.track import projected
from localizer.types import PoseEstimate, RegistrationStatus, TrackingState, Visibility
from sitl.camera.traffic import traffic
from sitl.camera.true_motion import PoseTrack
from sitl.camera.world_camera import CameraOptions, WorldCamera
from sitl.demo.assets import FlightAssets, prepare
from sitl.demo.budget import draw_errors
from sitl.demo.scenario import Scenario
from sitl.operator.chase import CAR, Chase, make_chase, pursuit
from sitl.operator.followed import FollowedFix, follow_verdict

_BEFORE_S = 2.0  # pictures before the click
_CLICK_LATE_S = 0.25
_STEP_S = 0.02
_JPEG = 70  # what a video link leaves of a picture, about


@dataclass(frozen=True)
class PoseNoise:
    """One sigma per axis of what poses err by, wandering with tau_s."""

    position_m: float = 0.06
    rotation_deg: float = 0.025
    tau_s: float = 2.0


def camera_track(chase: Chase, begin_ns: int, end_ns: int, rng: np.random.Generator) -> PoseTrack:
    """The pursuer's camera: above and behind the car, swaying as a multirotor does."""
    track = PoseTrack(keep=None)
    sway = rng.normal(0, 1, 3)
    for k, time_ns in enumerate(range(begin_ns, end_ns, round(_STEP_S * 1e9))):
        t = k * _STEP_S
        eye = pursuit(chase.car, time_ns, 90.0, 25.0)
        eye = eye + 6.0 * np.array([np.sin(0.21 * t + sway[0]), np.sin(0.17 * t + sway[1]), 0.3])
        z = chase.car.position_at(time_ns) - eye + 4.0 * np.array([np.sin(0.5 * t), 0.0, 0.0])
        z /= np.linalg.norm(z)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        turn = so3_exp([0.01 * np.sin(1.7 * t), 0.01 * np.sin(1.3 * t + sway[2]), 0.0])
        track.add(time_ns, Pose(turn @ np.column_stack([x, np.cross(z, x), z]), eye))
    return track


def estimates(
    camera: WorldCamera, track: PoseTrack, times_ns: range, noise: PoseNoise,
    rng: np.random.Generator,
) -> Iterator[tuple[PoseEstimate, Gray]]:  # fmt: skip
    """Every picture (grey) with what a localizer would tell of it."""
    sigma = np.repeat([noise.position_m, np.radians(noise.rotation_deg)], 3)
    wander = rng.normal(0, sigma)
    keep = float(np.exp(-times_ns.step * 1e-9 / noise.tau_s))
    for time_ns in times_ns:
        exposure = camera.expose(time_ns, track)
        if exposure is None:
            continue
        wander = keep * wander + np.sqrt(1 - keep**2) * rng.normal(0, sigma)
        true = exposure.world_from_camera
        told = Pose(so3_exp(wander[3:]) @ true.rotation, true.translation + wander[:3])
        estimate = PoseEstimate(
            told, np.diag(sigma**2), 1.0, TrackingState.TRACKING, RegistrationStatus.OK, True,
            time_ns, 0, camera.camera,
        )  # fmt: skip
        _, jpeg = cv2.imencode(".jpg", exposure.image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG])
        decoded = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
        yield estimate, np.asarray(cv2.cvtColor(decoded, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def follow(args: argparse.Namespace) -> dict[str, object]:
    """One run; what came of it."""
    assets = prepare(args.seed, size_m=args.size)
    cache = TileCache.open(assets.map_cache)
    rng = np.random.default_rng([args.draw, args.seed])
    begin_ns = 10**9
    chase = make_chase(assets.world, cache.frame, begin_ns, _BEFORE_S, args.draw)
    end_ns = begin_ns + round((_BEFORE_S + args.seconds) * 1e9)
    track = camera_track(chase, begin_ns - 10**9, end_ns + 10**9, rng)
    streamer = TileStreamer(TileCache.open(assets.live_cache))
    told: list[TargetEstimate] = []
    texts: list[str] = []
    gone: list[str] = []
    population = TargetManager(
        TargetConfig(), MapSurface(cache).cast, told.append, gone.append,
        lambda _, text: texts.append(text),
    )  # fmt: skip
    clicked, aim = False, np.random.default_rng([args.draw, args.seed, 7])
    kept: list[PoseEstimate] = []
    try:
        camera = _camera(assets, chase, streamer, args.draw)
        times = range(begin_ns, end_ns, round(1e9 / args.rate))
        for estimate, gray in estimates(camera, track, times, PoseNoise(), rng):
            time_ns = estimate.exposure_time_ns
            kept.append(estimate)
            population.look(estimate, gray)
            population.hold(estimate)
            if not clicked and time_ns >= chase.begins_ns() + round(_CLICK_LATE_S * 1e9):
                clicked = True
                population.begin(_click(chase, kept, time_ns, aim))
    finally:
        streamer.close()
    fixes = [_fix(target) for target in told if target.fix.target_id == clicked_name(1)]
    verdict = follow_verdict(fixes, chase, end_ns, texts)
    return {"seed": args.seed, "draw": args.draw, **asdict(verdict)}


def _camera(assets: FlightAssets, chase: Chase, streamer: TileStreamer, draw: int) -> WorldCamera:
    cache, live = TileCache.open(assets.map_cache), TileCache.open(assets.live_cache)
    others = traffic(assets.world, cache.frame, cars=12, people=10, seed=draw)
    errors = draw_errors(Scenario(), draw)
    realism = replace(errors.realism, readout_ms=0.0)  # poses here are of a whole picture
    return WorldCamera(
        NumbaRenderer(streamer, threads=1),
        replace(errors.camera, readout_ms=0.0),
        sample_appearance(np.random.default_rng([draw, 11]), "day"),
        CameraOptions(
            (*chase.movers, *others),
            live.frame.ecef_from_enu.inverse @ cache.frame.ecef_from_enu,
            seed=draw,
            realism=realism,
        ),
    )


def _click(chase: Chase, kept: list[PoseEstimate], time_ns: int, rng: np.random.Generator) -> Click:
    """A point on the car in the picture that the operator saw, or a rectangle about it."""
    seen = min(kept, key=lambda e: abs(e.exposure_time_ns - time_ns + round(_CLICK_LATE_S * 1e9)))
    top = chase.car.position_at(seen.exposure_time_ns) + np.array([0.0, 0.0, 0.75])
    at = projected(seen, top)
    if at is None:
        raise ValueError(f"{CAR} is not in the picture when it is clicked at")
    u, v = np.array(at) + rng.normal(0, 1.5, 2)
    extent = (30.0, 30.0) if rng.random() < 0.5 else None
    return Click(1, seen, (float(u), float(v)), (), extent)


def _fix(target: TargetEstimate) -> FollowedFix:
    fix = target.fix
    return FollowedFix(
        fix.exposure_time_ns, fix.position_world, fix.covariance, fix.velocity,
        fix.velocity_covariance, fix.visibility is Visibility.SEEN,
    )  # fmt: skip


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("seed", type=whole(0, 10**6), help="of the world")
    parser.add_argument("--size", type=number(100, 10_000), default=1600.0, help="of the world, m")
    parser.add_argument("--draw", type=whole(0, 10**6), default=0, help="of car, errors and noise")
    parser.add_argument("--seconds", type=number(5, 70), default=60.0, help="after the click")
    parser.add_argument("--rate", type=number(0.5, 30), default=8.0, help="pictures per second")
    parser.add_argument("--json", type=output, help="the verdict and every error")
    args = parser.parse_args()
    document = follow(args)
    if args.json:
        Path(args.json).write_text(json.dumps(document, indent=1))
    print(json.dumps({k: v for k, v in document.items() if not isinstance(v, list | tuple)}))


if __name__ == "__main__":
    with named_errors():
        main()
