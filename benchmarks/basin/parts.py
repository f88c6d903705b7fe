"""Covariance of registrations against a map that covers a part of the image only.

    python -m benchmarks.basin.parts FOLDER [--set generated|plain|quito|portugal|caliterra]
        [--json parts.json]

The reference view shows the map in a part and the sky elsewhere, as past a map's edge. For each
part: the share of the registrations within 3 m and 3 degrees whose squared error, normalised by
their own covariance, lies within its 95 % bound, with Wilson's interval, the mean and the median
(6 and 5.35 are perfect); and the same share of all that the tracker's checks accept. FOLDER is that
of `basin.py`. Photos are tried at any width, and again from other starts until there are enough.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.common.arguments import Parser, existing, number, output, whole
from benchmarks.common.figures import write_figures
from benchmarks.common.named_errors import named_errors, needs_torch

with needs_torch():
    from benchmarks.basin.run import random_start, squared_error
    from benchmarks.basin.tables import BOUND, Cells, row_name
    from benchmarks.basin.views import SIZE, BasinView, load_views, photo_views
from numpy.typing import NDArray

from benchmarks.features.report import wilson
from localizer.features import load_extractor
from localizer.features.detail import DetailExtractor
from localizer.integrity.acceptance import IntegrityConfig, is_acceptable
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.registration import JNGO, Registration
from localizer.render.base import SKY
from localizer.render.numba_raster import NumbaRenderer
from localizer.tracking.pipeline import reference_anchors
from localizer.types import RegistrationStatus, RenderedView

PARTS = ("whole", "half", "quarter", "band", "discs")
_SEEDS = dict(zip(PARTS, (0, 1, 2, 4, 5), strict=True))
_LEAST_DEPTH = 0.5  # share of a reference view that must show the map before a part is taken


def part_of(part: str, shape: tuple[int, int], rng: np.random.Generator) -> NDArray[np.bool_]:
    """Where (H, W) the map is kept: a half or a band in a random direction, one of the quarters, or
    what discs leave.
    """
    h, w = shape
    y, x = np.mgrid[0:h, 0:w]
    angle = rng.uniform(0, 2 * np.pi)
    across = (x - w / 2 + 0.5) * np.cos(angle) + (y - h / 2 + 0.5) * np.sin(angle)
    if part == "half":
        return np.asarray(across > 0)
    if part == "quarter":
        left, top = rng.random(2) < 0.5
        return np.asarray(((x < w / 2) == left) & ((y < h / 2) == top))
    if part == "band":
        return np.asarray(np.abs(across) < np.quantile(np.abs(across), 0.3))
    kept = np.ones(shape, dtype=bool)
    while part == "discs" and kept.mean() > 0.4:
        u, v, radius = rng.uniform(0, w), rng.uniform(0, h), rng.uniform(10, 30)
        kept &= (x - u) ** 2 + (y - v) ** 2 > radius**2
    return kept


def covered(view: RenderedView, kept: NDArray[np.bool_]) -> RenderedView:
    """The view with sky and no depth where the map is not kept."""
    rgb = np.where(kept[..., None], view.rgb, np.array(SKY, dtype=np.uint8))
    return replace(view, rgb=rgb, depth=np.where(kept, view.depth, np.float32(0)))


@dataclass(frozen=True)
class PatchTrial:
    """One registration: of which part and view, how wrong, and whether the tracker accepts it."""

    part: str
    view: int
    metres: float
    degrees: float
    nees: float
    accepted: bool


def trials(
    views: list[BasinView], parts: list[str], start_m: float, model: Path | None
) -> Iterator[PatchTrial]:
    """Every view, each from one start, against every part of its reference view."""
    extractor, optimizer = DetailExtractor(load_extractor(model, threads=1)), JNGO(threads=1)
    for cache in dict.fromkeys(v.map_cache for v in views):
        with TileStreamer(TileCache.open(cache)) as streamer:
            renderer = NumbaRenderer(streamer, 1)
            for index, view in enumerate(views):
                if view.map_cache != cache:
                    continue
                prior = random_start(start_m, start_m, index).prior(view.truth)
                reference = renderer.render(prior.world_from_camera, view.camera, wait=True)
                if (reference.depth > 0).mean() < _LEAST_DEPTH:
                    continue
                query = extractor.extract(view.query)
                for part in parts:
                    rng = np.random.default_rng((7, _SEEDS[part], index))
                    shown = covered(reference, part_of(part, reference.depth.shape, rng))
                    anchors = reference_anchors(shown, extractor, 4000, index)
                    found = optimizer.register(
                        query, view.camera, anchors, prior, motion=prior, seed=index
                    )
                    if found.status is RegistrationStatus.OK:
                        yield _trial(part, index, found, view)


def _trial(part: str, index: int, found: Registration, view: BasinView) -> PatchTrial:
    pose = found.world_from_camera
    return PatchTrial(
        part,
        index,
        *pose.distance_to(view.truth),
        squared_error(pose, found.covariance, view.truth),
        is_acceptable(IntegrityConfig(), found, 0.0),
    )


def share(values: list[float]) -> str:
    """Share within the bound in per cent, with its interval and count."""
    inside = sum(v < BOUND for v in values)
    low, high = wilson(inside, len(values))
    return f"{100 * inside / max(len(values), 1):5.1f} [{low:4.1f}, {high:5.1f}] of {len(values)}"


def report(part: str, mine: list[PatchTrial]) -> str:
    """The line of one part."""
    near = [t.nees for t in mine if t.metres < 3 and t.degrees < 3]
    if not near:
        return f"{part:8s} no registration within 3 m and 3 degrees, of {len(mine)}"
    return (
        f"{part:8s} within 3 m: {share(near)}, mean {np.mean(near):.1f}, median "
        f"{np.median(near):.1f}; accepted: {share([t.nees for t in mine if t.accepted])}"
    )


def table(source: str, done: list[PatchTrial], parts: list[str], photos: int) -> Cells:
    """Share within the bound of those within 3 m and 3 degrees, and their number, by part."""
    near = [t for t in done if t.metres < 3 and t.degrees < 3]
    names = dict.fromkeys(row_name(source, t.view, photos) for t in near)
    rows = []
    for name in names:
        mine = [t for t in near if row_name(source, t.view, photos) == name]
        shares = [[t.nees for t in mine if t.part == part] for part in parts]
        rows.append((name, *(" ".join(share(s).split()).replace("[ ", "[") for s in shares)))
    return ("set", *parts), rows


def views_of(args: argparse.Namespace) -> tuple[list[BasinView], int]:
    """The set's views, and how many different photos they repeat; 0: renders."""
    photos = args.data / args.set / "queries"
    views = load_views(args.set, args.folder, args.data, args.pairs)
    if not photos.is_dir():
        return views, 0
    size = (args.width, args.width * 3 // 4)
    taken = photo_views(views[0].map_cache, photos, size)
    return (taken * -(-args.pairs // len(taken)))[: args.pairs], len(taken)


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("folder", type=Path, help="of worlds, maps and query images")
    parser.add_argument(
        "--set", default="generated", help="generated, plain, or a folder of --data"
    )
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="of real sets")
    parser.add_argument("--pairs", type=whole(1, 100_000), default=100, help="views")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="of the image")
    parser.add_argument("--start", type=number(0.01, 90), default=5.0, help="m and degrees")
    parser.add_argument("--width", type=whole(64, 4096), default=SIZE[0], help="of photos, px")
    parser.add_argument("--model", type=existing, help="ONNX features; none: the shipped ones")
    parser.add_argument("--json", type=output, help="the table and every registration")
    args = parser.parse_args()
    if args.set not in ("generated", "plain") and not (args.data / args.set).is_dir():
        parser.error(f"--set: {args.set!r} is neither generated, plain nor a folder of {args.data}")
    parts = list(args.parts)
    views, photos = views_of(args)
    done = list(trials(views, parts, args.start, args.model))
    for part in parts:
        print(report(part, [t for t in done if t.part == part]))
    if args.json:
        name = args.set if args.width == SIZE[0] else f"{args.set} at {args.width} px"
        made = {"set": args.set, "outcomes": [asdict(t) for t in done]}
        write_figures(args.json, *table(name, done, parts, photos), made)


if __name__ == "__main__":
    with named_errors():
        main()
