"""Do two views of a map agree on its surface? Relative depth errors, both ways (paper, Fig. 14).

    python -m benchmarks.depths MAP [--heights 100 200 400 800] [--pairs 6] [--json] [--plot]

Pairs of views from random directions, a fifth to half of the height apart: each pixel's depth of
one view is carried to the other and compared with the depth there, and the other way round. Counted
are the pixels that fall into the other picture; those that it does not see (another surface is
before them) are no agreement, and stand beside as such. That is the data that synthetic pairs and
references are made of; the paper's curve is of its own data, and not measured here.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.common.arguments import Parser, existing, number, output, whole
from benchmarks.common.named_errors import named_errors
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose, so3_exp
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.render.base import MapRenderer
from localizer.render.numba_raster import NumbaRenderer
from localizer.types import Float32, RenderedView

_DOWN = np.diag([1.0, -1.0, -1.0])
CAMERA = Camera.from_fov(640, 480, 60.0)
_MOST_TILT = 0.9  # rad from straight down
_APART = (0.2, 0.5)  # of the height
_HIDDEN = 0.02  # relative: a surface that lies so far before the pixel's hides it
_BINS = np.logspace(-6, -1, 101)


@dataclass(frozen=True)
class DepthAgreement:
    """Of one height, both ways. errors: (N,) relative, of what both views see; hidden: share of all
    pixels compared.
    """

    height_m: float
    errors: Array
    hidden: float

    def to_dict(self) -> dict[str, object]:
        """Quantiles, and the curve at `_BINS`."""
        median, p95, p99 = (float(q) for q in np.percentile(self.errors, [50, 95, 99]))
        curve = [float((self.errors <= b).mean()) for b in _BINS]
        return {
            "height_m": self.height_m, "pixels": len(self.errors), "median": median, "p95": p95,
            "p99": p99, "within_1_percent": 100 * float((self.errors <= 0.01).mean()),
            "hidden_percent": 100 * self.hidden, "curve": curve,
        }  # fmt: skip


def carried(one: RenderedView, other: RenderedView) -> tuple[Array, Array]:
    """Of the pixels of `one` that fall into `other`: their depth there (N,), and the depth that it
    has, at the four pixels around the nearest to the pixel's own.
    """
    rows, columns = np.nonzero(one.depth > 0)
    pixels = np.stack([columns, rows], axis=1) + 0.5
    points = one.world_from_camera.apply(
        one.camera.rays(pixels) * one.depth[rows, columns, None].astype(np.float64)
    )
    x = other.world_from_camera.inverse.apply(points)
    uv, inside = other.camera.project(x)
    h, w = other.depth.shape
    with np.errstate(invalid="ignore"):
        inside &= ((uv > 1) & (uv < (w - 1, h - 1))).all(axis=1)
    uv, z = uv[inside], x[inside, 2]
    seen = _inverse_depth(other.depth, uv)
    whole = np.isfinite(seen)
    return z[whole], 1.0 / seen[whole]


def _inverse_depth(depth: Float32, uv: Array) -> Array:
    """1/z is linear on a plane: bilinear of the four pixels around (N, 2); NaN beside a hole or
    where the four do not lie on one surface.
    """
    with np.errstate(divide="ignore"):
        inverse = np.where(depth > 0, 1.0 / depth.astype(np.float64), np.nan)
    column, row = np.floor(uv - 0.5).astype(int).T
    a, b = (uv - 0.5 - np.stack([column, row], axis=1)).T
    four = np.stack([inverse[row + j, column + i] for j in (0, 1) for i in (0, 1)])
    weights = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    value = (weights * four).sum(axis=0)
    edge = np.abs(four[0] + four[3] - four[1] - four[2]) > 0.01 * np.abs(value)
    flat: Array = np.where(edge, np.nan, value)
    return flat


def agreement(renderer: MapRenderer, side_m: float, height_m: float, pairs: int) -> DepthAgreement:
    """Pairs of views over the middle of a map, `height_m` above its ground."""
    rng = np.random.default_rng([round(height_m), 14])
    errors, compared, hidden = [], 0, 0
    for _ in range(pairs):
        views = _pair(renderer, rng, side_m, height_m)
        for one, other in (views, views[::-1]):
            z, seen = carried(one, other)
            relative = (z - seen) / z
            compared, hidden = compared + len(z), hidden + int((relative > _HIDDEN).sum())
            errors.append(np.abs(relative[relative <= _HIDDEN]))
    return DepthAgreement(height_m, np.concatenate(errors), hidden / max(compared, 1))


def _pair(
    renderer: MapRenderer, rng: np.random.Generator, side_m: float, height_m: float
) -> tuple[RenderedView, RenderedView]:
    """Both look at about the same ground."""
    place = rng.uniform(-0.1 * side_m, 0.1 * side_m, 2)
    above = renderer.render(Pose(_DOWN, np.array([*place, 2000.0])), CAMERA, wait=True)
    ground = 2000.0 - float(np.median(above.depth[above.depth > 0]))
    centre = np.array([*place, ground])
    yaw, tilt = rng.uniform(-np.pi, np.pi), rng.uniform(0.0, _MOST_TILT)
    turn = rng.uniform(*_APART) * rng.choice([-1.0, 1.0])
    looks = (
        so3_exp([0, 0, yaw]) @ so3_exp([tilt, 0, 0]) @ _DOWN,
        so3_exp([0, 0, yaw + turn]) @ so3_exp([max(tilt - abs(turn), 0.0), 0, 0]) @ _DOWN,
    )
    cameras = (Pose(R, centre - height_m / max(-R[2, 2], 0.3) * R[:, 2]) for R in looks)
    one, other = (renderer.render(pose, CAMERA, wait=True) for pose in cameras)
    return one, other


def draw(found: list[dict[str, object]], path: Path) -> None:
    """The share of pixels within a relative error, a curve for each height."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axis = plt.subplots(figsize=(6.5, 3.6))
    for row in found:
        axis.plot(_BINS, 100 * np.asarray(row["curve"]), label=f"{row['height_m']:.0f} m")
    axis.set(xscale="log", xlabel="relative depth error", ylabel="% of pixels that both see")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=90)
    plt.close(figure)


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("map", type=existing, help="tile cache")
    parser.add_argument(
        "--heights", type=number(20, 5000), nargs="+", default=[100, 200, 400, 800],
        help="above ground, m",
    )  # fmt: skip
    parser.add_argument("--pairs", type=whole(1, 10_000), default=6, help="of each height")
    parser.add_argument("--side", type=number(50, 1e6), default=1600.0, help="of the map, m")
    parser.add_argument("--json", type=output, help="every figure")
    parser.add_argument("--plot", type=output, help="PNG of the curves")
    args = parser.parse_args()
    found = []
    with TileStreamer(TileCache.open(args.map)) as streamer:
        renderer = NumbaRenderer(streamer, 1)
        for height_m in args.heights:
            found.append(agreement(renderer, args.side, height_m, args.pairs).to_dict())
            print({k: v for k, v in found[-1].items() if k != "curve"}, flush=True)
    if args.json:
        args.json.write_text(json.dumps({"bins": list(_BINS), "rows": found}) + "\n")
    if args.plot:
        draw(found, args.plot)


if __name__ == "__main__":
    with named_errors():
        main()
