"""Relocalization in motion: search, trial and confirmation over generated flights, as in flight.

    python -m benchmarks.relocalization.motion FOLDER --set generated --trials 400 --out out.json
    python -m benchmarks.relocalization.motion FOLDER --set elsewhere --trials 200 --out wrong.json
    python -m benchmarks.relocalization.motion --report out.json wrong.json [--json shares.json]

FOLDER keeps the worlds of `python -m benchmarks.basin` and `benchmarks.integrity`. Each trial is a
flight that knows no place, at 5 to 12 m/s, 55 to 150 m above ground, under drawn weather, seen on
another day than the map's: up to five successive frames, half a second apart, are searched until
one is found; the position becomes tentative in the localizer that flies (`Localizer.offer`), which
tracks the frames that follow, four a second, until its independent evidence confirms or refutes it.
Even trials know a region of 100 m, odd ones search the whole map; every second pair of trials has
the inertial way beside it. The errors of autopilot and gimbal (tilt 0.7 degrees, heading 5) stay
the same for a trial. Given out: poses that would be injected; false: more than 5 m off, or anywhere
on the map "elsewhere", where the flight is not. --attitude: roll, pitch and yaw constrain each
registration, too (`localizer.attitude`). A run with --out goes on where the last one ended.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.basin.views import SIZE, ground_height
from benchmarks.common.arguments import Parser, existing, number, output, whole
from benchmarks.common.deadline import deadline
from benchmarks.common.figures import show_figures
from benchmarks.common.named_errors import named_errors
from benchmarks.common.shares import exact_interval
from benchmarks.odometry.stretches import StretchPlan, TestStretch, make_stretch
from benchmarks.relocalization.run import RIGHT_DEG, RIGHT_M, with_threads
from localizer.config import LocalizerConfig
from localizer.errors import OutsideMapError
from localizer.evaluation.places import SimulatedPlaceData
from localizer.features.detail import DetailExtractor
from localizer.features.extractor import load_extractor
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose, so3_exp
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.registration.jngo import JNGO
from localizer.relocalization.relocalizer import Relocalizer, open_relocalizer
from localizer.relocalization.types import PlaceQuery, SearchRegion
from localizer.render.numba_raster import NumbaRenderer
from localizer.synth.appearance.model import (
    CONDITIONS,
    Appearance,
    apply_appearance,
    limit_haze,
    sample_appearance,
)
from localizer.tracking.attitude_bias import AttitudePrior
from localizer.tracking.motion import AuxiliarySensors
from localizer.tracking.pipeline import Localizer
from localizer.training.data.pairs import soften
from localizer.types import Frame, PosePrior, TrackingState

# Of a set: the map that is searched, the world that is seen, how far from the middle it is flown.
SETS = {
    "generated": ("generated/2000001/survey.cache", "generated/2000001/day.cache", 230.0),
    "unseen": ("generated/2000002/survey.cache", "generated/2000002/day.cache", 230.0),
    "unseen_2": ("generated/2000003/survey.cache", "generated/2000003/day.cache", 230.0),
    "quito": ("quito/map.cache", "quito/map.cache", 110.0),
    "roofs": ("roofs/map.cache", "roofs/map.cache", 120.0),
    "forest": ("forest/map.cache", "forest/map.cache", 120.0),
    "elsewhere": ("generated/2000000/survey.cache", "generated/2000001/day.cache", 230.0),
}
SEARCHED = 5  # successive frames
FRAME_S, _SEARCH_FRAMES = 0.25, 2  # half a second from one searched frame to the next
_FRAMES = 40
_AFTER = 3  # frames given out after the confirmation
_FALSE_M = 5.0
_REGION_M, _REGION_OFF_M = 100.0, 70.0
_TILT_DEG, _HEADING_DEG = 0.7, 5.0  # sigmas of autopilot and gimbal
_SPEED_SIGMA, _LEAST_SIGMA_M = 0.5, 0.5  # of the inertial way: m/s, m
PLACE_SIGMA = np.repeat([2.0, np.radians(1.0)], 3)  # of a found place, as in flight
_BYTES = 128 * 2**20


@dataclass(frozen=True)
class TrialOutcome:
    """One trial. searches: frames searched; found_at: number of the first one whose answer was
    within 3 m and 3 degrees, 0 without; wrong: answers that were not; confirmed_s: from the first
    frame to TRACKING, None without; given: poses given out, false: of these; worst_m: the farthest,
    median_m: in the middle.
    """

    set: str
    trial: int
    condition: str
    heading_known: bool
    region: bool
    inertial: bool
    height_m: float
    searches: int
    found_at: int
    wrong: int
    confirmed_s: float | None
    given: int
    false: int
    worst_m: float | None
    cpu_s: float
    median_m: float | None = None


@dataclass(frozen=True)
class TrialSite:
    """What a set's trials share. elsewhere: the flight is not on the map that is searched."""

    name: str
    half_m: float
    elsewhere: bool
    seen: NumbaRenderer
    known: NumbaRenderer
    relocalizer: Relocalizer
    extractor: DetailExtractor
    optimizer: JNGO
    config: LocalizerConfig


class LostTrial:
    """One flight without a place, until it is found and confirmed, or not."""

    frames, heights_m = _FRAMES, (55.0, 150.0)

    def __init__(self, site: TrialSite, index: int, heading_known: bool) -> None:
        self._site, self._index = site, index
        rng = np.random.default_rng((71, index))
        self._rng = rng
        self._camera = Camera.from_fov(*SIZE, float(rng.uniform(50, 80)))
        self.condition = CONDITIONS[index % len(CONDITIONS)]
        self._known = SimulatedPlaceData(prior=False, heading=heading_known, seed=index)
        self.height_m = float(np.exp(rng.uniform(*np.log(self.heights_m))))
        half = (site.half_m, site.half_m)
        speed = float(rng.uniform(5, 12))
        plan = StretchPlan(self.frames * FRAME_S, 1 / FRAME_S, speed, self.height_m, half)
        ground = ground_height(site.seen, np.array([*rng.uniform(-1, 1, 2) * 0.5 * half[0], 0.0]))
        self._way: TestStretch = make_stretch(plan, self.condition, 5_000 + index, ground)
        self._look: Appearance = sample_appearance(rng, self.condition)
        self._off = np.radians(rng.normal(0, [_TILT_DEG, _TILT_DEG, _HEADING_DEG]))
        self.region, self.inertial = index % 2 == 0, index // 2 % 2 == 0
        self._drift: Array = rng.normal(0, _SPEED_SIGMA, 3)
        angle = rng.uniform(0, 2 * np.pi)
        off = _REGION_OFF_M * rng.random() * np.array([np.cos(angle), np.sin(angle)])
        self._centre: Array = self._way.poses[0].translation[:2] + off

    def run(self) -> TrialOutcome:
        """Search, try, confirm."""
        began = time.process_time()
        site, camera = self._site, self._camera
        sensors = AuxiliarySensors(self._rotation, self._displacement)
        localizer = Localizer(
            site.known, site.extractor, site.optimizer, camera, site.config, sensors
        )
        searches = found_at = wrong = 0
        confirmed_s: float | None = None
        errors: list[float] = []
        k, proposed, left = 0, False, _AFTER
        while k < len(self._way.poses) - _SEARCH_FRAMES and left:
            frame = self._frame(k)
            if localizer.tracker.track_status.wants_prior and not proposed:
                if searches == SEARCHED:
                    break
                searches += 1
                found = site.relocalizer.find(self._query(frame, k))
                if found is not None:
                    metres, degrees = found.world_from_camera.distance_to(self._way.poses[k])
                    right = metres <= RIGHT_M and degrees <= RIGHT_DEG and not site.elsewhere
                    wrong += not right
                    found_at = found_at or searches * right
                    covariance = found.covariance + np.diag(PLACE_SIGMA**2)
                    velocity = self._way.velocity + self._drift
                    localizer.offer(
                        PosePrior(found.world_from_camera, covariance, frame.exposure_time_ns,
                                  velocity, independent=False)
                    )  # fmt: skip
                    proposed = True
                k += _SEARCH_FRAMES
                continue
            proposed = False
            try:
                estimate = localizer.track(frame)
            except OutsideMapError:
                k += 1
                continue
            if estimate.accepted:
                far, _ = estimate.world_from_camera.distance_to(self._way.poses[k])
                errors.append(float("inf") if site.elsewhere else far)
            if localizer.tracker.track_status.state is TrackingState.TRACKING:
                confirmed_s = k * FRAME_S if confirmed_s is None else confirmed_s
                left -= 1
            k += 1
        return TrialOutcome(
            site.name, self._index, self.condition, self._known.heading, self.region,
            self.inertial, self.height_m, searches, found_at, wrong, confirmed_s, len(errors),
            sum(e > _FALSE_M for e in errors), min(max(errors), 1e6) if errors else None,
            time.process_time() - began, min(float(np.median(errors)), 1e6) if errors else None,
        )  # fmt: skip

    def _query(self, frame: Frame, k: int) -> PlaceQuery:
        query = self._known.query(frame, self._way.poses[k], self._index)
        if not self.region or self._site.elsewhere:
            return query
        return replace(query, region=SearchRegion.circle(self._centre, _REGION_M))

    def _rotation(self, time_ns: int) -> Array:
        """By autopilot and gimbal, at the nearest frame."""
        k = int(np.clip(round(time_ns * 1e-9 / FRAME_S) - 1, 0, len(self._way.poses) - 1))
        return so3_exp(self._off) @ self._way.poses[k].rotation

    def _displacement(self, begin_ns: int, end_ns: int) -> tuple[Array, float] | None:
        if not self.inertial:
            return None
        first, last = (round(t * 1e-9 / FRAME_S) - 1 for t in (begin_ns, end_ns))
        seconds = (end_ns - begin_ns) * 1e-9
        way = self._way.poses[last].translation - self._way.poses[first].translation
        return way + self._drift * seconds, _LEAST_SIGMA_M + _SPEED_SIGMA * seconds

    def _frame(self, k: int) -> Frame:
        """What the camera sees at pose k, exposed at (k + 1) frame times."""
        pose: Pose = self._way.poses[k]
        view = self._site.seen.render(pose, self._camera, wait=True)
        look = limit_haze(self._look, view.depth)
        image = apply_appearance(soften(self._rng, view.rgb), view.depth, look, self._rng)
        return Frame(image, self.time_ns(k), self._camera, k)

    @staticmethod
    def time_ns(k: int) -> int:
        """Of the exposure."""
        return round((k + 1) * FRAME_S * 1e9)


def open_site(name: str, folder: Path, config: LocalizerConfig, stack: ExitStack) -> TrialSite:
    """The set's map and world, with one relocalizer and one tracker's parts for all trials."""
    searched, seen, half_m = SETS[name]
    opened = open_relocalizer(TileCache.open(folder / searched), config)
    if opened is None:
        raise RuntimeError("an overview that nobody stopped was not made")
    relocalizer = stack.enter_context(opened)

    def renderer(path: str) -> NumbaRenderer:
        cache = TileCache.open(folder / path)
        streamer = stack.enter_context(TileStreamer(cache, byte_budget=_BYTES))
        return NumbaRenderer(streamer, 1)

    extractor = DetailExtractor(load_extractor(config.model, threads=1))
    optimizer = JNGO(config.registration, threads=1)
    elsewhere = name == "elsewhere"
    return TrialSite(
        name, half_m, elsewhere, renderer(seen), renderer(searched), relocalizer, extractor,
        optimizer, config,
    )  # fmt: skip


def run(
    site: TrialSite, kept: list[TrialOutcome], first: int, trials: int, heading_known: bool,
    more_time: Callable[[], bool], save: Callable[[list[TrialOutcome]], None],
) -> list[TrialOutcome]:  # fmt: skip
    """The trials from number `first` on that `kept` lacks, as long as there is time."""
    done = {(o.set, o.trial, o.heading_known) for o in kept}
    for index in range(first, first + trials):
        if (site.name, index, heading_known) in done:
            continue
        if not more_time():
            break
        kept.append(LostTrial(site, index, heading_known).run())
        save(kept)
    return kept


def share(hits: int, count: int) -> dict[str, float]:
    """With its exact 95 % interval, per cent."""
    low, high = exact_interval(hits, count)
    return {"hits": hits, "count": count, "low": low, "high": high}


def shares(outcomes: Sequence[TrialOutcome]) -> list[dict[str, object]]:
    """One row for each set, heading and light (day, or all), and one for all trials."""
    rows: list[dict[str, object]] = []
    groups = [(o.set, o.heading_known) for o in outcomes]
    for group in [*dict.fromkeys(groups), None]:
        mine = [o for o, own in zip(outcomes, groups, strict=True) if group in (own, None)]
        for light in ("day", "all"):
            some = [o for o in mine if light in (o.condition, "all")]
            rows.append(
                {
                    "set": "all" if group is None else group[0],
                    "heading": "any" if group is None else "15" if group[1] else "unknown",
                    "light": light,
                    "trials": len(some),
                    "found_in_first": share(sum(o.found_at == 1 for o in some), len(some)),
                    "found_within_5": share(sum(o.found_at > 0 for o in some), len(some)),
                    "confirmed": share(sum(o.confirmed_s is not None for o in some), len(some)),
                    "wrong_answers": sum(o.wrong for o in some),
                    "given": sum(o.given for o in some),
                    "false_given": sum(o.false for o in some),
                    "trials_with_false": share(sum(o.false > 0 for o in some), len(some)),
                    "cpu_s_p50": float(np.median([o.cpu_s for o in some])) if some else None,
                }
            )
    return rows


COLUMNS = (
    "set", "heading", "light", "flights", "found in the first frame", "within five", "confirmed",
    "flights with a false pose given out", "poses given, false", "search's wrong answers",
)  # fmt: skip


def cells(rows: Sequence[dict[str, object]]) -> list[tuple[str, ...]]:
    """As they are printed, a line for each of `shares`."""
    names = ("found_in_first", "found_within_5", "confirmed", "trials_with_false")
    made = []
    for row in rows:
        told = []
        for name in names:
            value = row[name]
            assert isinstance(value, dict)
            told.append(f"{value['hits']} [{value['low']:.1f}, {value['high']:.1f}]")
        made.append(
            (
                str(row["set"]), str(row["heading"]), str(row["light"]), str(row["trials"]), *told,
                f"{row['given']}, {row['false_given']}", str(row["wrong_answers"]),
            )
        )  # fmt: skip
    return made


def main() -> None:
    p = Parser(__doc__)
    p.add_argument("folder", type=existing, nargs="?", help="of worlds and maps")
    p.add_argument("--set", choices=list(SETS), default="generated", help="where it is flown")
    p.add_argument("--trials", type=whole(1, 100_000), default=100, help="how many")
    p.add_argument("--first", type=whole(0, 100_000), default=0, help="number of the first")
    p.add_argument("--heading", choices=("known", "unknown"), default="known", help="to 15 degrees")
    p.add_argument("--attitude", action="store_true", help="as a constraint of each registration")
    p.add_argument("--minutes", type=number(0.1, 1e4), default=1e4, help="until it pauses")
    p.add_argument("--out", type=output, help="JSON of every outcome")
    p.add_argument("--report", type=existing, nargs="+", help="table of earlier files, no run")
    p.add_argument("--json", type=output, help="the table's rows")
    args = p.parse_args()
    if args.report:
        kept = [TrialOutcome(**row) for path in args.report for row in json.loads(path.read_text())]
    else:
        if args.folder is None:
            p.error("FOLDER is missing")
        kept = []
        if args.out and args.out.exists():
            kept = [TrialOutcome(**row) for row in json.loads(args.out.read_text())]

        def save(outcomes: list[TrialOutcome]) -> None:
            if args.out:  # after each one: an interrupted run keeps what it has
                args.out.write_text(json.dumps([asdict(o) for o in outcomes], indent=1))

        more_time = deadline(args.minutes)
        with ExitStack() as stack:
            attitude = AttitudePrior() if args.attitude else None
            config = with_threads(LocalizerConfig(attitude=attitude), 1)
            site = open_site(args.set, args.folder, config, stack)
            known = args.heading == "known"
            run(site, kept, args.first, args.trials, known, more_time, save)
    rows = shares(kept)
    show_figures(args.json, COLUMNS, cells(rows), {"shares": rows})


if __name__ == "__main__":
    with named_errors():
        main()
