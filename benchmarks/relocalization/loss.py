"""From a loss to a confirmed position: flights over a place that is hidden in a large region.

    python -m benchmarks.relocalization.loss FOLDER --place quito --km2 100 --out loss.json
    python -m benchmarks.relocalization.loss --report loss.json [--json table.json]

FOLDER and region: as of `benchmarks.relocalization.area`; flights, weather and errors: as of
`benchmarks.relocalization.motion`, heading unknown, no velocity. Ten seconds into the flight, of
which one frame a second is kept, the position is lost, and what flies begins: a search of the whole
region, every second one with the kept frames; the next frames searched near its result; that place
tentative in the localizer. The flight goes on for as long as each step takes on this computer, with
whatever else runs on it. Confirmed: the localizer tracks. The world is seen from 120 m above
ground.
"""

from __future__ import annotations

import json
import math
import time
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.basin.views import load_views
from benchmarks.common.arguments import Parser, existing, number, output, whole
from benchmarks.common.figures import show_figures
from benchmarks.common.named_errors import named_errors
from benchmarks.relocalization.area import hide_apart, opened
from benchmarks.relocalization.motion import FRAME_S, PLACE_SIGMA, SETS, LostTrial, TrialSite
from benchmarks.relocalization.run import rank_of
from companion.flight.search import RelocalizationHypothesis
from localizer.config import LocalizerConfig
from localizer.errors import OutsideMapError
from localizer.features.detail import DetailExtractor
from localizer.features.extractor import load_extractor
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.registration.jngo import JNGO
from localizer.relocalization.types import EarlierFrame, PlaceQuery
from localizer.render.numba_raster import NumbaRenderer
from localizer.tracking.motion import AuxiliarySensors
from localizer.tracking.pipeline import Localizer
from localizer.types import PosePrior, TrackingState

_LOST_AT, _KEPT = 39, 10  # frame; frames of a strip
_LATEST = 280  # frame in which a search may begin: a minute after the loss
_FALSE_M = 5.0
_MISSES = 3  # searches near a place
COLUMNS = (
    "km²", "place", "light", "flights", "place ranked first", "found", "confirmed",
    "confirmed within 15 s", "median s", "poses given, false", "CPU s of the first search",
)  # fmt: skip


@dataclass(frozen=True)
class LossOutcome:
    """One flight. ranks: of the place in each search, -1 without; cpu_s: of the first search;
    found_s, confirmed_s: after the loss, None without; given, false: poses given out.
    """

    place: str
    area_km2: float
    flight: int
    condition: str
    ranks: list[int]
    cpu_s: float
    found_s: float | None
    confirmed_s: float | None
    given: int
    false: int


class LostOverRegion(LostTrial):
    """One flight of 80 s, until it is found and confirmed, or not."""

    frames, heights_m = 320, (120.0, 120.0)

    def follow(self, area_km2: float) -> LossOutcome:
        """Search the region, search near, try, confirm."""
        site, k = self._site, _LOST_AT
        localizer = Localizer(
            site.known, site.extractor, site.optimizer, self._camera, site.config,
            AuxiliarySensors(self._rotation, self._displacement),
        )  # fmt: skip
        ranks: list[int] = []
        first_cpu_s, found_s = 0.0, None
        errors: list[float] = []
        seen: RelocalizationHypothesis | None = None
        while k < _LATEST:
            query = self.query(k, together=seen is None and len(ranks) % 2 == 0)
            began, cpu = time.perf_counter(), time.process_time()  # an aircraft renders nothing
            if seen is not None:
                near = seen.predicted_query(query, None, None)
                found = site.relocalizer.find(near) if near is not None else None
            else:
                candidates = site.relocalizer.search(query)
                found = site.relocalizer.confirm(query, candidates)
                ranks.append(rank_of(candidates, self._way.poses[k], self.height_m))
                first_cpu_s = first_cpu_s or time.process_time() - cpu
            at, k = k, k + max(1, math.ceil((time.perf_counter() - began) / FRAME_S))
            if seen is None or found is None:
                kept = seen is not None and seen.misses + 1 < _MISSES
                seen = replace(seen, misses=seen.misses + 1) if seen and kept else None
                if found is not None:
                    seen = RelocalizationHypothesis(query, found)
                    found_s = found_s or (k - _LOST_AT) * FRAME_S
                continue
            covariance = found.covariance + np.diag(PLACE_SIGMA**2)
            localizer.offer(
                PosePrior(found.world_from_camera, covariance, self.time_ns(at),
                          seen.velocity_to(found), independent=False)
            )  # fmt: skip
            seen = None
            while k < self.frames:
                try:
                    estimate = localizer.track(self._frame(k))
                except OutsideMapError:
                    break
                if estimate.accepted:
                    errors.append(estimate.world_from_camera.distance_to(self._way.poses[k])[0])
                k += 1
                status = localizer.tracker.track_status
                if status.state is TrackingState.TRACKING:
                    return self.outcome(area_km2, ranks, first_cpu_s, found_s, k, errors)
                if status.wants_prior:
                    break
        return self.outcome(area_km2, ranks, first_cpu_s, found_s, None, errors)

    def outcome(
        self, area_km2: float, ranks: list[int], cpu_s: float, found_s: float | None,
        confirmed_at: int | None, errors: list[float],
    ) -> LossOutcome:  # fmt: skip
        """Of the flight so far. confirmed_at: number of the frame after, None without."""
        confirmed_s = None if confirmed_at is None else (confirmed_at - _LOST_AT) * FRAME_S
        return LossOutcome(
            self._site.name, area_km2, self._index, self.condition, ranks, cpu_s, found_s,
            confirmed_s, len(errors), sum(e > _FALSE_M for e in errors),
        )  # fmt: skip

    def query(self, k: int, together: bool) -> PlaceQuery:
        """Of frame k, with the frames of the seconds before it if they are laid together."""
        newest = self._known.query(self._frame(k), self._way.poses[k], self._index)
        step = round(1 / FRAME_S)
        before = range(k - step, max(-1, k - _KEPT * step), -step) if together else ()
        older = [self._known.query(self._frame(i), self._way.poses[i], self._index) for i in before]
        earlier = (EarlierFrame(q.frame, q.rotation, q.height_m - newest.height_m) for q in older)
        return replace(newest, earlier=tuple(earlier))


def fly(
    place: str, folder: Path, data: Path, km2: float, flight: int, stack: ExitStack
) -> LossOutcome:
    """One flight over the region."""
    searched, seen, half_m = SETS[place]
    hay = load_views("generated", folder, data, 1)[0].map_cache
    region = folder / "area" / f"{place}-lost-{km2:g}"
    hide_apart(folder / searched, hay, 1000.0 * km2**0.5, region)
    config = LocalizerConfig()
    relocalizer = stack.enter_context(opened(region))

    def renderer(path: Path) -> NumbaRenderer:
        streamer = TileStreamer(TileCache.open(path), byte_budget=2**27)
        return NumbaRenderer(stack.enter_context(streamer), 1)

    site = TrialSite(
        place, half_m, False, renderer(folder / seen), renderer(region), relocalizer,
        DetailExtractor(load_extractor(config.model, threads=1)),
        JNGO(config.registration, threads=1), config,
    )  # fmt: skip
    area_km2 = relocalizer.overview.area_km2
    return LostOverRegion(site, flight, heading_known=False).follow(area_km2)


def cells(outcomes: list[LossOutcome]) -> list[tuple[str, ...]]:
    """A line for each region, place and light."""
    groups = {(round(o.area_km2), o.place, o.condition == "day") for o in outcomes}
    lines: list[tuple[str, ...]] = []
    for area, place, day in sorted(groups):
        some = [
            o for o in outcomes
            if (round(o.area_km2), o.place, o.condition == "day") == (area, place, day)
        ]  # fmt: skip
        times = [o.confirmed_s for o in some if o.confirmed_s is not None]
        lines.append((
            str(area), place, "day" if day else "other", str(len(some)),
            str(sum(o.ranks[0] == 0 for o in some)), str(sum(o.found_s is not None for o in some)),
            str(len(times)), str(sum(t <= 15.0 for t in times)),
            f"{np.median(times):.1f}" if times else "-",
            f"{sum(o.given for o in some)}, {sum(o.false for o in some)}",
            f"{np.median([o.cpu_s for o in some]):.1f}",
        ))  # fmt: skip
    return lines


def main() -> None:
    p = Parser(__doc__)
    p.add_argument("folder", type=existing, nargs="?", help="of worlds and maps")
    places = ("generated", "unseen", "quito")
    p.add_argument("--place", choices=places, default="generated", help="hidden")
    p.add_argument("--km2", type=number(1, 400), default=100.0, help="area")
    p.add_argument("--first", type=whole(0, 100_000), default=0, help="number of the first flight")
    p.add_argument("--flights", type=whole(1, 1000), default=8, help="how many")
    p.add_argument("--data", type=Path, default=Path("../shared/data"), help="real sets")
    p.add_argument("--out", type=output, default=Path("loss.json"), help="JSON of every flight")
    p.add_argument("--report", type=existing, help="table of an earlier file, no run")
    p.add_argument("--json", type=output, help="the table")
    args = p.parse_args()
    if not args.report and args.folder is None:
        p.error("FOLDER is missing")
    path = args.report or args.out
    kept = [LossOutcome(**x) for x in json.loads(path.read_text())] if path.exists() else []
    done = {(o.place, round(o.area_km2), o.flight) for o in kept}
    for flight in () if args.report else range(args.first, args.first + args.flights):
        if (args.place, round(args.km2), flight) in done:
            continue
        with ExitStack() as stack:
            kept.append(fly(args.place, args.folder, args.data, args.km2, flight, stack))
        args.out.write_text(json.dumps([asdict(o) for o in kept], indent=1))
    show_figures(args.json, COLUMNS, cells(kept))


if __name__ == "__main__":
    with named_errors():
        main()
