"""Streaming a large generated region: build throughput, and what the render thread waits for.

    python benchmarks/map_streaming.py [--km 10] [--seconds 60] [--budget-mb 384] [--keep DIR]

First, regions of growing size are built (tiles a second, and that it grows linearly). Then an
aircraft flies over the largest at 25 m/s, at 120 and at 400 m, ten selections a second in real
time, with the pose of one second ahead prefetched. Reported after a warm-up of 5 s: how long
`select` took (nothing else of the cache runs on the render thread), how many frames were at the
wanted detail, and memory.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from localizer.camera import Camera
from localizer.geo import Geodetic, LocalFrame
from localizer.map.build import build_tree
from localizer.map.cache import TileCache
from localizer.map.source import SourceMesh, SourceNode, SourceTree
from localizer.map.stream import TileStreamer
from localizer.pose import Pose, so3_exp

ORIGIN = Geodetic(47.0, 8.0, 400.0)
LEAF_M, TEXELS, CELLS = 80.0, 512, 64
DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
SPEED_M_S, RATE_HZ, WARM_UP_S = 25.0, 10.0, 5.0


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


def build(km: float, out: Path, console: Console) -> tuple[int, float]:
    """Tiles and seconds."""
    start = time.perf_counter()
    manifest = build_tree(region(km), out, name=f"generated {km} km", overwrite=True)
    seconds = time.perf_counter() - start
    console.print(
        f"{km} km: {manifest.tiles} tiles, {manifest.bytes / 1e9:.2f} GB, {seconds:.0f} s"
    )
    return manifest.tiles, seconds


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


def fly(cache: TileCache, height: float, km: float, seconds: float, budget: int) -> list[str]:
    """One flight in real time; a row of the table."""
    camera = Camera.from_fov(640, 480, 60.0)
    waits: list[float] = []
    complete = frames = 0
    most = 0
    with TileStreamer(cache, byte_budget=budget) as streamer:
        begin = time.perf_counter()
        while (now := time.perf_counter() - begin) < seconds + WARM_UP_S:
            before = streamer.counters()
            start = time.perf_counter()
            streamer.select(camera_at(now, height, km), camera)
            wait = time.perf_counter() - start
            streamer.prefetch(camera_at(now + 1.0, height, km), camera)
            after = streamer.counters()
            most = max(most, after.resident_bytes)
            if now > WARM_UP_S:
                waits.append(wait)
                frames += 1
                complete += after.complete - before.complete
            spent = time.perf_counter() - begin - now
            time.sleep(max(0.0, 1 / RATE_HZ - spent))
        counters = streamer.counters()
    p50, p99 = 1e3 * np.percentile(waits, (50, 99))
    return [
        f"{height:.0f} m",
        str(frames),
        f"{p50:.2f} / {p99:.2f} / {1e3 * max(waits):.2f}",
        f"{100 * complete / frames:.1f} %",
        str(counters.stalls),
        f"{counters.loaded} / {counters.evicted}",
        f"{most / 2**20:.0f} of {budget / 2**20:.0f} MiB",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--km", type=float, default=10.0)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--budget-mb", type=int, default=384)
    parser.add_argument("--keep", type=Path, help="folder for the caches; else a temporary one")
    options = parser.parse_args()
    console = Console()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        table = Table("region", "tiles", "seconds", "tiles / s")
        for km in (options.km / 4, options.km / 2, options.km):
            out = folder / f"region{km:g}"
            tiles, seconds = build(km, out, console)
            table.add_row(f"{km:g} km", str(tiles), f"{seconds:.1f}", f"{tiles / seconds:.1f}")
        console.print(table)
        cache = TileCache.open(out)
        table = Table(
            "height", "frames", "select p50 / p99 / max ms", "at wanted detail", "holes",
            "loaded / evicted", "tiles in memory",
        )  # fmt: skip
        for height in (120.0, 400.0):
            budget = options.budget_mb << 20
            table.add_row(*fly(cache, height, options.km, options.seconds, budget))
        console.print(table)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        console.print(f"peak resident memory of the process: {peak:.0f} MiB")


if __name__ == "__main__":
    main()
