"""Registers unseen frames with a camera that is not quite the calibrated one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from benchmarks.basin.views import BasinView
from benchmarks.protection.draws import LENSES, InstallationFault, drawn
from localizer.config import LocalizerConfig
from localizer.features.detail import DetailExtractor
from localizer.features.extractor import load_extractor
from localizer.geometry.pose import Pose, so3_exp
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.registration.jngo import JNGO
from localizer.render.numba_raster import NumbaRenderer
from localizer.tracking.pipeline import Localizer
from localizer.types import Frame, PosePrior

_START_M, _START_DEG = 1.5, 1.0  # sigmas per axis of where tracking expects the camera
_PASSES = 2  # in flight each reference is rendered where the last frame was found


@dataclass(frozen=True)
class FaultOutcome:
    """One frame with one fault. error_m: east, north, up of the registration alone; beside_m: of
    map, lever arm and time; sigma_m: by the covariance, worst horizontal and vertical.
    """

    set: str
    view: int
    condition: str
    height_m: float
    speed_mps: float
    accepted: bool
    sigma_m: tuple[float, float]
    error_m: tuple[float, float, float]
    beside_m: tuple[float, float, float]
    lens: str = "careful"


def run(
    name: str, views: Sequence[BasinView], draws: int, seed: int, lens: str, *, skip: int = 0
) -> Iterator[FaultOutcome]:
    """Every view from number `skip` on with so many faults; each view's are the same whatever else
    is run.
    """
    extractor, optimizer = DetailExtractor(load_extractor(None, threads=1)), JNGO(threads=1)
    config = LocalizerConfig(odometry=None, calibration=LENSES[lens].stated)
    numbered = list(enumerate(views))[skip:]
    for cache, some in groupby(numbered, key=lambda item: item[1].map_cache):
        with TileStreamer(TileCache.open(cache)) as streamer:
            renderer = NumbaRenderer(streamer, 1)
            for k, view in some:
                rng = np.random.default_rng((seed, k))
                for _ in range(draws):
                    fault = drawn(rng, LENSES[lens])
                    camera = fault.calibrated(view.camera)
                    localizer = Localizer(renderer, extractor, optimizer, camera, config)
                    found = _one(name, k, view, fault, localizer, rng)
                    yield replace(found, lens=lens)


def _one(
    name: str,
    k: int,
    view: BasinView,
    fault: InstallationFault,
    localizer: Localizer,
    rng: np.random.Generator,
) -> FaultOutcome:
    truth = view.truth
    start = Pose(
        so3_exp(np.radians(rng.normal(0.0, _START_DEG, 3))) @ truth.rotation,
        truth.translation + rng.normal(0.0, _START_M, 3),
    )
    localizer.set_prior(PosePrior.around(start, 2.0 * _START_M, 2.0 * _START_DEG, 1))
    frame = Frame(view.query, 1, fault.calibrated(view.camera), k)
    estimate = localizer.track(frame, passes=_PASSES)
    east, north, up = (float(e) for e in estimate.world_from_camera.translation - truth.translation)
    P = estimate.covariance
    sigma = (float(np.sqrt(np.linalg.eigvalsh(P[:2, :2])[-1])), float(np.sqrt(P[2, 2])))
    return FaultOutcome(
        name, k, view.condition, view.height, float(np.hypot(*fault.velocity)),
        estimate.accepted, sigma,
        (east, north, up), fault.beside_m,
    )  # fmt: skip
