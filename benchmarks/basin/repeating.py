"""Registrations between two equal modes: a flat ground whose features repeat every 12 to 24 m.

    python -m benchmarks.basin.repeating [--pairs 60] [--json repeating.json]

The prior lies between the true place and its copy one period away. What decides is the prediction
(equation 10); without one, either place may be found, and the covariance has to know of the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.basin.variants import FULL, Variant, changed
from benchmarks.common.arguments import Parser, output, whole
from benchmarks.common.figures import write_figures
from benchmarks.common.named_errors import named_errors
from benchmarks.features.report import wilson
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.registration import select_anchors
from localizer.training.data.pairs import look_at
from localizer.types import FeatureLevel, FeaturePyramid, PosePrior, RenderedView

_CAMERA = Camera(160, 120, 150.0, 144.0, 76.0, 63.5)
_STRIDES, _CHANNELS, _WAVES = (8, 4, 2), 16, 6
_ANCHORS, _NOISE = 300, 0.1
_COLUMNS = (
    "", "n", "the predicted place found", "without a prediction, covariance knows of the other",
)  # fmt: skip


@dataclass(frozen=True)
class RepeatingGround:
    """The plane z = 0 with features that repeat every `period` metres both ways.

    waves: per level (C, W, 3) wave numbers (rad/m) and phases.
    """

    period: float
    waves: tuple[Array, ...]

    @classmethod
    def random(cls, rng: np.random.Generator) -> RepeatingGround:
        """A period of 12 to 24 m and random features."""
        period = float(rng.uniform(12, 24))
        size = (_CHANNELS, _WAVES)
        waves = [
            np.stack(
                [*(2 * np.pi / period * rng.integers(-1, 2, (2, *size))),
                 rng.uniform(0, 2 * np.pi, size)], axis=-1,
            )
            for _ in _STRIDES
        ]  # fmt: skip
        return cls(period, tuple(waves))

    def east(self, periods: float) -> Array:
        """So many periods to the east, m."""
        return np.array([self.period * periods, 0.0, 0.0])

    def view(self, pose: Pose) -> RenderedView:
        """What a renderer would give, without colours."""
        depth = self._depth(pose, 1)[0]
        blank = np.zeros((*depth.shape, 3), np.uint8)
        return RenderedView(blank, depth.astype(np.float32), pose, _CAMERA)

    def pyramid(self, pose: Pose, rng: np.random.Generator) -> FeaturePyramid:
        """Noisy unit features of a view."""
        levels = []
        for waves, stride in zip(self.waves, _STRIDES, strict=True):
            depth, rays = self._depth(pose, stride)
            ground = pose.apply(rays * depth[..., None])
            x, y = ground[..., :1, None], ground[..., 1:2, None]
            f = np.sin(x * waves[..., 0] + y * waves[..., 1] + waves[..., 2]).sum(axis=-1) + 0.5
            f /= np.linalg.norm(f, axis=-1, keepdims=True)
            f += _NOISE * rng.standard_normal(f.shape)
            f /= np.linalg.norm(f, axis=-1, keepdims=True)
            levels.append(
                FeatureLevel(f.astype(np.float32), np.full(f.shape[:2], 0.7, np.float32), stride)
            )
        return FeaturePyramid(tuple(levels), _CAMERA.width, _CAMERA.height)

    @staticmethod
    def _depth(pose: Pose, stride: int) -> tuple[Array, Array]:
        v, u = np.mgrid[0 : _CAMERA.height // stride, 0 : _CAMERA.width // stride]
        rays = _CAMERA.rays((np.stack([u, v], axis=-1) + 0.5) * stride)
        return -pose.translation[2] / (rays @ pose.rotation.T)[..., 2], rays


def rows() -> list[Variant]:
    """The choices that only matter where modes compete."""
    return [
        Variant(FULL),
        Variant("without motion term", motion=False),
        changed("survivors may repeat", distinct_px=0.0),
        changed("halving to 32 and 8", keep=(32, 8)),
        changed("10 iterations at the end, not 4", iterations=(2, 3, 10)),
    ]


def trials(count: int) -> Iterator[tuple[str, bool, bool]]:
    """(row, whether the predicted mode is found, whether the covariance knows of the other)."""
    made = [(v, v.optimizer()) for v in rows()]
    for index in range(count):
        rng = np.random.default_rng(index // 2)
        ground = RepeatingGround.random(rng)
        pose = look_at(np.zeros(3), 110.0, np.radians(rng.uniform(60, 90)), rng)
        anchors = select_anchors(ground.view(pose), ground.pyramid(pose, rng), _ANCHORS)
        query = ground.pyramid(pose, rng)
        between = pose.translation + ground.east(rng.uniform(0.3, 0.7))
        prior = PosePrior(Pose(pose.rotation, between), _covariance(6.0, 5.0), 0)
        mode = pose.translation + ground.east(index % 2)
        predicted = PosePrior(Pose(pose.rotation, mode), _covariance(3.0, 2.0), 0)
        for variant, optimizer in made:
            arguments = (query, _CAMERA, anchors, prior)
            motion = predicted if variant.motion else None
            found = optimizer.register(*arguments, motion=motion, seed=index).world_from_camera
            right = bool(np.linalg.norm(found.translation - mode) < 1.5)
            alone = optimizer.register(*arguments, seed=index)
            yield variant.name, right, bool(alone.covariance[0, 0] > (0.2 * ground.period) ** 2)


def _covariance(metres: float, degrees: float) -> Array:
    return np.asarray(np.diag(np.repeat([metres, np.radians(degrees)], 3) ** 2))


def table(outcomes: Sequence[tuple[str, bool, bool]]) -> list[tuple[str, ...]]:
    """Cells of `_COLUMNS`: a row a variant, shares in per cent with Wilson's interval."""
    rows = []
    for name in dict.fromkeys(o[0] for o in outcomes):
        mine = np.array([o[1:] for o in outcomes if o[0] == name])
        shares = (_share(int(hits), len(mine)) for hits in mine.sum(0))
        rows.append((f"**{name}**" if name == FULL else name, str(len(mine)), *shares))
    return rows


def _share(hits: int, count: int) -> str:
    low, high = wilson(hits, count)
    return f"{100 * hits / count:.0f} % [{low:.0f}, {high:.0f}]"


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("--pairs", type=whole(1, 100_000), default=60, help="of places")
    parser.add_argument("--json", type=output, help="the table")
    args = parser.parse_args()
    cells = table(list(trials(args.pairs)))
    for row in (_COLUMNS, *cells):
        print(" | ".join(row))
    if args.json:
        write_figures(args.json, _COLUMNS, cells)


if __name__ == "__main__":
    with named_errors():
        main()
