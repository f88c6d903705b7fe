"""Streaming a large generated region: build throughput, and what the render thread waits for.

    python -m benchmarks.map_streaming [--km 10] [--seconds 40] [--budget-mb 384] [--keep DIR]
        [--json streaming.json]

First, regions of growing size are built: tiles a second, and that they stay as they are (regions
that are in DIR already are not built again). Then an aircraft flies over the largest at 25 m/s, at
120 and at 400 m, ten views a second in real time, with and without loading ahead, every time with
a cold page cache. Reported after a warm-up of 5 s: how long `select` and `prefetch` took (nothing
else of the cache runs on the render thread), how much of it was work of that thread, how many
frames were at the wanted detail, and memory.
"""

from __future__ import annotations

import gc
import os
import resource
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.common.arguments import Parser, number, output, whole
from benchmarks.common.figures import write_figures
from benchmarks.common.named_errors import named_errors
from localizer.geometry.camera import Camera
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Pose, so3_exp
from localizer.map.building.build import build_tree
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import StreamCounters, TileStreamer
from localizer.map.source import SourceMesh, SourceNode, SourceTree

ORIGIN = Geodetic(47.0, 8.0, 400.0)
LEAF_M, TEXELS, CELLS = 80.0, 512, 64
DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
SPEED_M_S, RATE_HZ, WARM_UP_S = 25.0, 10.0, 5.0
LOOK_AHEAD_S = (1.0, 3.0)  # as the engine does
FLIGHT_COLUMNS = (
    "flight", "frames", "`select`, p50 / p99 / max ms", "its own work, max ms",
    "`prefetch`, max ms", "at the wanted detail", "misses", "holes", "loaded / evicted",
    "tiles in memory, MiB",
)  # fmt: skip


@dataclass(frozen=True)
class GeneratedTile:
    """A square of hills with a noisy texture; one `TileSource`."""

    west: float
    south: float
    size: float

    @property
    def name(self) -> str:
        return f"{self.size:.0f} m at {self.west:.0f}, {self.south:.0f}"

    def load(self) -> list[SourceMesh]:
        s = np.linspace(0, 1, CELLS + 1)
        u, v = np.meshgrid(s, s)
        east, north = self.west + u * self.size, self.south + (1 - v) * self.size
        z = 25 * np.sin(east / 310) * np.cos(north / 270) + 3 * np.sin(east / 11 + north / 17)
        i = (np.arange(CELLS)[:, None] * (CELLS + 1) + np.arange(CELLS)).ravel()
        n = CELLS + 1
        faces = [np.stack([i, i + n, i + 1], 1), np.stack([i + 1, i + n, i + n + 1], 1)]
        enu = np.stack([east, north, z], -1).reshape(-1, 3)
        ecef = LocalFrame(ORIGIN).ecef_from_enu.apply(enu)
        rng = np.random.default_rng(abs(hash((self.west, self.south, self.size))) % 2**32)
        image = np.zeros((TEXELS, TEXELS, 3), np.float32)
        for cells, weight in ((8, 110), (64, 60), (256, 50)):
            noise = rng.random((cells, cells, 3), dtype=np.float32)
            image += weight * cv2.resize(noise, (TEXELS, TEXELS), interpolation=cv2.INTER_LINEAR)
        uvs = np.stack([u, v], -1).reshape(-1, 2).astype(np.float32)
        pixels = np.clip(image + 15, 0, 255).astype(np.uint8)
        return [SourceMesh(ecef, uvs, np.concatenate(faces).astype(np.int32), pixels)]


def region(km: float) -> SourceTree:
    """A quadtree over about km x km."""
    levels = 1 + int(np.ceil(np.log2(km * 1000 / LEAF_M)))
    half = km * 500

    def node(level: int, west: float, south: float) -> SourceNode:
        size = LEAF_M * 2 ** (levels - 1 - level)
        children = [
            node(level + 1, west + a * size / 2, south + b * size / 2)
            for a in (0, 1)
            for b in (0, 1)
            if level < levels - 1 and west + a * size / 2 < half and south + b * size / 2 < half
        ]
        error = 4 * size / CELLS if children else 0.0
        return SourceNode(error, True, (GeneratedTile(west, south, size),), children)

    centre = LocalFrame(ORIGIN).ecef_from_enu.translation
    return SourceTree(node(0, -half, -half), centre, 48.0, "generated", (), "ellipsoidal", f"{km}")


def build(km: float, out: Path) -> list[str]:
    """Build a region; a row of the table."""
    begin = time.perf_counter()
    manifest = build_tree(region(km), out, name=f"generated {km} km")
    wall = time.perf_counter() - begin
    return [
        f"{km:g} x {km:g} km",
        str(manifest.tiles),
        f"{manifest.bytes / 1e9:.2f}",
        f"{wall:.1f}",
        f"{manifest.tiles / wall:.1f}",
    ]


def _forget(cache: TileCache) -> None:
    """Have the system drop the cache's files from memory, as before a flight."""
    os.sync()  # what is not written yet cannot be dropped
    for path in cache.path.rglob("*.safetensors"):
        descriptor = os.open(path, os.O_RDONLY)
        os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(descriptor)


def camera_at(seconds: float, height: float, km: float) -> Pose:
    """A meander over the region, camera 45 degrees ahead."""
    leg = 0.35 * km * 1000
    along = SPEED_M_S * seconds
    turn, place = divmod(along, leg)
    forward = 1.0 if int(turn) % 2 == 0 else -1.0
    north = forward * (place - leg / 2)
    position = np.array([120.0 * turn - 200.0, north, height + 30.0])
    heading = 0.0 if forward > 0 else np.pi
    return Pose(so3_exp([0, 0, heading]) @ so3_exp([np.pi / 4, 0, 0]) @ DOWN, position)


def fly(
    cache: TileCache, height: float, km: float, seconds: float, budget: int, *, ahead: bool
) -> list[str]:
    """One flight in real time; a row of the table."""
    camera = Camera.from_fov(640, 480, 60.0)
    _forget(cache)
    waits: list[tuple[float, float, float]] = []  # select wall, its thread's time, prefetch wall
    resident: list[int] = []
    with TileStreamer(cache, byte_budget=budget) as streamer:
        begin = time.perf_counter()
        warm: StreamCounters | None = None
        while (now := time.perf_counter() - begin) < seconds + WARM_UP_S:
            if warm is None and now > WARM_UP_S:
                warm = streamer.counters()
                waits.clear()
            start, worked = time.perf_counter(), time.thread_time()
            streamer.select(camera_at(now, height, km), camera)
            selected, worked = time.perf_counter(), time.thread_time() - worked
            if ahead:
                views = [camera_at(now + s, height, km) for s in LOOK_AHEAD_S]
                streamer.prefetch(views, camera)
            waits.append((selected - start, worked, time.perf_counter() - selected))
            resident.append(streamer.counters().resident_bytes)
            spent = time.perf_counter() - begin - now
            time.sleep(max(0.0, 1 / RATE_HZ - spent))
        end = streamer.counters()
    assert warm is not None
    frames = end.selections - warm.selections
    times = 1e3 * np.array(waits).T
    return [
        f"{height:.0f} m, {'ahead' if ahead else 'not ahead'}",
        str(frames),
        " / ".join(f"{t:.2f}" for t in (*np.percentile(times[0], (50, 99)), times[0].max())),
        f"{times[1].max():.2f}",
        f"{times[2].max():.2f}" if ahead else "",
        f"{100 * (end.complete - warm.complete) / frames:.1f} %",
        f"{end.misses - warm.misses} of {end.misses - warm.misses + end.hits - warm.hits}",
        str(end.stalls - warm.stalls),
        f"{end.loaded} / {end.evicted}",
        f"{max(resident) / 2**20:.0f} of {budget / 2**20:.0f}",
    ]


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("--km", type=number(0.5, 100), default=10.0, help="side of the region")
    parser.add_argument(
        "--seconds", type=number(0, 3600), default=40.0, help="of every flight; 0: none"
    )
    parser.add_argument(
        "--budget-mb", type=whole(16, 1 << 16), default=384, help="for tiles in memory, MiB"
    )
    parser.add_argument("--keep", type=Path, help="folder for the caches; else a temporary one")
    parser.add_argument("--json", type=output, help="the flights' table, for the documentation")
    options = parser.parse_args()
    console = Console(width=160)
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        table = Table("region", "tiles", "GB", "seconds", "tiles / s")
        for km in (options.km / 4, options.km / 2, options.km):
            out = folder / f"region{km:g}"
            if not out.exists():
                table.add_row(*build(km, out))
        console.print(table)
        if options.seconds == 0:
            return
        cache = TileCache.open(out)
        # As the companion does after its start: a full collection would stop every thread.
        gc.collect()
        gc.freeze()
        budget = options.budget_mb << 20
        rows = [
            fly(cache, height, options.km, options.seconds, budget, ahead=ahead)
            for height in (120.0, 400.0)
            for ahead in (True, False)
        ]
        table = Table(*FLIGHT_COLUMNS)
        for row in rows:
            table.add_row(*row)
        console.print(table)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        console.print(f"peak resident memory of the process: {peak:.0f} MiB")
        if options.json:
            manifest = cache.manifest
            made = {"km": options.km, "tiles": manifest.tiles, "bytes": manifest.bytes,
                    "peak_resident_mib": round(peak)}  # fmt: skip
            write_figures(options.json, FLIGHT_COLUMNS, rows, made)


if __name__ == "__main__":
    with named_errors():
        main()
