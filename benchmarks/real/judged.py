"""One image from a prior 10 m off: the registration, its acceptance, its covariance and its level.

The product itself localizes (`open_localizer`, three passes), with roll, pitch and height drawn
about the truth. Every image stands for itself: nothing is learned from the ones before.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.real.sets import RealView, SetDescription
from companion.integrity_monitor.config import ProtectionConfig
from companion.integrity_monitor.protection import budget
from localizer.config import LocalizerConfig
from localizer.errors import OutsideMapError
from localizer.evaluation.places import DrawnSensors
from localizer.evaluation.sequences import Sequence as Recorded
from localizer.geometry.pose import Array, Pose, so3_exp, so3_log
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.relocalization.patch import with_heading
from localizer.render.numba_raster import NumbaRenderer
from localizer.tracking.opening import open_localizer
from localizer.tracking.pipeline import Localizer, working_camera
from localizer.types import Frame, PoseEstimate, PosePrior

ATTITUDES: tuple[float | None, ...] = (0.3, 1.0, 3.0, None)
HEIGHT_SIGMA_M = 3.0
OFF_M, OFF_HEADING_DEG = 10.0, 3.0  # of the prior: largest east and north, sigma of the heading
DISPLACED_M = 45.0, 110.0  # of a wrong prior, which claims the sigma of the others
_UNKNOWN_TILT_DEG = 2.0  # sigma of the prior where no attitude is reported
_INSIDE_3, _INSIDE_2 = 7.815, 5.991  # chi square, 95 %
_PASSES = 3
_USUAL_M = 100.0  # to the ground, where the map has none in the middle of the view


@dataclass(frozen=True)
class JudgedImage:
    """attitude_deg: sigma of roll and pitch, None: not reported. centre_m: error on the ground in
    the middle of the image; right: whether that is small enough for the set. horizontal_m, up_m:
    error of the position; nees, nees_attitude: squared error over the claimed covariance and the
    truth's, per degree of freedom; inside, inside_horizontal: within the 95 % bound; level_m: the
    horizontal protection level; beyond_level: by more than the truth's three sigmas.
    """

    set: str
    image: int
    attitude_deg: float | None
    centre_m: float
    right: bool
    accepted: bool
    horizontal_m: float
    up_m: float
    degrees: float
    sigma_m: float
    nees: float
    nees_attitude: float
    inside: bool
    inside_horizontal: bool
    level_m: float
    beyond_level: bool
    quality: float


def judged_images(
    name: str, described: SetDescription, views: Sequence[RealView], attitude_deg: float | None,
    width: int, displaced: int | None = None,
) -> Iterator[JudgedImage]:  # fmt: skip
    """Of every image of a set that meets the map from its prior. displaced: seed of priors that lie
    `DISPLACED_M` off and claim what the others do; where each image has its own small map, the
    image begins on another one's.
    """
    own = [view.map_cache for view in views]
    if displaced is not None:
        views = _exchanged(views, displaced)
    height = None if attitude_deg is None else HEIGHT_SIGMA_M
    sensors = DrawnSensors(attitude_deg, height, by_frame=True, seed=5)
    times = tuple((k + 1) * 10**9 for k in range(len(views)))
    truth = tuple(v.truth for v in views)
    recorded = Recorded((Path(),) * len(views), times, truth, views[0].camera)
    config = sensors.config(
        LocalizerConfig(width=width, calibration=described.calibration, renderer="numba")
    )
    numbered = list(enumerate(views))
    for _, group in itertools.groupby(numbered, key=lambda kv: (kv[1].map_cache, kv[1].camera)):
        mine = list(group)
        view = mine[0][1]
        with (
            open_localizer(
                view.map_cache, view.camera, config, sensors.auxiliary(recorded)
            ) as localizer,
            TileStreamer(TileCache.open(view.map_cache)) as streamer,
        ):
            renderer = NumbaRenderer(streamer, 1)
            for k, view in mine:
                frame = Frame(view.image(), times[k], view.camera, k)
                prior = draw_prior(view.truth, sensors, k, times[k])
                if displaced is not None and view.map_cache == own[k]:
                    prior = _displaced(prior, (displaced, k))
                estimate = _localized(localizer, frame, prior)
                if estimate is not None:
                    away_m = distance_to_ground(renderer, view)
                    image = _judged(name, k, attitude_deg, described, view.truth, estimate, away_m)
                    if view.map_cache != own[k]:  # it holds no right place
                        image = replace(image, right=False, beyond_level=True)
                    yield image


def draw_prior(truth: Pose, sensors: DrawnSensors, index: int, time_ns: int) -> PosePrior:
    """Up to `OFF_M` beside the truth, with what the sensors report."""
    rng = np.random.default_rng((11, index))
    tilt = np.radians(_UNKNOWN_TILT_DEG)
    rotation = so3_exp(np.array([*rng.normal(0.0, tilt, 2), 0.0])) @ truth.rotation
    heading = float(rng.normal(0.0, np.radians(OFF_HEADING_DEG)))
    off = np.array([*rng.uniform(-OFF_M, OFF_M, 2), rng.normal(0.0, HEIGHT_SIGMA_M)])
    level = OFF_M / np.sqrt(3.0)
    sigma = np.array([level, level, HEIGHT_SIGMA_M, tilt, tilt, np.radians(OFF_HEADING_DEG)])
    pose = Pose(with_heading(rotation, heading), truth.translation + off)
    return sensors.in_prior(PosePrior(pose, np.diag(sigma**2), time_ns), truth, index)


def _exchanged(views: Sequence[RealView], seed: int) -> Sequence[RealView]:
    """Each image with another one's map, if they have maps of their own."""
    caches = list(dict.fromkeys(view.map_cache for view in views))
    if len(caches) == 1:
        return views
    by = 2 + 2 * (seed % (len(caches) // 2 - 1))  # a place has two maps, one of each date
    other = dict(zip(caches, caches[by:] + caches[:by], strict=True))
    return [replace(view, map_cache=other[view.map_cache]) for view in views]


def _displaced(prior: PosePrior, seed: tuple[int, int]) -> PosePrior:
    """The prior moved horizontally by more than it claims."""
    rng = np.random.default_rng(seed)
    direction, off_m = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(*DISPLACED_M)
    moved = np.array([np.cos(direction), np.sin(direction), 0.0]) * off_m
    pose = prior.world_from_camera
    return replace(prior, world_from_camera=Pose(pose.rotation, pose.translation + moved))


def _localized(localizer: Localizer, frame: Frame, prior: PosePrior) -> PoseEstimate | None:
    localizer.set_prior(prior)
    try:
        return localizer.track(frame, passes=_PASSES)
    except OutsideMapError:
        return None


def _judged(
    name: str, index: int, attitude_deg: float | None, described: SetDescription,
    truth: Pose, estimate: PoseEstimate, away_m: float,
) -> JudgedImage:  # fmt: skip
    pose = estimate.world_from_camera
    error = pose.translation - truth.translation
    turn = so3_log(pose.rotation @ truth.rotation.T)
    place = estimate.covariance[:3, :3] + np.eye(3) * described.position_sigma_m**2
    rotation = (
        estimate.covariance[3:, 3:]
        + np.eye(3) * max(np.radians(described.rotation_sigma_deg), 1e-4) ** 2
    )
    squared = _squared(error, place)
    centre = ground_centre(pose, truth, away_m)
    sigma = float(np.sqrt(np.linalg.eigvalsh(estimate.covariance[:2, :2])[-1]))
    level, _ = budget((sigma, 0.0), away_m, (0.0, 0.0), ProtectionConfig())
    horizontal = float(np.hypot(*error[:2]))
    return JudgedImage(
        name, index, attitude_deg, centre, centre <= described.right_m, estimate.accepted,
        horizontal, float(error[2]), float(np.degrees(np.linalg.norm(turn))),
        float(np.sqrt(np.trace(estimate.covariance[:2, :2]))),
        squared / 3, _squared(turn, rotation) / 3, squared <= _INSIDE_3,
        _squared(error[:2], place[:2, :2]) <= _INSIDE_2,
        level, horizontal > level + 3.0 * described.position_sigma_m, estimate.quality,
    )  # fmt: skip


def _squared(error: Array, covariance: Array) -> float:
    return float(error @ np.linalg.solve(covariance, error))


def distance_to_ground(renderer: NumbaRenderer, view: RealView) -> float:
    """Along the axis of the true camera, m: the depth in the middle of its rendered view."""
    depth = renderer.render(view.truth, working_camera(view.camera, 64), wait=True).depth
    h, w = depth.shape
    middle = depth[h // 4 : 3 * h // 4, w // 4 : 3 * w // 4]
    seen = middle[middle > 0]
    return float(np.median(seen)) if len(seen) else _USUAL_M


def ground_centre(pose: Pose, truth: Pose, away_m: float) -> float:
    """Between the ground points in the middle of two cameras' images, horizontally, m."""
    axis = np.array([0.0, 0.0, away_m])
    ground = truth.apply(axis)
    ray = pose.rotation[:, 2]
    if ray[2] > -0.05:
        return float("inf")
    hit = pose.translation + ray * ((ground[2] - pose.translation[2]) / ray[2])
    return float(np.hypot(*(hit - ground)[:2]))
