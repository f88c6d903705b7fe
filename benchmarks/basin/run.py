"""Registrations of the convergence benchmark: starts, runs over views, shares and intervals.

Every registration starts from a prior that is wrong by exact amounts; the reference view is
rendered at that wrong prior, as in flight. One registration, no second pass.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.basin.variants import FULL, Variant
from benchmarks.basin.views import BasinView
from benchmarks.common.shares import wilson
from localizer.features.detail import DetailExtractor
from localizer.features.extractor import load_extractor
from localizer.geometry.pose import Array, Pose, so3_exp, so3_log
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.registration.jngo import JNGO
from localizer.registration.result import Registration
from localizer.render.holes import fill_holes
from localizer.render.numba_raster import NumbaRenderer
from localizer.types import (
    Anchors,
    FeaturePyramid,
    PosePrior,
    RegistrationStatus,
    RenderedView,
)

_CHUNK = 10
_LEAST_DEPTH = 0.5  # share of a reference view that must show the map


@dataclass(frozen=True)
class BasinOutcome:
    """One registration: who, which view, which start, and its errors; sigma: of the position
    by its own covariance, m; nees: against that covariance, None where it failed.
    """

    variant: str
    view: int
    start: str
    condition: str
    metres: float
    degrees: float
    sigma: float
    nees: float | None
    milliseconds: float

    @property
    def hit(self) -> bool:
        """Whether it is within 1 m and 1 degree."""
        return self.metres < 1 and self.degrees < 1


@dataclass(frozen=True)
class Start:
    """An error to start from: offset (m) and rotation vector (rad), both in camera axes."""

    label: str
    shift: tuple[float, float, float]
    turn: tuple[float, float, float]

    @property
    def covariance(self) -> Array:
        """Isotropic, of a vector that is as long as this one in an unknown direction."""
        metres, radians = np.linalg.norm(self.shift), np.linalg.norm(self.turn)
        sigma = np.maximum([metres / np.sqrt(3), radians / np.sqrt(3)], [0.5, np.radians(0.5)])
        return np.asarray(np.diag(np.repeat(sigma, 3) ** 2))

    def prior(self, truth: Pose) -> PosePrior:
        """The truth, moved."""
        shift = truth.rotation @ np.array(self.shift)
        pose = Pose(truth.rotation @ so3_exp(self.turn), truth.translation + shift)
        return PosePrior(pose, self.covariance, 0)


def random_start(metres: float, degrees: float, seed: int) -> Start:
    rng = np.random.default_rng((seed, round(metres)))
    shift, turn = rng.standard_normal((2, 3))
    shift *= metres / np.linalg.norm(shift)
    turn *= np.radians(degrees) / np.linalg.norm(turn)
    return Start(f"{metres:.0f} m {degrees:.0f}°", tuple(shift), tuple(turn))


def sized_starts(index: int, sizes: tuple[float, ...]) -> list[Start]:
    """A random direction and axis for each size in metres and degrees.

    Not in the package's `__main__`: a spawned process finds no function of that.
    """
    return [random_start(size, size, index) for size in sizes]


def run_views(
    job: tuple[int, list[BasinView]],
    variants: list[Variant],
    starts_of: Callable[[int], list[Start]],
    model: Path | None,
) -> list[BasinOutcome]:
    """Every variant from every start on the views of one map, numbered from `job`'s index on."""
    first, views = job
    extractor = DetailExtractor(load_extractor(model, threads=1))
    optimizers = [(v, v.optimizer()) for v in variants]
    outcomes: list[BasinOutcome] = []
    with TileStreamer(TileCache.open(views[0].map_cache)) as streamer:
        renderer = NumbaRenderer(streamer, 1)
        for index, view in enumerate(views, first):
            query = extractor.extract(view.query)
            for start in starts_of(index):
                prior = start.prior(view.truth)
                reference = renderer.render(prior.world_from_camera, view.camera, wait=True)
                if (reference.depth > 0).mean() < _LEAST_DEPTH:
                    continue  # the start leads off the map: no method could tell
                trial = BasinTrial(index, view, start, prior, query, reference)
                outcomes += trial.run(optimizers, extractor.extract(fill_holes(reference)))
    return outcomes


@dataclass(frozen=True)
class BasinTrial:
    """One view from one start, for all variants."""

    index: int
    view: BasinView
    start: Start
    prior: PosePrior
    query: FeaturePyramid
    reference: RenderedView

    def run(
        self, optimizers: list[tuple[Variant, JNGO]], features: FeaturePyramid
    ) -> Iterator[BasinOutcome]:
        """Anchors, registration and errors of every variant; equal anchors are selected once."""
        chosen: dict[tuple[object, ...], Anchors] = {}
        for variant, optimizer in optimizers:
            with variant.active():
                if variant.selection not in chosen:
                    made = variant.select(self.reference, features, self.index)
                    chosen[variant.selection] = made
                began = time.thread_time()
                found = self._register(variant, optimizer, chosen[variant.selection])
                ms = 1e3 * (time.thread_time() - began)
            yield self._outcome(variant.name, found, ms)

    def _register(self, variant: Variant, optimizer: JNGO, anchors: Anchors) -> Registration:
        return optimizer.register(
            variant.shown(self.query),
            self.view.camera,
            anchors,
            self.prior,
            motion=self.prior if variant.motion else None,
            seed=self.index,
        )

    def _outcome(self, variant: str, found: Registration, ms: float) -> BasinOutcome:
        pose, truth = found.world_from_camera, self.view.truth
        metres, degrees = pose.distance_to(truth)
        ok = found.status is RegistrationStatus.OK
        return BasinOutcome(
            variant,
            self.index,
            self.start.label,
            self.view.condition,
            metres,
            degrees,
            float(np.sqrt(np.trace(found.covariance[:3, :3]))),
            squared_error(pose, found.covariance, truth) if ok else None,
            ms,
        )


def squared_error(pose: Pose, covariance: Array, truth: Pose) -> float:
    """Normalised estimation error squared (NEES), six axes."""
    d = np.concatenate(
        [truth.translation - pose.translation, so3_log(truth.rotation @ pose.rotation.T)]
    )
    return float(d @ np.linalg.solve(covariance, d))


def run(
    views: list[BasinView],
    variants: list[Variant],
    starts_of: Callable[[int], list[Start]],
    model: Path | None,
    processes: int,
) -> list[BasinOutcome]:
    """All views, in chunks of one map each, over processes."""
    jobs = []
    for first in range(0, len(views), _CHUNK):
        chunk = views[first : first + _CHUNK]
        for cache in dict.fromkeys(v.map_cache for v in chunk):
            mine = [k for k, v in enumerate(chunk) if v.map_cache == cache]
            jobs.append((first + mine[0], [chunk[k] for k in mine]))
    work = partial(run_views, variants=variants, starts_of=starts_of, model=model)
    with ProcessPoolExecutor(processes) as pool:
        return [o for part in pool.map(work, jobs) for o in part]


def bootstrap(values: np.ndarray) -> tuple[float, float]:
    """95 % interval of the mean, 2000 resamples."""
    rng = np.random.default_rng(0)
    draws = values[rng.integers(0, len(values), (2000, len(values)))]
    low, high = np.percentile(draws.mean(axis=1), [2.5, 97.5])
    return float(low), float(high)


def summary(outcomes: list[BasinOutcome], full: list[BasinOutcome]) -> dict[str, float]:
    """Share in per cent with its interval, median error (m), and the paired difference to `full`,
    same views.
    """
    hits = sum(o.hit for o in outcomes)
    reference = {o.view: o.hit for o in full}
    both = [100.0 * (o.hit - reference[o.view]) for o in outcomes if o.view in reference]
    difference = np.array(both) if both else np.zeros(1)
    low, high = wilson(hits, len(outcomes))
    change = bootstrap(difference)
    return {
        "r1": 100 * hits / len(outcomes), "r1_low": low, "r1_high": high,
        "median": float(np.median([o.metres for o in outcomes])),
        "change": float(difference.mean()), "change_low": change[0], "change_high": change[1],
    }  # fmt: skip


def groups(
    outcomes: list[BasinOutcome],
) -> Iterator[tuple[str, str, list[BasinOutcome], list[BasinOutcome]]]:
    """(variant, start, its outcomes, those of "ours" from the same start)."""
    by: dict[tuple[str, str], list[BasinOutcome]] = {}
    for o in outcomes:
        by.setdefault((o.variant, o.start), []).append(o)
    for (variant, start), mine in by.items():
        yield variant, start, mine, by.get((FULL, start), [])
