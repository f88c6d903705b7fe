"""Convergence of the registration: the paper's Table 4 (ablation), Table 6 and Fig. 10 (basin).

    python benchmarks/basin.py ablation FOLDER [--set generated|quito|portugal|caliterra]
    python benchmarks/basin.py priors FOLDER [--set ...]
    python benchmarks/basin.py axes FOLDER [--set ...] [--plot basin.png]

FOLDER keeps generated worlds, imported maps and query images between runs. Every registration
starts from a prior that is wrong by exact amounts: along a random direction and about a random axis
(ablation), or along one axis alone (axes); the reference view is rendered at that wrong prior, as
in flight. One registration, no second pass. Shares come with Wilson's 95 % interval, medians and
differences to "ours" (same views, so paired) with bootstrap intervals over the views.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from basin_variants import FULL, Variant, our_rows, paper_rows, prior_rows
from basin_views import View, load_views
from feature_report import wilson

from localizer.features import load_extractor
from localizer.features.detail import DetailExtractor
from localizer.map.cache import TileCache
from localizer.map.stream import TileStreamer
from localizer.pose import Array, Pose, so3_exp, so3_log
from localizer.registration import JNGO, JNGOConfig, Registration
from localizer.render.numba_raster import NumbaRenderer
from localizer.types import (
    Anchors,
    FeaturePyramid,
    PosePrior,
    RegistrationStatus,
    RenderedView,
)

STARTS = (3.0, 5.0, 10.0)  # metres and degrees: the paper's columns
AXES = ("yaw", "pitch", "roll", "x", "y", "z")  # camera axes; yaw about y, pitch about x
STEPS = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 12.0, 15.0)  # degrees or metres
_CHUNK = 10
_LEAST_DEPTH = 0.5  # share of a reference view that must show the map


@dataclass(frozen=True)
class Outcome:
    """One registration: who, which view, which start, and its errors; sigma: of the position
    by its own covariance, m; nees: against that covariance, NaN where it failed.
    """

    variant: str
    view: int
    start: str
    condition: str
    metres: float
    degrees: float
    sigma: float
    nees: float
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


def axis_start(axis: str, size: float, seed: int) -> Start:
    sign = 1.0 if np.random.default_rng((seed, AXES.index(axis))).random() < 0.5 else -1.0
    shift, turn = np.zeros(3), np.zeros(3)
    if axis in ("x", "y", "z"):
        shift["xyz".index(axis)] = sign * size
    else:
        turn[{"pitch": 0, "yaw": 1, "roll": 2}[axis]] = sign * np.radians(size)
    return Start(f"{axis} {size:.0f}", tuple(shift), tuple(turn))


def ablation_starts(index: int, sizes: tuple[float, ...]) -> list[Start]:
    return [random_start(size, size, index) for size in sizes]


def axis_starts(index: int) -> list[Start]:
    joint = [random_start(s, s, index) for s in STEPS]
    joint = [Start(f"all {s:.0f}", j.shift, j.turn) for s, j in zip(STEPS, joint, strict=True)]
    return joint + [axis_start(a, s, index) for a in AXES for s in STEPS]


def run_views(
    job: tuple[int, list[View]],
    variants: list[Variant],
    starts_of: Callable[[int], list[Start]],
    model: Path | None,
) -> list[Outcome]:
    """Every variant from every start on the views of one map, numbered from `job`'s index on."""
    first, views = job
    extractor = DetailExtractor(load_extractor(model, threads=1))
    optimizers = [(v, v.optimizer()) for v in variants]
    outcomes = []
    with TileStreamer(TileCache.open(views[0].map_cache)) as streamer:
        renderer = NumbaRenderer(streamer, 1)
        for index, view in enumerate(views, first):
            query = extractor.extract(view.query)
            for start in starts_of(index):
                prior = start.prior(view.truth)
                reference = renderer.render(prior.world_from_camera, view.camera, wait=True)
                if (reference.depth > 0).mean() < _LEAST_DEPTH:
                    continue  # the start leads off the map: no method could tell
                trial = Trial(index, view, start, prior, query, reference)
                outcomes += trial.run(optimizers, extractor.extract(reference.rgb))
    return outcomes


@dataclass(frozen=True)
class Trial:
    """One view from one start, for all variants."""

    index: int
    view: View
    start: Start
    prior: PosePrior
    query: FeaturePyramid
    reference: RenderedView

    def run(
        self, optimizers: list[tuple[Variant, JNGO]], features: FeaturePyramid
    ) -> Iterator[Outcome]:
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
        constraint = None
        if variant.constraint is not None:
            constraint = variant.constraint(self.view.truth, np.random.default_rng((self.index, 5)))
        return optimizer.register(
            variant.shown(self.query),
            self.view.camera,
            anchors,
            self.prior,
            motion=self.prior if variant.motion else None,
            constraint=constraint,
            seed=self.index,
        )

    def _outcome(self, variant: str, found: Registration, ms: float) -> Outcome:
        pose, truth = found.world_from_camera, self.view.truth
        metres, degrees = pose.distance_to(truth)
        ok = found.status is RegistrationStatus.OK
        return Outcome(
            variant,
            self.index,
            self.start.label,
            self.view.condition,
            metres,
            degrees,
            float(np.sqrt(np.trace(found.covariance[:3, :3]))),
            _nees(pose, found.covariance, truth) if ok else np.nan,
            ms,
        )


def _nees(pose: Pose, covariance: Array, truth: Pose) -> float:
    d = np.concatenate(
        [truth.translation - pose.translation, so3_log(truth.rotation @ pose.rotation.T)]
    )
    return float(d @ np.linalg.solve(covariance, d))


def run(
    views: list[View],
    variants: list[Variant],
    starts_of: Callable[[int], list[Start]],
    model: Path | None,
    processes: int,
) -> list[Outcome]:
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


def bootstrap(values: np.ndarray, statistic: Callable[..., np.ndarray]) -> tuple[float, float]:
    """95 % interval of a statistic over the last axis, 2000 resamples."""
    rng = np.random.default_rng(0)
    draws = values[rng.integers(0, len(values), (2000, len(values)))]
    low, high = np.percentile(statistic(draws, axis=1), [2.5, 97.5])
    return float(low), float(high)


def summary(outcomes: list[Outcome], full: list[Outcome]) -> dict[str, float]:
    """Shares in per cent with intervals, and the paired difference to `full`, same views."""
    hits = sum(o.hit for o in outcomes)
    three = sum(o.metres < 3 and o.degrees < 3 for o in outcomes)
    errors = np.array([o.metres for o in outcomes])
    reference = {o.view: o.hit for o in full}
    both = [100.0 * (o.hit - reference[o.view]) for o in outcomes if o.view in reference]
    difference = np.array(both) if both else np.zeros(1)
    low, high = wilson(hits, len(outcomes))
    median = bootstrap(errors, np.median)
    change = bootstrap(difference, np.mean)
    near = np.array([o.nees for o in outcomes if o.metres < 3 and o.degrees < 3])
    return {
        "n": len(outcomes), "r1": 100 * hits / len(outcomes), "r1_low": low, "r1_high": high,
        "r3": 100 * three / len(outcomes), "median": float(np.median(errors)),
        "median_low": median[0], "median_high": median[1], "change": float(difference.mean()),
        "change_low": change[0], "change_high": change[1],
        "nees": float(np.nanmean(near)) if len(near) else np.nan,
        "ms": float(np.median([o.milliseconds for o in outcomes])),
    }  # fmt: skip


def groups(outcomes: list[Outcome]) -> Iterator[tuple[str, str, list[Outcome], list[Outcome]]]:
    """(variant, start, its outcomes, those of "ours" from the same start)."""
    by: dict[tuple[str, str], list[Outcome]] = {}
    for o in outcomes:
        by.setdefault((o.variant, o.start), []).append(o)
    for (variant, start), mine in by.items():
        yield variant, start, mine, by.get((FULL, start), [])


def ablation(args: argparse.Namespace) -> list[Outcome]:
    """Table 4, or the priors: one line a variant and start."""
    views = load_views(args.set, args.folder, args.data, args.pairs)
    if args.set == "caliterra":
        views = views * (-(-args.pairs // len(views)))  # the same photos from other starts
    rows = prior_rows() if args.what == "priors" else paper_rows() + our_rows()
    if args.only:
        rows = [v for v in rows if any(text in v.name for text in args.only) or v.name == FULL]
    outcomes = run(
        views, rows, partial(ablation_starts, sizes=tuple(args.starts)), args.model, args.processes
    )
    print(f"{args.set}: {len(views)} views; R@1 = share within 1 m and 1 degree")
    last = ""
    for variant, start, mine, full in sorted(
        groups(outcomes), key=lambda g: [v.name for v in rows].index(g[0])
    ):
        s = summary(mine, full)
        label, last = ("" if variant == last else variant), variant
        print(
            f"{label:34s} {start:9s} n={s['n']:<4.0f} R@1 {s['r1']:5.1f} "
            f"[{s['r1_low']:4.1f}, {s['r1_high']:5.1f}]  change {s['change']:+5.1f} "
            f"[{s['change_low']:+5.1f}, {s['change_high']:+5.1f}]  R@3 {s['r3']:5.1f}  "
            f"median {s['median']:5.2f} m [{s['median_low']:.2f}, {s['median_high']:.2f}]  "
            f"NEES {s['nees']:5.1f}  {s['ms']:5.1f} ms"
        )
    return outcomes


def axis_variants() -> list[Variant]:
    """Fig. 10: one hypothesis on the levels from coarse, from mid or from fine on; and the swarm.

    A level that is left out gets no iterations. All end with the same sharpening, so that
    "converged" means the same: within 1 m and 1 degree.
    """
    one = JNGOConfig(hypotheses=1)
    return [
        Variant("one hypothesis, fine level", one.model_copy(update={"iterations": (0, 0, 9)})),
        Variant("one, mid and fine", one.model_copy(update={"iterations": (0, 5, 4)})),
        Variant("one, coarse to fine", one),
        Variant(FULL),
    ]


def axes(args: argparse.Namespace) -> list[Outcome]:
    """Table 6 and Fig. 10: share converged against the initial error of each axis."""
    views = load_views(args.set, args.folder, args.data, args.pairs)
    variants = axis_variants()
    outcomes = run(views, variants, axis_starts, args.model, args.processes)
    share = {(v, s): summary(mine, []) for v, s, mine, _ in groups(outcomes)}
    print(f"{args.set}, {len(views)} views: per cent within 1 m and 1 degree, by initial error")
    for axis in ("all", *AXES):
        unit = "m and degrees" if axis == "all" else "m" if axis in "xyz" else "degrees"
        print(f"\n{axis} ({unit})".ljust(36) + "".join(f"{s:7.0f}" for s in STEPS) + "   limit")
        for v in variants:
            values = [share[v.name, f"{axis} {s:.0f}"]["r1"] for s in STEPS]
            print(f"{v.name:35s}" + "".join(f"{x:7.0f}" for x in values) + f"{limit(values):8.1f}")
    if args.plot:
        plot(share, [v.name for v in variants], args.plot)
    return outcomes


def limit(shares: list[float]) -> float:
    """The paper's convergence limit: the largest error from which half of what the smallest error
    reaches still converges, between the steps linearly.
    """
    level = 0.5 * shares[0]
    for k in range(1, len(STEPS)):
        if shares[k] < level:
            part = (shares[k - 1] - level) / (shares[k - 1] - shares[k])
            return STEPS[k - 1] + part * (STEPS[k] - STEPS[k - 1])
    return STEPS[-1]


def plot(share: dict[tuple[str, str], dict[str, float]], names: list[str], path: Path) -> None:
    """Share converged over the initial error, one panel an axis, with Wilson's intervals."""
    figure, panels = plt.subplots(2, 4, figsize=(15, 7), sharey=True)
    for panel, axis in zip(panels.flat, ("all", *AXES), strict=False):
        for name in names:
            rows = [share[name, f"{axis} {s:.0f}"] for s in STEPS]
            panel.plot(STEPS, [r["r1"] for r in rows], marker="o", ms=3, label=name)
            panel.fill_between(
                STEPS, [r["r1_low"] for r in rows], [r["r1_high"] for r in rows], alpha=0.15
            )
        panel.set_title(axis if axis != "all" else "all axes jointly")
        panel.set_xlabel(
            "initial error, m and °" if axis == "all" else f"initial error, {_unit(axis)}"
        )
        panel.set_ylim(0, 102)
        panel.grid(alpha=0.3)
    panels[0, 0].set_ylabel("% within 1 m and 1°")
    panels[1, 0].set_ylabel("% within 1 m and 1°")
    panels.flat[-1].axis("off")
    panels.flat[-1].legend(*panels.flat[0].get_legend_handles_labels(), loc="center")
    figure.tight_layout()
    figure.savefig(path, dpi=90)


def _unit(axis: str) -> str:
    return "m" if axis in ("x", "y", "z") else "°"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("what", choices=("ablation", "priors", "axes"))
    parser.add_argument("folder", type=Path, help="of worlds, maps and query images")
    parser.add_argument("--set", default="generated")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--pairs", type=int, default=320)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--model", type=Path, help="ONNX features; none: the shipped ones")
    parser.add_argument("--starts", nargs="*", type=float, default=STARTS, help="m and degrees")
    parser.add_argument("--only", nargs="*", help="variants whose name contains one of these")
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--json", type=Path, help="every outcome")
    args = parser.parse_args()
    outcomes = (axes if args.what == "axes" else ablation)(args)
    if args.json:
        args.json.write_text(json.dumps([asdict(o) for o in outcomes]))


if __name__ == "__main__":
    main()
