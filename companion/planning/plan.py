"""Forecast of a whole mission; alternatives for failing legs by the same forecast: other heights,
gimbal angles and headings.
"""

from __future__ import annotations

import itertools
import os
import queue
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from pathlib import Path
from statistics import median

import numpy as np

from companion.config import CompanionConfig
from companion.geometry import Mount
from companion.planning.mission import PlannedMission
from companion.planning.verdicts import (
    LegVerdict,
    MissionLimits,
    SampleVerdict,
    VisionGap,
    sample_verdict,
    stretches,
)
from companion.planning.way import (
    Aim,
    FlightLeg,
    MapHeights,
    PathSample,
    camera_pose,
    legs_of,
    length_m,
)
from localizer.features.detail import DetailExtractor
from localizer.features.extractor import load_extractor
from localizer.forecast.forecast import Forecaster
from localizer.geometry.pose import Array
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.map.inspection.kind import map_kind
from localizer.odometry.config import OdometryConfig
from localizer.registration.jngo import JNGO
from localizer.render.numba_raster import NumbaRenderer

Progress = Callable[[int, int], None]
_MOST_THREADS = 8


class Surveyor:
    """Forecasts path samples in threads; create it by `surveyor`.

    Each thread uses its own forecaster, because a renderer, network or optimizer serves one thread
    at a time.
    """

    def __init__(
        self,
        cache: TileCache,
        aim: Aim,
        conditions: tuple[str, ...],
        limits: MissionLimits,
        forecasters: Sequence[Forecaster],
    ) -> None:
        self._cache, self._aim = cache, aim
        self._conditions, self._limits = conditions, limits
        self._idle: queue.SimpleQueue[Forecaster] = queue.SimpleQueue()
        for forecaster in forecasters:
            self._idle.put(forecaster)
        self._threads = len(forecasters)

    def verdicts(
        self, samples: Sequence[PathSample], progress: Progress | None = None
    ) -> list[SampleVerdict]:
        """Forecast the samples under all conditions, in their order; deterministic."""
        made = []
        with ThreadPoolExecutor(self._threads, "forecast") as pool:
            for done, judged in enumerate(pool.map(self._one, itertools.count(), samples), 1):
                made.append(judged)
                if progress is not None:
                    progress(done, len(samples))
        return made

    def _one(self, number: int, sample: PathSample) -> SampleVerdict:
        pose = camera_pose(sample, self._cache, self._aim)
        forecaster = self._idle.get()
        try:
            return sample_verdict(
                sample, forecaster.at(pose, self._conditions, number), self._limits
            )
        finally:
            self._idle.put(forecaster)


@contextmanager
def surveyor(
    cache: TileCache,
    deployment: CompanionConfig,
    aim: Aim,
    conditions: tuple[str, ...],
    limits: MissionLimits,
) -> Iterator[Surveyor]:
    """Context manager: a surveyor over an open map, one thread per available processor.

    It computes on the CPU, so that every machine forecasts alike.
    """
    threads = min(len(os.sched_getaffinity(0)), _MOST_THREADS)
    config, camera = deployment.localizer, deployment.camera.model.camera()
    forecasters = []
    with ExitStack() as stack:
        for _ in range(threads):
            budget = config.cache_mib * 2**20 // threads
            streamer = stack.enter_context(TileStreamer(cache, byte_budget=budget))
            renderer = NumbaRenderer(streamer, 1)
            stack.callback(renderer.close)
            extractor = DetailExtractor(load_extractor(config.model, threads=1))
            optimizer = JNGO(config.registration, threads=1)
            forecasters.append(Forecaster(renderer, extractor, optimizer, camera, config))
        yield Surveyor(cache, aim, conditions, limits, forecasters)


DEFAULT_PITCH_DEG = -75.0
DEFAULT_SPEED_M_S = 10.0  # WPNAV_SPEED of ArduPilot
_MOST_SAMPLES = 400  # of a mission; longer ones are sampled more thinly


@dataclass(frozen=True)
class Question:
    """What the user asks. mission_file: for the report; spacing_m: between samples; speed_m_s,
    pitch_deg: used if the mission has none; seek: whether alternatives are searched for failing
    legs.
    """

    mission_file: Path
    conditions: tuple[str, ...] = ("day",)
    limits: MissionLimits = field(default_factory=MissionLimits)
    spacing_m: float = 25.0
    speed_m_s: float = DEFAULT_SPEED_M_S
    pitch_deg: float = DEFAULT_PITCH_DEG
    seek: bool = True


@dataclass(frozen=True)
class MissionForecast:
    """Forecast of a mission. length_m: of all legs; verdicts: of each leg once, however often it is
    flown; not_judged: MAVLink names of the mission's commands that the forecast cannot include;
    notes: limits of the forecast for this mission, as sentences.
    """

    question: Question
    length_m: float
    speed_m_s: float
    verdicts: tuple[LegVerdict, ...]
    stretches: tuple[VisionGap, ...]
    proposals: tuple[LegProposal, ...]
    notes: tuple[str, ...]
    not_judged: tuple[str, ...] = ()

    @property
    def holds(self) -> bool:
        """Whether the whole mission was judged and vision is sufficient on every leg."""
        return not self.not_judged and all(v.holds for v in self.verdicts)


def aim_of(deployment: CompanionConfig, pitch_deg: float) -> Aim:
    """Mounting of the deployment's camera, and the gimbal's pitch while the mission sets none."""
    camera = deployment.bridge.camera
    mount = Mount.from_degrees(
        camera.mount_roll_deg,
        camera.mount_pitch_deg,
        camera.mount_yaw_deg,
        deployment.camera.lever_arm_m,
    )
    return Aim(mount, pitch_deg, camera.mount == "fixed")


def make_plan(
    mission: PlannedMission,
    cache: TileCache,
    deployment: CompanionConfig,
    question: Question,
    progress: Progress | None = None,
) -> MissionForecast:
    """Forecast every leg, find the stretches that need odometry, and search alternatives; takes
    minutes on all processors. progress: called with (done, all) samples, once for the legs and once
    for the alternatives. `MissionFileError` as of `legs_of`.
    """
    aim = aim_of(deployment, question.pitch_deg)
    ground = MapHeights(cache)
    legs = legs_of(mission, cache, ground, aim, question.spacing_m)
    coarser_m = length_m(_distinct_legs(legs)) / _MOST_SAMPLES
    if coarser_m > question.spacing_m:
        legs = legs_of(mission, cache, ground, aim, coarser_m)
    samples = [s for leg in _distinct_legs(legs) for s in leg.samples]

    with surveyor(cache, deployment, aim, question.conditions, question.limits) as found:
        judged = iter(found.verdicts(samples, progress))
        times = Counter(leg.first for leg in legs)
        verdicts = tuple(
            LegVerdict(leg, tuple(next(judged) for _ in leg.samples), times[leg.first])
            for leg in _distinct_legs(legs)
        )
        options = leg_proposals(found, verdicts, aim.fixed, progress) if question.seek else ()
    odometry = deployment.localizer.odometry or OdometryConfig()
    speed_m_s = mission.speed_m_s or question.speed_m_s
    bridged = stretches(
        _as_flown(legs, verdicts), speed_m_s, odometry,
        terrain=deployment.localizer.terrain is not None,
    )  # fmt: skip
    notes = _notes(mission, deployment, aim, max(coarser_m, question.spacing_m))
    notes += _kind_notes(cache, deployment, [s.position for s in samples], ground)
    unknown = tuple(n.text for n in mission.not_judged if not (aim.fixed and n.gimbal_only))
    length = length_m(legs)
    return MissionForecast(question, length, speed_m_s, verdicts, bridged, options, notes, unknown)


def _distinct_legs(legs: Sequence[FlightLeg]) -> list[FlightLeg]:
    """The legs without repeats of legs that were flown identically before."""
    return [leg for number, leg in enumerate(legs) if leg.first == number]


def _as_flown(legs: Sequence[FlightLeg], verdicts: Sequence[LegVerdict]) -> list[LegVerdict]:
    """A verdict for each leg, repeats included, in the order in which they are flown."""
    of = {verdict.leg.first: verdict for verdict in verdicts}
    return [
        LegVerdict(
            leg,
            tuple(
                replace(judged, sample=sample)
                for judged, sample in zip(of[leg.first].samples, leg.samples, strict=True)
            ),
        )
        for leg in legs
    ]


def _notes(
    mission: PlannedMission, deployment: CompanionConfig, aim: Aim, spacing_m: float
) -> tuple[str, ...]:
    notes = [f"A point every {spacing_m:.0f} m; turns are not simulated."]
    if aim.fixed:
        notes.append("The camera is fixed and the vehicle assumed level: it tilts in flight.")
    elif all(w.gimbal.pitch_deg is None and w.gimbal.roi is None for w in mission.path):
        notes.append(f"The mission does not move the gimbal: assumed at {aim.pitch_deg:.0f}°.")
    if mission.home is None:
        notes.append("The mission has no home: heights are above its first position.")
    notes += mission.notes
    if mission.no_effect:
        names = ", ".join(sorted(mission.no_effect))
        notes.append(f"Commands that change neither path nor view: {names}.")
    if deployment.localizer.odometry is None:
        notes.append("Odometry is off in this deployment: nothing bridges a stretch.")
    return tuple(notes)


def _kind_notes(
    cache: TileCache, deployment: CompanionConfig, places: Sequence[Array], ground: MapHeights
) -> tuple[str, ...]:
    """Notes on what the map's kind allows at the flown height (median over the map)."""
    kind = map_kind(cache)
    below = [(p[2], ground.height_m(float(p[0]), float(p[1]))) for p in places]
    heights = [float(z) - ground_m for z, ground_m in below if ground_m is not None]
    half_view_deg = deployment.camera.model.camera().horizontal_fov_deg / 2
    advice = kind.advice(half_view_deg, median(heights)) if heights else ""
    notes = [f"Map: {kind.line()}."]
    limit = deployment.map_max_age_days
    age, recent = kind.imagery_age(datetime.now(timezone.utc).date(), limit)
    if not recent:
        notes.append(f"Imagery: {age}; map_max_age_days is {limit}.")
    if advice:
        notes.append(f"{advice[0].upper()}{advice[1:]}.")
    return tuple(notes)


_HEIGHT_FACTORS = (0.6, 1.5, 2.2)
_PITCHES_DEG = (-90.0, -60.0, -45.0)
_LEAST_CHANGE_DEG = 10.0
_TURNS_DEG = (90.0, 180.0)
_LOWEST_M, _HIGHEST_M = 25.0, 300.0  # above the ground that is seen
_SAMPLES = 2  # of a leg, the worst
_LEGS = 12  # the longest of those that will not do


@dataclass(frozen=True)
class LegAlternative:
    """Fly higher by this value, with the gimbal at this pitch and the camera turned from the course
    by this angle (as in `PathSample`). words: for the pilot.
    """

    rise_m: float
    pitch_deg: float
    turn_deg: float
    words: str

    def applied(self, sample: PathSample) -> PathSample:
        """The sample as it is flown then."""
        position = sample.position + np.array([0.0, 0.0, self.rise_m])
        return replace(sample, position=position, pitch_deg=self.pitch_deg, turn_deg=self.turn_deg)


@dataclass(frozen=True)
class LegProposal:
    """The best alternative for a leg. risk: largest of its samples, 0 to 1; holds: whether vision
    is sufficient at all of them.
    """

    leg: str
    change: LegAlternative
    risk: float
    sigma_m: float
    holds: bool


def leg_proposals(
    surveyor: Surveyor, verdicts: Sequence[LegVerdict], fixed: bool, progress: Progress | None
) -> tuple[LegProposal, ...]:
    """Find the alternative with the lowest risk for each of the twelve longest failing legs, if it
    is better than the plan. fixed: the camera turns only with the vehicle.
    """
    bad = sorted(
        (v for v in verdicts if not v.holds), key=lambda v: -(1 - v.share) * v.leg.length_m
    )[:_LEGS]
    tried: list[tuple[LegVerdict, LegAlternative, list[PathSample]]] = []
    for verdict in bad:
        worst = sorted((j for j in verdict.samples if not j.holds), key=lambda j: -j.forecast.risk)[
            :_SAMPLES
        ]
        for change in alternatives_at(worst[0], fixed):
            tried.append((verdict, change, [change.applied(j.sample) for j in worst]))
    judged = iter(surveyor.verdicts([s for _, _, part in tried for s in part], progress))
    found: dict[str, LegProposal] = {}
    for verdict, change, samples in tried:
        results = [next(judged) for _ in samples]
        option = _option(verdict.leg.name, change, results)
        best = found.get(option.leg)
        if option.risk < verdict.worst.forecast.risk and (
            best is None or (not option.holds, option.risk) < (not best.holds, best.risk)
        ):
            found[option.leg] = option
    return tuple(found[v.leg.name] for v in bad if v.leg.name in found)


def alternatives_at(worst: SampleVerdict, fixed: bool) -> list[LegAlternative]:
    """Alternatives to try at a failing sample; for a fixed camera only heights and headings."""
    sample, ground = worst.sample, worst.forecast.ground_m
    options = []
    above = ground * abs(float(np.sin(np.radians(sample.pitch_deg)))) if ground else 0.0
    for factor in _HEIGHT_FACTORS if above else ():
        height = above * factor
        if _LOWEST_M <= height <= _HIGHEST_M:
            rise = height - above
            words = f"{abs(rise):.0f} m {'higher' if rise > 0 else 'lower'}"
            options.append(LegAlternative(rise, sample.pitch_deg, sample.turn_deg, words))
    if not fixed:
        options += [
            LegAlternative(0.0, pitch, sample.turn_deg, f"gimbal at {pitch:.0f}°")
            for pitch in _PITCHES_DEG
            if abs(pitch - sample.pitch_deg) >= _LEAST_CHANGE_DEG
        ]
    options += [
        LegAlternative(0.0, sample.pitch_deg, turn, f"camera {turn:.0f}° from the way")
        for turn in _TURNS_DEG
    ]
    return options


def _option(leg: str, change: LegAlternative, results: Sequence[SampleVerdict]) -> LegProposal:
    worst = max(results, key=lambda j: (not j.holds, j.forecast.risk))
    return LegProposal(
        leg, change, worst.forecast.risk, worst.forecast.sigma_m, all(j.holds for j in results)
    )
