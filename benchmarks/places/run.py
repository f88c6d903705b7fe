"""Runs cells of the table: one JSON for each sequence and method, so that a killed run goes on."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import cv2

from benchmarks.places.flights import Cell, sequence_of, true_path
from benchmarks.places.rivals import PASSES, RIVALS, Setting
from benchmarks.places.turns import ToldTurns
from benchmarks.places.worlds import open_place
from localizer.config import LocalizerConfig
from localizer.evaluation.sequences import Perturbation
from localizer.evaluation.sequences import Sequence as Recorded
from localizer.tracking.motion import AuxiliarySensors
from localizer.tracking.opening import MapStack

PRIOR = Perturbation(10.0, 10.0)  # of the first frame, in metres and degrees, as the paper's


@dataclass(frozen=True)
class PlacesPlan:
    """What is run. folder: of worlds, sequences and results; frames: of each sequence."""

    folder: Path
    frames: int
    width: int
    methods: tuple[str, ...]
    cells: tuple[Cell, ...]

    def result(self, cell: Cell, method: str) -> Path:
        """The file of one method on one sequence."""
        return self.folder / "results" / f"{cell.name}-{method}-{self.frames}-{self.width}.json"

    def has_any(self, method: str) -> bool:
        """Whether a method has run on any sequence."""
        return any(self.result(cell, method).exists() for cell in self.cells)

    def missing(self, cell: Cell) -> tuple[str, ...]:
        """The methods that have not run on a sequence."""
        return tuple(m for m in self.methods if not self.result(cell, m).exists())


def run(plan: PlacesPlan, processes: int, minutes: float) -> Iterator[str]:
    """Runs what is missing, a sequence with all its methods at a time; yields what was done.

    minutes: after which no new sequence is begun.
    """
    until_s = time.time() + 60 * minutes
    waiting = [c for c in plan.cells if plan.missing(c)]
    if processes == 1:
        for cell in waiting:
            if _in_time(plan, cell, until_s):
                yield cell.name
        return
    with ProcessPoolExecutor(processes) as pool:
        futures = {pool.submit(_in_time, plan, cell, until_s): cell for cell in waiting}
        for future in as_completed(futures):
            if future.result():
                yield futures[future].name


def _in_time(plan: PlacesPlan, cell: Cell, until_s: float) -> bool:
    if time.time() > until_s:
        return False
    run_cell(plan, cell)
    return True


def run_cell(plan: PlacesPlan, cell: Cell) -> None:
    """Every method that is missing on one sequence, all on the same pictures."""
    cv2.setNumThreads(1)
    home = open_place(cell.place, plan.folder, cell.seen)
    sequence = sequence_of(cell, home, plan.folder, plan.frames)
    sensors = AuxiliarySensors(ToldTurns(true_path(cell, home), cell.seed).rotation)
    for method in plan.missing(cell):
        config = LocalizerConfig(width=plan.width, threads=1, renderer="numba", device="cpu")
        document = {
            "place": cell.place.name, "condition": cell.condition, "height": cell.height,
            "weather": cell.weather, "method": method, "width": plan.width, "seed": cell.seed,
            **localized(method, home.map_cache, sequence, config, cell.seed, sensors),
        }  # fmt: skip
        path = plan.result(cell, method)
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(f".{os.getpid()}.partial")
        partial.write_text(json.dumps(document) + "\n")
        os.replace(partial, path)


def localized(
    method: str, map_cache: Path, sequence: Recorded, config: LocalizerConfig, seed: int,
    sensors: AuxiliarySensors,
) -> dict[str, object]:  # fmt: skip
    """One method over one sequence: errors per frame (None: no answer) and processor time."""
    stack = MapStack(map_cache, config)
    metres: list[float | None] = []
    degrees: list[float | None] = []
    cpu_ms: list[float] = []
    try:
        tracking = RIVALS[method].open(stack, Setting(sequence.camera, config, sensors))
        for index in range(len(sequence.images)):
            frame = sequence.frame(index)
            truth = sequence.truth[index]
            if index == 0:
                drawn = Perturbation(PRIOR.translation_m, PRIOR.rotation_deg, seed)
                tracking.begin(drawn.prior(truth, index, frame.exposure_time_ns))
            began = time.process_time()
            pose = tracking.track(frame, PASSES if index == 0 else 1)
            cpu_ms.append(round(1e3 * (time.process_time() - began), 2))
            found = (None, None) if pose is None else truth.distance_to(pose)
            metres.append(found[0])
            degrees.append(found[1])
    finally:
        stack.close()
    return {"metres": metres, "degrees": degrees, "cpu_ms": cpu_ms}
