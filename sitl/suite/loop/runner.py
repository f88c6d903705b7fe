"""Flights of the loop one after the other, each judged as it lands, its record kept as JSON."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from sitl.demo.assets import prepare
from sitl.errors import SimulationError
from sitl.suite.loop.case import LoopCase
from sitl.suite.loop.flight import LoopAssets, fly
from sitl.suite.loop.judge import Held, judge
from sitl.vehicles.process import VehicleKind

_OTHER_SEED = 100  # of the place whose map is wrong here, beyond the flown world's seed


@dataclass(frozen=True)
class LoopRow:
    """One flight's outcome; error says why it could not be flown."""

    name: str
    vehicle: VehicleKind
    held: tuple[Held, ...]
    error: str = ""

    @property
    def ok(self) -> bool:
        """Whether it was flown and everything holds."""
        return not self.error and all(held.ok for held in self.held)


def fly_loop(
    cases: Sequence[LoopCase],
    kind: VehicleKind,
    seed: int,
    size_m: float,
    out: Path,
    worlds: Path | None,
    console: Console,
) -> tuple[LoopRow, ...]:
    """Fly all cases over one world; ``out/NAME`` holds each flight, ``out/loop.json`` the table."""
    world = prepare(seed, worlds, console.print, size_m)
    other = None
    if any(case.wrong.other_map for case in cases):
        other = prepare(seed + _OTHER_SEED, worlds, console.print, size_m)
    rows: list[LoopRow] = []
    for case in cases:
        folder = out / case.name
        shutil.rmtree(folder, ignore_errors=True)
        console.print(f"[dim]flying {case.name}: {escape(case.title)}[/]")
        rows.append(_flown(case, LoopAssets(world, other), kind, seed, folder))
        _show(console, rows[-1])
        report = [asdict(row) | {"ok": row.ok} for row in rows]
        (out / "loop.json").write_text(json.dumps(report, indent=1), encoding="utf-8")
    return tuple(rows)


def _flown(
    case: LoopCase, assets: LoopAssets, kind: VehicleKind, seed: int, folder: Path
) -> LoopRow:
    try:
        record = fly(case, assets, kind, seed, folder)
    except SimulationError as error:
        return LoopRow(case.name, kind, (), f"{type(error).__name__}: {error}")
    text = json.dumps(asdict(record), indent=1, default=str)
    (folder / "flight.json").write_text(text, encoding="utf-8")
    return LoopRow(case.name, kind, judge(record, case.expect))


def _show(console: Console, row: LoopRow) -> None:
    if row.error:
        console.print(f"[red]ERROR[/] {row.name}: {escape(row.error)}")
    for held in row.held:
        mark = "[green]ok[/]" if held.ok else "[red]MISSED[/]"
        console.print(f"  {mark} {escape(held.what)}: {escape(held.seen)}")
