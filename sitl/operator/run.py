"""Flights with an operator aboard, one after the other: flown, judged, kept as JSON."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any

import numpy as np

from sitl.demo.budget import draw_errors
from sitl.errors import SimulationError
from sitl.operator.judge import ClickVerdict, TargetLine, judge
from sitl.operator.operator import LATE_S, LATE_SIGMA_S, Operator
from sitl.operator.truth import GroundTruth
from sitl.operator.wishes import draw_wishes
from sitl.suite.loop.case import LoopCase
from sitl.suite.loop.flight import fly
from sitl.suite.loop.runner import RunOptions, loop_assets
from sitl.vehicles.process import VehicleKind

# Honest: another visit's world, the demo's camera, errors drawn; about 140 m of ground in view.
FLIGHT = LoopCase(
    name="clicks",
    title="an operator clicks, drags and stops",
    height_m=110.0,
    honest=True,
    deployment={
        "targets": {
            "operator_delay_ms": 1e3 * LATE_S,
            "operator_delay_sigma_ms": 1e3 * LATE_SIGMA_S,
        }
    },
)


@dataclass(frozen=True)
class ClickRow:
    """One flight's outcome; error says why it could not be flown."""

    vehicle: VehicleKind
    seed: int
    verdict: ClickVerdict | None = None
    error: str = ""
    pace: float = 1.0
    stall_s: float = 0.0

    @property
    def ok(self) -> bool:
        """Whether it was flown and everything holds."""
        return self.verdict is not None and not self.verdict.problems


def fly_clicks(options: RunOptions, clicks: int) -> tuple[ClickRow, ...]:
    """Fly them all, so many clicks in each; ``out/targets.json`` holds what was measured, from the
    first flight on.
    """
    options.out.mkdir(parents=True, exist_ok=True)
    rows: list[ClickRow] = []
    for kind, seed in product(options.vehicles, options.seeds):
        options.say(f"flying {clicks} clicks on {kind}, seed {seed}")
        rows.append(_flown(kind, seed, options, clicks))
        text = json.dumps(as_data(rows), indent=1, default=str)
        (options.out / "targets.json").write_text(text, encoding="utf-8")
        options.say(line_of(rows[-1]))
    return tuple(rows)


def _flown(kind: VehicleKind, seed: int, options: RunOptions, clicks: int) -> ClickRow:
    operator = Operator(draw_wishes(seed, clicks), seed)
    case = FLIGHT.model_copy(update={"seconds": operator.seconds})
    assets = loop_assets(case, seed, options.worlds, options.building)
    folder = options.out / f"{kind}-{seed}"
    shutil.rmtree(folder, ignore_errors=True)
    try:
        record = fly(case, assets, kind, seed, folder, operator)
        camera = draw_errors(case.scenario, seed).camera
        witness = GroundTruth(assets.world, camera, folder / "frames.csv")
        targets = folder / "companion" / "targets.csv"
        verdict = judge(witness, operator.asked, operator.heard, targets, operator.failure)
    except SimulationError as error:
        return ClickRow(kind, seed, error=f"{type(error).__name__}: {error}")
    left = {"asked": [asdict(a) for a in operator.asked], "heard": asdict(operator.heard)}
    (folder / "operator.json").write_text(json.dumps(left, indent=1), encoding="utf-8")
    return ClickRow(kind, seed, verdict, "", record.pace, record.stall_s)


def summary(rows: Sequence[ClickRow]) -> dict[str, Any]:
    """All flights of a vehicle, or of both, in numbers; the worst target decides."""
    verdicts = [row.verdict for row in rows if row.verdict is not None]
    lines = [line for v in verdicts for line in v.lines if not line.on_mover]
    errors = np.array([e for line in lines for e in line.errors_m])
    late = np.array([e for line in lines for e in line.late_errors_m])
    return {
        "flights": len(rows),
        "flown": len(verdicts),
        "clicks": sum(v.clicks for v in verdicts),
        "stops": sum(v.stops for v in verdicts),
        "unanswered": sum(v.unanswered for v in verdicts),
        "untold": sum(v.unreported for v in verdicts),
        "untold_without_a_word": sum(v.silent for v in verdicts),
        "targets": len(lines),
        "on_movers": sum(line.on_mover for v in verdicts for line in v.lines),
        "reports": len(errors),
        "link_reports": sum(v.link for v in verdicts),
        "link_foreign": sum(v.foreign for v in verdicts),
        "not_under_their_pixel": sum(line.not_own for line in lines),
        "at_anothers_place": sum(line.elsewhere for line in lines),
        "velocities_of_what_stands": sum(line.velocities for line in lines),
        "after_their_end": sum(line.after_end for line in lines),
        "all_m": _spread(errors),
        "after_5_s_m": _spread(late),
        "targets_looked_at_5_s": sum(bool(line.late) for line in lines),
        "of_them_beyond_1_m_p95": sum(bool(line.late) and line.late_p95_m > 1.0 for line in lines),
        "of_them_beyond_3_m": sum(bool(line.late) and line.late_max_m > 3.0 for line in lines),
        "worst": _worst(lines),
        "inside_95_percent": 100.0 * sum(line.insides for line in lines) / max(len(errors), 1),
    }


def _spread(errors: np.ndarray) -> dict[str, float] | None:
    if not len(errors):
        return None
    p50, p95 = np.quantile(errors, [0.5, 0.95])
    return {"p50": float(p50), "p95": float(p95), "max": float(errors.max())}


def _worst(lines: Sequence[TargetLine]) -> dict[str, float] | None:
    looked = [line for line in lines if line.late]
    if not looked:
        return None
    line = max(looked, key=lambda one: one.late_p95_m)
    return {"number": line.number, "p95": line.late_p95_m, "max": line.late_max_m}


def as_data(rows: Sequence[ClickRow]) -> dict[str, Any]:
    """Rows and their summaries as JSON."""
    kinds = dict.fromkeys(row.vehicle for row in rows)
    by_kind = {kind: summary([row for row in rows if row.vehicle == kind]) for kind in kinds}
    return {"summary": by_kind | {"all": summary(rows)}, "flights": [asdict(row) for row in rows]}


def line_of(row: ClickRow) -> str:
    """A flight in one line, what does not hold first."""
    head = f"{row.vehicle}, seed {row.seed}: "
    if row.verdict is None:
        return head + f"not flown: {row.error}"
    figures = summary([row])
    late = figures["after_5_s_m"]
    told = "; ".join(row.verdict.problems) or "all holds"
    said = f"{figures['clicks']} clicks, {figures['targets']} targets, {figures['reports']} reports"
    if late is not None:
        said += f", after 5 s p95 {late['p95']:.2f} m, at most {late['max']:.2f} m"
    return f"{head}{told} ({said}, {figures['inside_95_percent']:.0f} % inside their bound)"
