"""A mission flown on the desk: all that is known of it before the flight."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from companion.config import CompanionConfig
from companion.geometry import Mount
from companion.planning.instead import Instead, instead
from companion.planning.judge import LegVerdict, MissionLimits, VisionGap, stretches
from companion.planning.mission import PlannedMission
from companion.planning.survey import Progress, surveyor
from companion.planning.way import Aim, MapHeights, legs_of, length_m
from localizer.map.cache.cache import TileCache
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
    limits: MissionLimits = field(default_factory=MissionLimits)
    spacing_m: float = 25.0
    speed_m_s: float = DEFAULT_SPEED_M_S
    pitch_deg: float = DEFAULT_PITCH_DEG
    seek: bool = True


@dataclass(frozen=True)
class MissionForecast:
    """The answer. notes: what the forecast does not know of this mission, as sentences."""

    question: Question
    length_m: float
    speed_m_s: float
    verdicts: tuple[LegVerdict, ...]
    stretches: tuple[VisionGap, ...]
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
) -> MissionForecast:
    """Forecast every leg, say what must be bridged, and look for what would do instead."""
    aim = aim_of(deployment, question.pitch_deg)
    ground = MapHeights(cache)
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
    return MissionForecast(question, length_m(legs), speed_m_s, verdicts, bridged, options, notes)


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
