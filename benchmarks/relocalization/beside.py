"""Relocalization beside a running tracker: what each leaves the other, both in one run.

    python -m benchmarks.relocalization.beside --views 8 --cache FOLDER --out out.json
    python -m benchmarks.relocalization.beside --report out.json [--json shares.json]

FOLDER keeps the views of `python -m benchmarks.basin`. Each view is searched for on its whole map
alone, then while the engine that flies tracks the same view as fast as it can (a camera that
hovers, as many frames as the engine takes), and the engine is timed without the search before and
after. Each figure is the median over the views; the ratios are of the same view and the same
minute, so that what else runs on the machine cancels, as far as it is steady. Two processors.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.basin.views import BasinView, load_views
from benchmarks.common.arguments import Parser, existing, number, output, whole
from benchmarks.common.deadline import deadline
from benchmarks.common.figures import show_figures
from benchmarks.common.named_errors import named_errors
from benchmarks.relocalization.run import RIGHT_DEG, RIGHT_M, ViewSearch, with_threads
from localizer.config import LocalizerConfig
from localizer.evaluation.places import SimulatedPlaceData
from localizer.map.cache.cache import TileCache
from localizer.relocalization.relocalizer import Relocalizer, open_relocalizer
from localizer.relocalization.types import PlaceQuery, Relocalization
from localizer.tracking.engine import DualThreadEngine
from localizer.tracking.opening import open_localizer
from localizer.types import Frame, PoseEstimate, PosePrior, ReferenceBundle

WANTED_HZ, WANTED_RATIO = 10.0, 2.0
COLUMNS = ("figure", "median", "worst view", "wanted")
_SETTLE_S, _ALONE_S = 4.0, 3.0
_WAIT_S = 0.002
_SWITCH_S = 2e-4  # as in the companion's process


@dataclass(frozen=True)
class Beside:
    """One view. alone_hz, beside_hz: frames that the engine registered and accepted in a second
    without and with a search; alone_s, beside_s: of the search without and with the engine; right:
    whether both searches found the place.
    """

    set: str
    view: int
    heading_known: bool
    alone_hz: float
    beside_hz: float
    alone_s: float
    beside_s: float
    right: bool


class _Hover:
    """The engine over one view whose camera stands still."""

    def __init__(self, view: BasinView, config: LocalizerConfig) -> None:
        self._view, self._sequence, self.accepted = view, 0, 0
        self._localizer = open_localizer(view.map_cache, view.camera, config)
        self.engine = DualThreadEngine(self._localizer, (self._count,), self._prior)

    def track(self, go_on: Callable[[], bool]) -> float:
        """Accepted frames a second, offered as soon as the engine takes them."""
        began, first = time.perf_counter(), self.accepted
        while go_on():
            if self.engine.is_full:
                time.sleep(_WAIT_S)
                continue
            now = time.monotonic_ns()
            self.engine.submit(Frame(self._view.query, now, self._view.camera, self._sequence))
            self._sequence += 1
        return (self.accepted - first) / (time.perf_counter() - began)

    def close(self) -> None:
        self.engine.stop()
        self._localizer.close()

    def _count(self, estimate: PoseEstimate, _: ReferenceBundle) -> None:
        self.accepted += estimate.accepted

    def _prior(self, time_ns: int) -> PosePrior:
        return PosePrior.around(self._view.truth, time_ns=time_ns)


def measured(
    asked: ViewSearch, index: int, view: BasinView, relocalizer: Relocalizer
) -> Beside | None:
    """Both alone and together; None where the engine does not track the view."""
    query = SimulatedPlaceData(prior=False, heading=asked.heading_known, seed=asked.seed).query(
        Frame(view.query, 1, view.camera, index), view.truth, index
    )
    relocalizer.find(query)  # the map's transforms are kept from here on
    hover = _Hover(view, asked.config)
    hover.engine.start()
    try:
        if hover.track(_for(_SETTLE_S)) == 0:
            return None
        before = hover.track(_for(_ALONE_S))
        answers: list[tuple[Relocalization | None, float]] = []
        search = threading.Thread(target=lambda: answers.append(_timed(relocalizer, query)))
        search.start()
        beside = hover.track(search.is_alive)
        search.join()
        after = hover.track(_for(_ALONE_S))
    finally:
        hover.close()
    answers.append(_timed(relocalizer, query))
    (_, beside_s), (_, alone_s) = answers
    right = all(_is_right(found, view) for found, _ in answers)
    return Beside(
        asked.name,
        index,
        asked.heading_known,
        (before + after) / 2,
        beside,
        alone_s,
        beside_s,
        right,
    )


def _for(seconds: float) -> Callable[[], bool]:
    end = time.monotonic() + seconds
    return lambda: time.monotonic() < end


def _timed(relocalizer: Relocalizer, query: PlaceQuery) -> tuple[Relocalization | None, float]:
    began = time.perf_counter()
    return relocalizer.find(query), time.perf_counter() - began


def _is_right(found: Relocalization | None, view: BasinView) -> bool:
    if found is None:
        return False
    metres, degrees = found.world_from_camera.distance_to(view.truth)
    return metres <= RIGHT_M and degrees <= RIGHT_DEG


def shares(kept: Sequence[Beside]) -> dict[str, object]:
    """The medians, and the worst, over the views."""

    def of(values: list[float], worst: Callable[[list[float]], float]) -> dict[str, float]:
        return {"p50": float(np.median(values)), "worst": worst(values)}

    return {
        "views": len(kept),
        "found": sum(b.right for b in kept),
        "tracker_alone_hz": of([b.alone_hz for b in kept], min),
        "tracker_beside_hz": of([b.beside_hz for b in kept], min),
        "search_alone_s": of([b.alone_s for b in kept], max),
        "search_beside_s": of([b.beside_s for b in kept], max),
        "search_ratio": of([b.beside_s / b.alone_s for b in kept], max),
        "tracker_share": of([b.beside_hz / b.alone_hz for b in kept], min),
    }


def table(told: dict[str, object]) -> list[tuple[str, str, str, str]]:
    """A line for each figure."""
    wanted = {"tracker_beside_hz": f">= {WANTED_HZ:g}", "search_ratio": f"<= {WANTED_RATIO:g}"}
    return [
        (name, f"{value['p50']:.2f}", f"{value['worst']:.2f}", wanted.get(name, "-"))
        for name, value in told.items()
        if isinstance(value, dict)
    ]


def _run(args: argparse.Namespace) -> list[Beside]:
    config = with_threads(LocalizerConfig(), 1)
    asked = ViewSearch(args.set, config, args.heading == "known", seed=3)
    kept: list[Beside] = []
    more_time = deadline(args.minutes)
    with ExitStack() as stack:
        maps: dict[Path, Relocalizer] = {}
        views = load_views(args.set, args.cache, args.data, args.first + args.views)
        for k, view in enumerate(views[args.first :], args.first):
            if not more_time():
                break
            if view.map_cache not in maps:
                opened = open_relocalizer(TileCache.open(view.map_cache), config)
                if opened is None:
                    raise RuntimeError("an overview that nobody stopped was not made")
                maps[view.map_cache] = stack.enter_context(opened)
            one = measured(asked, k, view, maps[view.map_cache])
            if one is None:
                print(f"view {k}: not tracked, left out", flush=True)
                continue
            kept.append(one)
            if args.out:
                args.out.write_text(json.dumps([asdict(b) for b in kept], indent=1))
    return kept


def main() -> None:
    p = Parser(__doc__)
    p.add_argument("--set", default="generated", help="generated, quito, portugal, caliterra")
    p.add_argument("--views", type=whole(1, 1000), default=8, help="how many")
    p.add_argument("--first", type=whole(0, 100_000), default=0, help="view to begin with")
    p.add_argument("--heading", choices=("known", "unknown"), default="known", help="to 15 degrees")
    p.add_argument("--cache", type=Path, default=Path(".cache/basin"), help="of views and maps")
    p.add_argument("--data", type=Path, default=Path("../shared/data"), help="real sets")
    p.add_argument("--minutes", type=number(0.1, 600), default=60.0, help="then stop")
    p.add_argument("--out", type=output, help="JSON of every view")
    p.add_argument("--report", type=existing, help="an earlier file, no run")
    p.add_argument("--json", type=output, help="the medians")
    args = p.parse_args()
    kept: list[Beside] = []
    if args.report:
        kept = [Beside(**row) for row in json.loads(args.report.read_text())]
    else:
        sys.setswitchinterval(_SWITCH_S)
        kept = _run(args)
    if not kept:
        raise RuntimeError("no view was tracked: nothing was measured")
    rows = table(shares(kept))
    show_figures(args.json, COLUMNS, rows, shares(kept))


if __name__ == "__main__":
    with named_errors():
        main()
