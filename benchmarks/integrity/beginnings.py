"""Where registrations begin: near the truth, or wrong in every way that a flight can be."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.basin.views import BasinView
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose, so3_exp
from localizer.relocalization.patch import with_heading
from localizer.types import PosePrior

NEAR = ((3.0, 3.0), (3.0, 3.0), (8.0, 8.0))  # metres and degrees of heading
FAR = ((20.0, 5.0), (20.0, 180.0), (50.0, 20.0), (100.0, 10.0), (100.0, 90.0), (200.0, 45.0))
LOST, ELSEWHERE = 20, 13  # beginnings at other places of the map, and on other maps
FOCAL = ((20.0, 5.0), (100.0, 45.0))
_LEAST_LOST_M = 20.0
_FOCAL_ERROR = 0.05
_TILT_DEG, _HEIGHT_M = 2.0, 5.0  # sigma, by the autopilot and its barometer

WRONG = ("far", "lost", "elsewhere", "focal")  # "near" and "focal near" begin right


@dataclass(frozen=True)
class RegistrationStart:
    """One registration to try. camera: as it is believed; prior: told with an honest covariance;
    map_cache: what it is registered to; other: the view from whose pose the reference is rendered,
    where that serves several beginnings; has_truth: whether the place is on that map.
    """

    kind: str
    start_m: float
    start_deg: float
    map_cache: Path
    camera: Camera
    prior: PosePrior
    other: BasinView | None = None
    has_truth: bool = True


def beginnings(
    view: BasinView, index: int, here: Sequence[BasinView], others: Sequence[BasinView]
) -> Iterator[RegistrationStart]:
    """All of one view; here, others: views of its own map and of other places, where it is tried,
    too.
    """
    rng = np.random.default_rng((31, index))
    for kind, starts in (("near", NEAR), ("far", FAR)):
        for metres, degrees in starts:
            prior = _off(view.truth, metres, degrees, rng)
            yield RegistrationStart(kind, metres, degrees, view.map_cache, view.camera, prior)
    away = [v for v in here if view.truth.distance_to(v.truth)[0] >= _LEAST_LOST_M]
    for k in rng.permutation(len(away))[:LOST]:
        yield _at(away[int(k)], view, "lost")
    for k in rng.permutation(len(others))[:ELSEWHERE]:
        yield _at(others[int(k)], view, "elsewhere")
    for metres, degrees in (*FOCAL, NEAR[0]):
        factor = 1.0 + _FOCAL_ERROR * float(rng.choice((-1.0, 1.0)))
        camera = view.camera
        camera = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
        kind = "focal near" if metres == NEAR[0][0] else "focal"
        prior = _off(view.truth, metres, degrees, rng)
        yield RegistrationStart(kind, metres, degrees, view.map_cache, camera, prior)


def _at(place: BasinView, view: BasinView, kind: str) -> RegistrationStart:
    """Where another view was taken, the prior as wide as the way there; no heading is known."""
    on_map = kind == "lost"
    metres, degrees = view.truth.distance_to(place.truth) if on_map else (20.0, 180.0)
    tilt = np.radians(max(_TILT_DEG, degrees)) if on_map else np.radians(_TILT_DEG)
    sigma = np.array([metres, metres, metres, tilt, tilt, np.pi])
    prior = PosePrior(place.truth, np.diag(sigma**2), 0)
    return RegistrationStart(
        kind, metres, degrees, place.map_cache, view.camera, prior, other=place, has_truth=on_map
    )


def _off(truth: Pose, metres: float, degrees: float, rng: np.random.Generator) -> PosePrior:
    """So many metres away in a random direction and so many degrees turned; roll, pitch and height
    as the autopilot has them.
    """
    angle = rng.uniform(0, 2 * np.pi)
    near = metres <= NEAR[-1][0]
    height_m, tilt_deg = (metres / 4, degrees / 4) if near else (_HEIGHT_M, _TILT_DEG)
    shift = np.array([metres * np.cos(angle), metres * np.sin(angle), rng.normal(0, height_m)])
    tilt = np.array([*rng.normal(0, np.radians(tilt_deg), 2), 0.0])
    turn = np.radians(degrees) * rng.choice((-1.0, 1.0))
    rotation = with_heading(so3_exp(tilt) @ truth.rotation, float(turn))
    level, tilted = metres / np.sqrt(2), np.radians(tilt_deg)
    sigma: Array = np.array([level, level, height_m, tilted, tilted, np.radians(degrees)])
    return PosePrior(Pose(rotation, truth.translation + shift), np.diag(sigma**2), 0)
