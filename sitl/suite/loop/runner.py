"""Flies scenarios one after the other, judges each at its end, keeps the results as JSON."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path

from companion.writing import write_result
from sitl.demo.assets import prepare
from sitl.demo.scenario import ScenarioError
from sitl.errors import SimulationError
from sitl.suite.loop.case import LoopCase
from sitl.suite.loop.evaluation import (
    LoopRow,
    as_data,
    evaluate,
    false_alarms,
    figures,
    markdown,
    read_rows,
)
from sitl.suite.loop.flight import LoopAssets, fly
from sitl.suite.loop.inner_map import inner_map
from sitl.vehicles.process import VehicleKind

_MOST_SEEDS = 1000
_DIGITS = 9
_OTHER_SEED = 100  # of the place whose map is wrong here, beyond the flown world's seed


@dataclass(frozen=True)
class RunOptions:
    """Vehicles, seeds (of world, light, errors), and folders of records and worlds. worlds: None:
    the default folder. say: receives progress lines; building: receives the progress of world
    generation (step, share done). resume: skip flights that ``out`` already holds with a valid
    result.
    """

    vehicles: tuple[VehicleKind, ...]
    out: Path
    seeds: tuple[int, ...] = (5,)
    worlds: Path | None = None
    say: Callable[[str], None] = lambda _: None
    building: Callable[[str, float], None] = lambda _phase, _share: None
    resume: bool = False


def fly_loop(
    cases: Sequence[LoopCase], options: RunOptions, landed: Callable[[LoopRow], None]
) -> tuple[LoopRow, ...]:
    """Fly all scenarios with every seed. Each flight is kept in ``out/VEHICLE-NAME-SEED``, the
    table in ``out/loop.json`` and ``out/loop.md``. landed: called with each result. Returned:
    all rows of the table.
    """
    options.out.mkdir(parents=True, exist_ok=True)
    kept = options.out / "loop.json"
    rows = list(read_rows(kept)) if options.resume and kept.exists() else []
    for kind, seed, case in product(options.vehicles, options.seeds, cases):
        flown = [
            row for row in rows if (row.name, row.vehicle, row.seed) == (case.name, kind, seed)
        ]
        if any(row.valid for row in flown):
            continue
        rows = [row for row in rows if row not in flown]
        options.say(f"flying {case.name} on {kind}, seed {seed}: {case.title}")
        row = _flown(case, kind, seed, options)
        rows.append(row)
        landed(row)
        report = json.dumps(as_data(rows), indent=1, allow_nan=False)
        write_result(kept, report)
        write_result(options.out / "loop.md", markdown(rows))
    return tuple(rows)


def loop_assets(
    case: LoopCase, seed: int, worlds: Path | None, progress: Callable[[str, float], None]
) -> LoopAssets:
    """The world of a loop case and a seed, and the companion's map of the world; generated if
    missing. worlds: folder of generated worlds; None: the default. progress: called with a stage
    and its share that is done.
    """
    world = prepare(seed, worlds, progress, case.size_m, ideal=not case.honest)
    if case.wrong.other_map:
        other = prepare(seed + _OTHER_SEED, worlds, progress, case.size_m, ideal=True)
        return LoopAssets(world, other.map_cache)
    if case.wrong.map_reach_m is not None:
        return LoopAssets(world, inner_map(world.map_cache, case.wrong.map_reach_m))
    return LoopAssets(world)


def parse_seeds(text: str) -> tuple[int, ...]:
    """Seeds from ``5`` or ``1..10`` (inclusive). `ScenarioError` for other texts."""
    first, dots, last = text.partition("..")
    if not (first.isdecimal() and (last.isdecimal() or not dots)):
        raise ScenarioError(f"--seeds is a number or FIRST..LAST, not {text[:40]!r}")
    if max(len(first), len(last)) > _DIGITS:
        raise ScenarioError(f"--seeds: a seed has at most {_DIGITS} digits")
    seeds = range(int(first), int(last or first) + 1)
    if int(last or first) - int(first) >= _MOST_SEEDS:
        raise ScenarioError(f"--seeds {text}: at most {_MOST_SEEDS} at a time")
    if not seeds:
        raise ScenarioError(f"--seeds {text}: the last seed is before the first")
    return tuple(seeds)


def _flown(case: LoopCase, kind: VehicleKind, seed: int, options: RunOptions) -> LoopRow:
    assets = loop_assets(case, seed, options.worlds, options.building)
    folder = options.out / f"{kind}-{case.name}-{seed}"
    shutil.rmtree(folder, ignore_errors=True)
    try:
        record = fly(case, assets, kind, seed, folder)
    except SimulationError as error:
        why = f"{type(error).__name__}: {error}"
        return LoopRow(case.name, kind, seed, (), error=why)
    text = json.dumps(asdict(record), indent=1, default=str)
    write_result(folder / "flight.json", text)
    return LoopRow(
        case.name,
        kind,
        seed,
        evaluate(record, case.expect, denied=case.deny),
        figures(record, case.expect.beyond_m),
        false_alarms(record, denied=case.deny) if case.is_normal else None,
        record.pace,
        record.stall_s,
    )
