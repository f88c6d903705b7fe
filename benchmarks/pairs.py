"""How fast training pairs are made: places in processes, pairs on a device and on the CPU.

    python -m benchmarks.pairs configs/train_s0.yaml --pairs 4 [--json out.json]

One process, one thread, places of the run's own size. "torch" is what `training.data.live`
does (views, appearance, windows), on a GPU where there is one; "NumPy" makes pairs of the same
places by the CPU's renderer, as the shards are made.
"""

from __future__ import annotations

import time

import cv2
import numpy as np

from benchmarks.common.arguments import Parser, existing, output, whole
from benchmarks.common.figures import write_figures
from benchmarks.common.named_errors import named_errors, needs_torch

with needs_torch():
    import torch

    from localizer.synth.heightfield.render import render
    from localizer.training.config import LiveSection, load_config
    from localizer.training.data.batches import LoaderConfig, crop_pair, window_pair
    from localizer.training.data.lit_places import PlaceVisits, make_place
    from localizer.training.data.live import LivePlan, LiveStream
    from localizer.training.data.pairs import Pair, SceneConfig, draw_views
    from localizer.training.data.streams import photo_source, scene_config

_ON_CPU = 4  # pairs are enough for a rate: each takes a second or more


def numpy_pairs(
    place: PlaceVisits, scenes: SceneConfig, loader: LoaderConfig, count: int
) -> tuple[int, float]:
    """Pairs made and the seconds that took, by the CPU's renderer and appearance."""
    rng = np.random.default_rng(0)
    made, began = 0, time.perf_counter()
    while made < count:
        lit, visit, season = place.days[made % len(place.days)]
        views = draw_views(rng, place.survey, lit, scenes)
        if views is None:
            continue
        reference, query, camera = views
        image, depth = render(place.survey, reference, camera)
        seen, seen_depth = render(lit, query, camera, supersample=2)
        pair = Pair(image, depth, seen, seen_depth, reference, query, camera, visit.weather,
                    visit.outdated, place.source, season)  # fmt: skip
        crop_pair(pair, loader, rng)
        made += 1
    return made, time.perf_counter() - began


def device_pairs(stream: LiveStream, loader: LoaderConfig, count: int) -> tuple[int, float]:
    """Pairs made and the seconds that took, on the stream's device."""
    rng, noise = np.random.default_rng(0), torch.Generator(stream.device)
    began, made = time.perf_counter(), 0
    for pair in stream.pairs(0, count, rng, noise):
        window_pair(pair, loader, rng)
        made += 1
    return made, time.perf_counter() - began


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("config", type=existing, help="YAML of a run with live pairs")
    parser.add_argument(
        "--pairs", type=whole(1, 10_000), default=4, help="in one batch on the device"
    )
    parser.add_argument("--no-photos", action="store_true", help="generated ground alone")
    parser.add_argument("--json", type=output, help="the table, for benchmarks.site.keep")
    args = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    run = load_config(args.config)
    if not isinstance(run.data, LiveSection):
        parser.error("the configuration has no live pairs")
    data, o = run.data, run.optimizer
    scenes, photos = scene_config(data), None if args.no_photos else photo_source(data)
    loader = LoaderConfig(o.batch, o.anchors, o.crop, data.appearance)
    make_place(data.first_seed, scenes, photos, 1)  # compiles
    began = time.perf_counter()
    places = [make_place(data.first_seed + k, scenes, photos, data.flight_days) for k in (1, 2)]
    each = (time.perf_counter() - began) / len(places)
    place = f"place of {data.cells} cells with {data.flight_days} flight days, one core"
    rows = [(place, f"{each:.2f} s")]
    print(*rows[-1], flush=True)
    numpy_pairs(places[0], scenes, loader, 1)
    made, seconds = numpy_pairs(places[0], scenes, loader, min(args.pairs, _ON_CPU))
    rows.append(("pairs by NumPy, one core", f"{made / seconds:.2f} /s"))
    print(*rows[-1], flush=True)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    plan = LivePlan(data.first_seed, data.scenes, 2, 1, data.flight_days)
    stream = LiveStream(plan, scenes, photos, loader, run.seed, device)
    try:
        stream.take(0, places[0])
        stream.take(1, places[1])
        device_pairs(stream, loader, 1)
        made, seconds = device_pairs(stream, loader, args.pairs)
    finally:
        stream.close()
    rows.append((f"pairs by torch on {device}", f"{made / seconds:.2f} /s"))
    print(*rows[-1])
    if args.json is not None:
        write_figures(args.json, ("training data", "found"), rows)


if __name__ == "__main__":
    with named_errors():
        main()
