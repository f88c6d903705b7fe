"""What the gate refuses and lets in while ours tracks, by what its prediction knows of turns.

    python -m benchmarks.places.gate FOLDER [--frames 150] [--processes 2] [--json gate.json]

Three places of other seeds than the table's, by day at both heights. Every row tracks the same
frames: with the motion model's angular acceleration as shipped and wider, and as shipped with the
turns that an autopilot tells. Refused by the gate alone: a registration within 3 m and 3 degrees
that every other test passed. Beside them the same pictures are registered from the wrong beginnings
of `benchmarks.integrity`; what of it passes every other test is held against each row's prediction
of that frame: right and wrong ones that the gate would let in. Reach: how far off along the worst
axis a pose may be that the gate still lets in, in the middle of all frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from benchmarks.common.arguments import Parser, output, whole
from benchmarks.common.figures import write_figures
from benchmarks.common.named_errors import named_errors, needs_torch
from localizer.config import LocalizerConfig
from localizer.errors import OutsideMapError
from localizer.evaluation.sequences import Perturbation
from localizer.evaluation.sequences import Sequence as Recorded
from localizer.features import load_extractor
from localizer.features.detail import DetailExtractor
from localizer.geometry.pose import Array, Pose
from localizer.integrity.acceptance import is_acceptable
from localizer.registration import JNGO, Registration
from localizer.tracking.motion import (
    AuxiliarySensors,
    MeasuredMotion,
    MotionConfig,
    mahalanobis_squared,
)
from localizer.tracking.opening import MapStack
from localizer.tracking.pipeline import (
    Localizer,
    Undistorter,
    reference_anchors,
    working_camera,
)
from localizer.types import PosePrior, TrackingState

with needs_torch():
    from benchmarks.basin.views import BasinView
    from benchmarks.integrity.beginnings import beginnings
    from benchmarks.places.flights import FULL, Cell, sequence_of, true_path
    from benchmarks.places.rivals import PASSES, stack_of
    from benchmarks.places.run import PRIOR
    from benchmarks.places.turns import ToldTurns
    from benchmarks.places.worlds import GeneratedPlace, PlaceFolder, open_place

PLACES = (
    GeneratedPlace("village", 3_200_001),
    GeneratedPlace("dense town", 3_200_002, "dense"),
    GeneratedPlace("hills", 3_200_003, relief_m=90.0),
)
COLUMNS = (
    "prediction", "frames", "refused by the gate alone", "where the truth is refused, too",
    "median, m", "R@3", "given wrong", "reach, m", "reach, deg", "right let in", "wrong let in",
)  # fmt: skip
_ROWS = {"1 rad/s²": 1.0, "2 rad/s²": 2.0, "4 rad/s²": 4.0}
_TURNS = "1 rad/s², told turns"
_SETTLED = 4  # frames after which the prior is forgotten
_EVERY = 12  # frames from one that is attacked to the next
_TRIED = (10, 75, 140)  # frames of the other sequences at whose places it is registered, too
_WRONG = 3.0  # beyond so many metres or degrees


@dataclass(frozen=True)
class JudgedFrame:
    """One frame of a row. distance, of_truth: squared, of the registration and of the true pose
    from the prediction; good: it passed every other test; reach (2,): metres, degrees.
    """

    index: int
    prediction: PosePrior
    tracking: bool
    accepted: bool
    good: bool
    raw: tuple[float, float]
    distance: float
    of_truth: float
    error: tuple[float, float]
    reach: tuple[float, float]


@dataclass(frozen=True)
class Intruder:
    """A registration from elsewhere that passed every test but the gate."""

    index: int
    pose: Pose
    covariance: Array
    wrong: bool


class _Heard(JNGO):
    """Keeps the newest registration, which the localizer does not tell."""

    newest: Registration

    def register(self, *args, **more):  # type: ignore[no-untyped-def]
        """As JNGO's."""
        self.newest = super().register(*args, **more)
        return self.newest


def tracked(
    cell: Cell,
    home: PlaceFolder,
    sequence: Recorded,
    config: LocalizerConfig,
    sensors: AuxiliarySensors,
) -> list[JudgedFrame]:
    """Ours over a sequence, every frame with its prediction."""
    stack = stack_of(home.map_cache, config)
    optimizer = _Heard(config.registration, threads=1)
    extractor = DetailExtractor(load_extractor(config.model, threads=1))
    localizer = Localizer(
        stack.renderer, extractor, optimizer, sequence.camera, config, sensors,
        map_frame=stack.cache.frame, is_loading=lambda: not stack.streamer.idle,
    )  # fmt: skip
    motion = MeasuredMotion(config.motion, sensors.rotation_at)
    judged = []
    try:
        for index, truth in enumerate(sequence.truth):
            frame = sequence.frame(index)
            if index == 0:
                drawn = Perturbation(PRIOR.translation_m, PRIOR.rotation_deg, cell.seed)
                localizer.set_prior(drawn.prior(truth, index, frame.exposure_time_ns))
            seen = localizer.tracker
            assert seen.motion is not None
            ahead = motion.at_frame(seen.motion, frame.exposure_time_ns).prior
            try:
                estimate = localizer.track(frame, passes=PASSES if index == 0 else 1)
            except OutsideMapError:
                continue
            found = optimizer.newest
            spread = ahead.covariance + found.covariance
            judged.append(
                JudgedFrame(
                    index,
                    ahead,
                    seen.track_status.state is TrackingState.TRACKING,
                    estimate.accepted,
                    is_acceptable(config.integrity, found, 0.0),
                    truth.distance_to(found.world_from_camera),
                    mahalanobis_squared(ahead, found.world_from_camera, found.covariance),
                    mahalanobis_squared(ahead, truth, found.covariance),
                    truth.distance_to(estimate.world_from_camera),
                    _reach(spread, config.integrity.chi2_threshold),
                )
            )
    finally:
        stack.close()
    return [j for j in judged if j.index >= _SETTLED]


def _reach(spread: Array, gate: float) -> tuple[float, float]:
    level, turned = (np.linalg.eigvalsh(spread[k, k])[-1] for k in (slice(2), slice(3, 6)))
    return float(np.sqrt(gate * level)), float(np.degrees(np.sqrt(gate * turned)))


def intruders(
    cell: Cell, sequences: dict[Cell, tuple[PlaceFolder, Recorded]], config: LocalizerConfig
) -> Iterator[Intruder]:
    """Of every twelfth frame, from the wrong beginnings and from those near the truth."""
    home, sequence = sequences[cell]
    optimizer = JNGO(config.registration, threads=1)
    extractor = DetailExtractor(load_extractor(config.model, threads=1))
    stacks = {
        folder.map_cache: stack_of(folder.map_cache, config) for folder, _ in sequences.values()
    }
    tried = [_view(f, s, k) for f, s in sequences.values() for k in _TRIED if k < len(s.images)]
    here = [v for v in tried if v.map_cache == home.map_cache]
    others = [v for v in tried if v.map_cache != home.map_cache]
    try:
        for index in range(_SETTLED + 2, len(sequence.images), _EVERY):
            view = _view(home, sequence, index)
            query = extractor.extract(view.query)
            for begun in beginnings(view, index, here, others):
                stack: MapStack = stacks[begun.map_cache]
                pose = begun.prior.world_from_camera
                seen = stack.renderer.render(pose, begun.camera, wait=True)
                if (seen.depth > 0).mean() < 0.1:  # as in flight
                    continue
                anchors = reference_anchors(seen, extractor, config.anchors, config.seed)
                found = optimizer.register(query, begun.camera, anchors, begun.prior, seed=index)
                if is_acceptable(config.integrity, found, 0.0):
                    off = max(view.truth.distance_to(found.world_from_camera))
                    wrong = off > _WRONG or not begun.has_truth
                    yield Intruder(index, found.world_from_camera, found.covariance, wrong)
    finally:
        for stack in stacks.values():
            stack.close()


def _view(home: PlaceFolder, sequence: Recorded, index: int) -> BasinView:
    camera = working_camera(sequence.camera, 320)
    picture = Undistorter(sequence.camera, camera)(sequence.frame(index))
    return BasinView(home.map_cache, picture, sequence.truth[index], camera, "day", 0.0)


@dataclass(frozen=True)
class Counted:
    """One row on one sequence. let_in (2, 2): right and wrong intruders that the gate lets in, of
    how many.
    """

    judged: list[JudgedFrame]
    let_in: Array


def measured(cell: Cell, cells: Sequence[Cell], folder: Path, frames: int) -> dict[str, Counted]:
    """All rows on one sequence."""
    cv2.setNumThreads(1)
    sequences = {}
    for c in cells:
        home = open_place(c.place, folder, c.seen)
        sequences[c] = home, sequence_of(c, home, folder, frames)
    home, sequence = sequences[cell]
    told = AuxiliarySensors(ToldTurns(true_path(cell, home), cell.seed).rotation)
    base = LocalizerConfig(width=320, threads=1, renderer="numba", device="cpu")
    attack = list(intruders(cell, sequences, base))
    rows = {}
    for name, sigma in {**_ROWS, _TURNS: 1.0}.items():
        motion = MotionConfig(angular_acceleration_sigma=sigma)
        config = base.model_copy(update={"motion": motion})
        sensors = told if name == _TURNS else AuxiliarySensors()
        judged = tracked(cell, home, sequence, config, sensors)
        rows[name] = Counted(judged, _let_in(judged, attack, base.integrity.chi2_threshold))
    return rows


def _let_in(judged: Sequence[JudgedFrame], attack: Sequence[Intruder], gate: float) -> Array:
    at = {j.index: j.prediction for j in judged if j.tracking}
    counts = np.zeros((2, 2), int)
    for i in (i for i in attack if i.index in at):
        inside = mahalanobis_squared(at[i.index], i.pose, i.covariance) <= gate
        counts[int(i.wrong)] += int(inside), 1
    return counts


def line(name: str, counted: Sequence[Counted], gate: float) -> list[str]:
    """A row of the table over all sequences."""
    judged = [j for c in counted for j in c.judged]
    right = [j for j in judged if j.accepted and max(j.error) <= _WRONG]
    alone = [
        j for j in judged
        if not j.accepted and j.good and j.distance > gate and max(j.raw) <= _WRONG
    ]  # fmt: skip
    let_in = np.sum([c.let_in for c in counted], axis=0)
    return [
        name,
        str(len(judged)),
        str(len(alone)),
        str(sum(j.of_truth > gate for j in alone)),
        f"{np.median([j.error[0] for j in judged if j.accepted]):.3f}",
        f"{100 * len(right) / len(judged):.1f}",
        str(sum(j.accepted for j in judged) - len(right)),
        *(f"{m:.1f}" for m in np.median([j.reach for j in judged], axis=0)),
        *(f"{inside} of {count}" for inside, count in let_in),
    ]


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("folder", type=Path, help="of worlds and sequences")
    parser.add_argument("--frames", type=whole(20, FULL), default=150, help="of each sequence")
    parser.add_argument("--processes", type=whole(1, 256), default=2, help="one core each")
    parser.add_argument("--json", type=output, help="the table's figures")
    args = parser.parse_args()
    cells = [Cell(place, "day", height) for place in PLACES for height in ("low", "high")]
    for cell in cells:  # before the processes, which share them
        sequence_of(cell, open_place(cell.place, args.folder, cell.seen), args.folder, args.frames)
    with ProcessPoolExecutor(args.processes) as pool:
        futures = [pool.submit(measured, c, cells, args.folder, args.frames) for c in cells]
        done = [future.result() for future in futures]
    gate = LocalizerConfig().integrity.chi2_threshold
    lines = [line(name, [rows[name] for rows in done], gate) for name in done[0]]
    print(f"| {' | '.join(COLUMNS)} |")
    print("|---" * len(COLUMNS) + "|")
    for cells_of in lines:
        print(f"| {' | '.join(cells_of)} |")
    if args.json:
        write_figures(args.json, COLUMNS, lines)


if __name__ == "__main__":
    with named_errors():
        main()
