"""Renderer backends side by side, in one run: CPU and wall time a frame, depth against exact rays.

    python -m benchmarks.rendering [--triangles 0.3 1 2] [--size 512x384] [--frames 20]

The scene is a generated town on hills, all of it resident. Every backend draws the same tiles from
the same poses (nadir and oblique, 120 m); CPU time is of the whole process.
A backend that is not installed or has no driver is named and left out.
"""

from __future__ import annotations

import argparse
import time

import cv2
import numpy as np

from benchmarks.common.arguments import Parser, number, output, whole
from benchmarks.common.figures import show_figures
from benchmarks.common.named_errors import named_errors
from localizer.errors import RenderError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, so3_exp
from localizer.map.cache.pick import cast_rays
from localizer.map.cache.tile import TileMesh, build_mips
from localizer.render.base import MapRenderer, StaticTiles
from localizer.render.select import make_renderer
from localizer.types import Image

SIDE_M, TILES = 1200.0, 6  # a side of the town, and tiles along it
REPEATS = 5
DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])


def town(triangles: float) -> list[TileMesh]:
    """TILES x TILES tiles of terrain with houses as steps in the height, 1024-texel textures."""
    rng = np.random.default_rng(0)
    cells = round(np.sqrt(triangles / 2) / TILES)
    size = SIDE_M / TILES
    s = np.linspace(0, size, cells + 1)
    x, y = np.meshgrid(s, s[::-1])
    uvs = np.stack([x / size, 1 - y / size], -1).reshape(-1, 2).astype(np.float32)
    i = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    n = cells + 1
    faces = np.concatenate([np.stack([i, i + n, i + 1], 1), np.stack([i + 1, i + n, i + n + 1], 1)])
    meshes = []
    for west in np.arange(TILES) * size - SIDE_M / 2:
        for south in np.arange(TILES) * size - SIDE_M / 2:
            z = 10 * np.sin((x + west) / 90) + 8 * np.cos((y + south) / 70)
            for _ in range(25):
                a, b = rng.uniform(0, size - 15, 2)
                z[(x > a) & (x < a + 12) & (y > b) & (y < b + 15)] += rng.uniform(4, 20)
            meshes.append(
                TileMesh(
                    np.stack([x, y, z], -1).reshape(-1, 3).astype(np.float32),
                    uvs,
                    faces.astype(np.int32),
                    build_mips(texture(rng)),
                    Pose(np.eye(3), np.array([west, south, 0.0])),
                )
            )
    return meshes


def texture(rng: np.random.Generator) -> Image:
    """Noise of three sizes, 1024 texels."""
    total = np.zeros((1024, 1024, 3), np.float32)
    for cells, weight in ((8, 110), (100, 60), (1024, 50)):
        noise = rng.random((cells, cells, 3), dtype=np.float32)
        total += weight * cv2.resize(noise, (1024, 1024), interpolation=cv2.INTER_LINEAR)
    return np.clip(total + 15, 0, 255).astype(np.uint8)


def poses(count: int) -> list[Pose]:
    """Over the town at 120 m, looking down and ahead in turn."""
    rng = np.random.default_rng(1)
    result = []
    for k in range(count):
        place = np.array([*rng.uniform(-350, 350, 2), 130.0])
        tilt = so3_exp([0, 0, rng.uniform(-3, 3)]) @ so3_exp([0.9 * (k % 2), 0, 0])
        result.append(Pose(tilt @ DOWN, place))
    return result


def measure(renderer: MapRenderer, camera: Camera, frames: int) -> tuple[float, float]:
    """CPU and wall milliseconds: of every pose the least of a few renders, which other work on the
    machine disturbs least; the median over poses.
    """
    for pose in poses(2):
        renderer.render(pose, camera)
    times = []
    for pose in poses(frames):
        rounds = []
        for _ in range(REPEATS):
            cpu, wall = time.process_time(), time.perf_counter()
            renderer.render(pose, camera)
            rounds.append((time.process_time() - cpu, time.perf_counter() - wall))
        times.append(np.min(rounds, axis=0))
    cpu_ms, wall_ms = 1e3 * np.median(times, axis=0)
    return float(cpu_ms), float(wall_ms)


def depth_error(renderer: MapRenderer, meshes: list[TileMesh], camera: Camera) -> np.ndarray:
    """|depth - exact| of some pixels away from edges, metres."""
    rng = np.random.default_rng(2)
    errors = []
    for pose in poses(4):
        depth = renderer.render(pose, camera).depth
        u, v = rng.integers(2, camera.width - 2, 100), rng.integers(2, camera.height - 2, 100)
        around = np.stack([depth[v + j, u + i] for i in (-1, 0, 1) for j in (-1, 0, 1)])
        rays = camera.rays(np.stack([u + 0.5, v + 0.5], -1))
        truth = cast_rays(meshes, pose.translation, rays @ pose.rotation.T)
        keep = (around.min(axis=0) > 0) & (around.max(axis=0) < 1.05 * around.min(axis=0))
        errors.append(np.abs(depth[v, u] - truth)[keep & np.isfinite(truth)])
    return np.concatenate(errors)


def size(text: str) -> tuple[int, int]:
    """Width and height of WIDTHxHEIGHT."""
    width, _, height = text.partition("x")
    try:
        return whole(16, 8192)(width), whole(16, 8192)(height)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT: {error}") from error


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument(
        "--triangles", nargs="+", type=number(0.01, 20), default=[0.3, 1.0, 2.0], help="millions"
    )
    parser.add_argument("--size", type=size, default="512x384", help="of the image, pixels")
    parser.add_argument("--frames", type=whole(1, 10_000), default=20, help="poses measured")
    parser.add_argument("--threads", type=whole(1, 256), default=2, help="of numba")
    parser.add_argument("--json", type=output, help="the table, for benchmarks.site.keep")
    options = parser.parse_args()
    width, height = options.size
    camera = Camera.from_fov(width, height, 60.0)
    columns = (
        "backend", "M triangles", "CPU ms", "wall ms", "CPU / numba", "depth median", "depth p99.9",
    )  # fmt: skip
    rows = list[tuple[str, ...]]()
    for millions in options.triangles:
        meshes = town(millions * 1e6)
        count = sum(len(m.faces) for m in meshes)
        reference: float | None = None
        for backend in ("numba", "moderngl", "pyrender"):
            try:
                renderer = make_renderer(backend, StaticTiles(meshes), threads=options.threads)
            except RenderError as error:
                print(f"{backend}: {error}")
                continue
            cpu, wall = measure(renderer, camera, options.frames)
            reference = cpu if reference is None else reference
            errors = 1e3 * depth_error(renderer, meshes, camera)
            rows.append(
                (
                    renderer.name,
                    f"{count / 1e6:.2f}",
                    f"{cpu:.1f}",
                    f"{wall:.1f}",
                    f"{cpu / reference:.1f}",
                    f"{np.median(errors):.3f} mm",
                    f"{np.percentile(errors, 99.9):.3f} mm",
                )
            )
            renderer.close()
    show_figures(options.json, columns, rows)


if __name__ == "__main__":
    with named_errors():
        main()
