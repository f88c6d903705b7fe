"""How dark is too dark: images darkened step by step, and what is still accepted.

    python -m benchmarks.real.darkened FOLDER [--sets fengyuan caliterra ...] [--images 10]

FOLDER keeps the maps between runs. A sensor of 1.5 um pixels (6000 electrons at white, 2.5 of
reading) gets ever less light, with a gain that is fixed or that rises to 16; the image is coded
again as JPEG of quality 70. Each row is a set: of images that are accepted as they are, the share
still accepted by `detail` of the darkened frame (`companion.integrity_monitor.video`).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.basin.views import load_views
from benchmarks.common.arguments import Parser, whole
from benchmarks.common.named_errors import named_errors
from benchmarks.real.judged import judged_images
from benchmarks.real.sets import SETS, RealView, describe, load
from companion.integrity_monitor.video import LOW_DETAIL, detail, thumbnail
from localizer.types import Image
from sitl.camera.faults import darken

_LIGHTS = tuple((1.0 / n, gain) for gain in (1.0, 16.0)
                for n in (64, 256, 512, 1024, 2048, 4096, 8192, 16384))  # fmt: skip
_ATTITUDE_DEG, _WIDTH = 1.0, 320
_EDGES = (0.0, 0.5, 1.0, 1.5, 2.0, 4.0, np.inf)


@dataclass(frozen=True)
class DarkenedView(RealView):
    """A view whose image gets a share of the light it was exposed for. light: 1 changes nothing."""

    light: float = 1.0
    most_gain: float = 1.0
    seed: int = 0

    def image(self) -> Image:
        """See `RealView.image`."""
        rgb = super().image()
        if self.light == 1.0:
            return rgb
        rng = np.random.default_rng((self.seed, int(1.0 / self.light), int(self.most_gain)))
        return darken(rgb, self.light, self.most_gain, rng)


def rows(name: str, views: list[RealView]) -> Iterator[tuple[float, bool]]:
    """Of every darkened image that is accepted as it is: (detail, accepted), from one prior."""
    described = describe("quito" if name == "generated" else name)
    good: set[int] = set()
    for light, most_gain in ((1.0, 1.0), *_LIGHTS):
        dark = [
            DarkenedView(
                v.map_cache, v.camera, v.truth, v.condition, v.file, v.rgb, light, most_gain, k
            )
            for k, v in enumerate(views)
        ]
        for j in judged_images(name, described, dark, _ATTITUDE_DEG, _WIDTH):
            is_taken = j.accepted and j.right
            if light == 1.0:
                good |= {j.image} if is_taken else set()
            elif j.image in good:
                yield detail(thumbnail(dark[j.image].image())), is_taken


def main() -> None:
    p = Parser(__doc__)
    p.add_argument("folder", type=Path, help="of the maps that are built")
    p.add_argument("--data", type=Path, default=Path("../shared/data"), help="real data")
    p.add_argument(
        "--sets", nargs="+", choices=(*SETS, "generated"), default=list(SETS), help="to read"
    )
    p.add_argument("--images", type=whole(1, 100), default=10, help="of each set")
    args = p.parse_args()
    limit = LOW_DETAIL
    bins = list(itertools.pairwise(_EDGES))
    names = " | ".join(f"{low:g} to {high:g}" for low, high in bins)
    print(f"| set | {names} | original below {limit:g} |\n{'|---' * (len(bins) + 2)}|")
    for name in args.sets:
        if name == "generated":
            made = load_views(name, args.folder, args.data, 40)
            all_views = [
                RealView(v.map_cache, v.camera, v.truth, v.condition, rgb=v.query) for v in made
            ]
        else:
            all_views = load(name, args.folder, args.data)
        found = list(rows(name, all_views[:: max(1, len(all_views) // args.images)][: args.images]))
        cells = []
        for low, high in bins:
            some = [ok for figure, ok in found if low <= figure < high]
            cells.append(f"{sum(some)} of {len(some)}")
        alarms = sum(detail(thumbnail(v.image())) < limit for v in all_views)
        print(f"| {name} | {' | '.join(cells)} | {alarms} of {len(all_views)} |", flush=True)


if __name__ == "__main__":
    with named_errors():
        main()
