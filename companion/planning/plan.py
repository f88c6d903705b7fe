"""A mission flown on the desk: all that is known of it before the flight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

from companion.config import CompanionConfig
from companion.geometry import Mount
from companion.planning.instead import Instead, instead
from companion.planning.judge import LegVerdict, Limits, Stretch, stretches
from companion.planning.mission import PlannedMission
from companion.planning.survey import Progress, surveyor
from companion.planning.way import Aim, Ground, legs_of, length_m
from localizer.geometry.pose import Array
from localizer.map.cache.cache import TileCache
from localizer.map.inspection.kind import map_kind
from localizer.odometry.config import OdometryConfig

DEFAULT_PITCH_DEG = -75.0
DEFAULT_SPEED_M_S = 10.0  # WPNAV_SPEED of ArduPilot
_MOST_SAMPLES = 400  # of a mission; longer ones are sampled more thinly


@dataclass(frozen=True)
class Question:
    """What is asked. mission_file: for the report; spacing_m: between samples; speed_m_s,
    pitch_deg: where the mission does not say; seek: whether changes are looked for where legs will
    not do.
    """

    mission_file: Path
    conditions: tuple[str, ...] = ("day",)
    limits: Limits = field(default_factory=Limits)
    spacing_m: float = 25.0
    speed_m_s: float = DEFAULT_SPEED_M_S
    pitch_deg: float = DEFAULT_PITCH_DEG
    seek: bool = True


@dataclass(frozen=True)
class Plan:
    """The answer. notes: what the forecast does not know of this mission, as sentences."""

    question: Question
    length_m: float
    speed_m_s: float
    verdicts: tuple[LegVerdict, ...]
    stretches: tuple[Stretch, ...]
    instead: tuple[Instead, ...]
    notes: tuple[str, ...]

    @property
    def holds(self) -> bool:
        """Whether vision will do on every leg."""
        return all(v.holds for v in self.verdicts)


def aim_of(deployment: CompanionConfig, pitch_deg: float) -> Aim:
    """How the deployment's camera looks."""
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
) -> Plan:
    """Forecast every leg, say what must be bridged, and look for what would do instead."""
    aim = aim_of(deployment, question.pitch_deg)
    ground = Ground(cache)
    legs = legs_of(mission, cache, ground, aim, question.spacing_m)
    thinned = length_m(legs) / _MOST_SAMPLES
    if thinned > question.spacing_m:
        legs = legs_of(mission, cache, ground, aim, thinned)
    samples = [s for leg in legs for s in leg.samples]

    with surveyor(cache, deployment, aim, question.conditions, question.limits) as found:
        judged = iter(found.judged(samples, progress))
        verdicts = tuple(LegVerdict(leg, tuple(next(judged) for _ in leg.samples)) for leg in legs)
        options = instead(found, verdicts, aim.fixed, progress) if question.seek else ()
    odometry = deployment.localizer.odometry or OdometryConfig()
    speed = mission.speed_m_s if (mission.speed_m_s or 0) > 0 else None
    speed_m_s = speed or question.speed_m_s
    bridged = stretches(verdicts, speed_m_s, odometry)
    notes = _notes(mission, deployment, aim, max(thinned, question.spacing_m))
    notes += _kind_notes(cache, deployment, [s.position for s in samples], ground)
    return Plan(question, length_m(legs), speed_m_s, verdicts, bridged, options, notes)


def _notes(
    mission: PlannedMission, deployment: CompanionConfig, aim: Aim, spacing_m: float
) -> tuple[str, ...]:
    notes = [f"A place every {spacing_m:.0f} m; legs are flown straight, turns are left out."]
    if aim.fixed:
        notes.append("The camera is screwed on and the vehicle flown level: it leans in flight.")
    elif all(w.pitch_deg is None for w in mission.waypoints):
        notes.append(f"The mission moves no gimbal: taken at {aim.pitch_deg:.0f}°.")
    if mission.home is None:
        notes.append("The mission has no home: heights are taken above its first waypoint.")
    if mission.ignored:
        numbers = ", ".join(str(n) for n in sorted(set(mission.ignored)))
        notes.append(f"Commands that are not flown here: {numbers}.")
    if deployment.localizer.odometry is None:
        notes.append("Odometry is off in this deployment: nothing bridges a stretch.")
    return tuple(notes)


def _kind_notes(
    cache: TileCache, deployment: CompanionConfig, places: Sequence[Array], ground: Ground
) -> tuple[str, ...]:
    """What the map's kind is worth at the height that is flown (the median over the map)."""
    kind = map_kind(cache)
    below = [(p[2], ground.height_m(float(p[0]), float(p[1]))) for p in places]
    heights = [float(z) - ground_m for z, ground_m in below if ground_m is not None]
    half_view_deg = deployment.camera.model.camera().horizontal_fov_deg / 2
    advice = kind.advice(half_view_deg, median(heights)) if heights else ""
    return (f"Map: {kind.line()}.", *([f"{advice[0].upper()}{advice[1:]}."] if advice else []))
