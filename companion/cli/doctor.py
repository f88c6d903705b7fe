"""``companion doctor``: the checks as a table, and the writing of parameters; ``self-test``:
whether the program computes correctly on this computer.
"""

from __future__ import annotations

import json
import platform
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from companion.cli.output import show_table, tell
from companion.config import load_config
from companion.terminal.steps import show_steps, show_work
from companion.versions import instructions, made_by, processor, versions
from companion.writing import refuse_input, result_file, write_result
from mavlink_bridge.preflight.doctor import Diagnosis
from mavlink_bridge.preflight.rules import DoctorFinding

if TYPE_CHECKING:
    from companion.preflight.self_test import SelfTestReport


def doctor_command(
    config: Annotated[Path, typer.Argument(help="deployment YAML")],
    fix: Annotated[bool, typer.Option(help="ask, then correct wrong parameters")] = False,
    yes: Annotated[bool, typer.Option(help="do not ask")] = False,
    vehicle: Annotated[bool, typer.Option(help="check the flight controller too")] = True,
    beside_flight: Annotated[
        bool,
        typer.Option("--beside-flight", help="skip vehicle and video, which a running flight uses"),
    ] = False,
    page: Annotated[
        Path | None, typer.Option(help="write one page to sign: .html, with .txt beside it")
    ] = None,
    plan: Annotated[
        Path | None,
        typer.Option(help="plan.json of `companion plan`: puts its forecast on the page"),
    ] = None,
) -> None:
    """Check a deployment; exit code 0 good, 1 advice, 2 not fit to fly."""
    settings = load_config(config)
    if page is not None:
        result_file(page, "--page", (".html",), config, plan)
        refuse_input(page.with_suffix(".txt"), "--page", config, plan)
    vehicle, feed = vehicle and not beside_flight, not beside_flight
    console = Console()
    with show_steps(Console(stderr=True)) as say:
        say(f"examining {config}")  # the imports take seconds, too
        from companion.preflight.doctor import examine_deployment
        from mavlink_bridge.preflight.doctor import repair

        diagnosis = examine_deployment(settings, vehicle=vehicle, feed=feed, say=say)
    left_out = [] if vehicle else ["vehicle"]
    left_out += [] if feed else ["camera"]
    print_diagnosis(console, diagnosis, left_out)
    if fix and diagnosis.fixable:
        names = ", ".join(f"{f.name} = {f.fix:.7g}" for f in diagnosis.fixable if f.fix is not None)
        if yes or typer.confirm(f"Write {names}?"):
            with show_work(Console(stderr=True), "writing parameters"):
                reboot = repair(settings.bridge, diagnosis.fixable)
            console.print("written" + ("; reboot the flight controller" if reboot else ""))
            with show_steps(Console(stderr=True)) as say:
                diagnosis = examine_deployment(settings, vehicle=vehicle, feed=feed, say=say)
            print_diagnosis(console, diagnosis, left_out)
    if page is not None:
        from companion.preflight.sheet import make_sheet, write_sheet

        made = make_sheet(config, settings, diagnosis, plan, datetime.now(timezone.utc))
        html, text = write_sheet(made, page)
        tell(f"to sign: {html}, {text}")
    raise typer.Exit(diagnosis.exit_code)


def print_diagnosis(console: Console, diagnosis: Diagnosis, left_out: Sequence[str] = ()) -> None:
    """Print a table of 80 columns, then one or two lines for each failed check.

    left_out: checks that were not made; the title names them, so that "fit" is not misunderstood.
    """
    title = "fit to fly" if diagnosis.ok else "NOT fit to fly"
    if left_out:
        title += " as far as examined"
    table = Table(title=title, box=SIMPLE_HEAD)
    for column in ("", "what", "found", "needed"):
        table.add_column(column, overflow="fold")  # never hide the end of a name
    for f in diagnosis.findings:
        table.add_row(_mark(f), *(escape(text) for text in (f.name, f.found, f.needed)))
    console.print(table)
    for f in diagnosis.findings:
        if not f.ok:
            line = Text.from_markup(f"{_mark(f)} {escape(f.name)}: {escape(f.why)}")
            console.print(line, highlight=False)
    for name in left_out:
        console.print(f"{name}: not examined", style="yellow", highlight=False)


def _mark(finding: DoctorFinding) -> str:
    if finding.ok:
        return "[green]ok[/]"
    return "[red]wrong[/]" if finding.required else "[yellow]advice[/]"


def self_test_command(
    out: Annotated[Path | None, typer.Option(help="figures and versions, JSON")] = None,
    bench: Annotated[
        bool, typer.Option("--bench", help="measure speed, memory and each stage")
    ] = False,
) -> None:
    """Localize over a generated map: compiles the kernels and checks this computer."""
    if out is not None:
        result_file(out, "--out", (".json",))
    from companion.preflight.self_test import self_test

    with tempfile.TemporaryDirectory(prefix="companion-self-test-") as folder:
        report = self_test(Path(folder), lambda line: tell(f"{line} ...", err=True), timed=bench)
    tell(
        f"[green]self-test passed[/]: tracked to {report.error_m:.4f} m, found to "
        f"{report.found_error_m:.4f} m, {report.frame_ms:.0f} ms of processor a frame, the first "
        f"after {report.compiled_s:.0f} s"
    )
    if bench:
        _show_speed(report)
    if out is not None:
        data = asdict(report) | {"versions": made_by()}
        write_result(out, json.dumps(data, indent=1) + "\n", "--out")


def _show_speed(report: SelfTestReport) -> None:
    names = ("offered, Hz", "answered, Hz", "latency p50 / p95, ms", "processor, ms a frame",
             "cores", "peak memory, MiB")  # fmt: skip
    cells = [
        (str(row.offered_hz), f"{row.answered_hz:.1f}", f"{row.p50_ms:.0f} / {row.p95_ms:.0f}",
         f"{row.cpu_ms:.1f}", f"{row.cores:.2f}", f"{row.peak_mib:.0f}")
        for row in report.bench
    ]  # fmt: skip
    show_table(names, cells, f"{processor()}; {report.features}", names)
    widths = sorted({row.width for row in report.stages})
    by_stage: dict[str, list[str]] = {}
    for row in report.stages:
        by_stage.setdefault(row.stage, []).append(f"{row.cpu_ms:.1f} / {row.wall_ms:.1f}")
    heads = ("processor / time on one thread, ms", *(f"width {width}" for width in widths))
    found = [f"{k} {v}" for k, v in versions().items() if k in ("onnxruntime", "openvino", "numba")]
    title = f"{platform.machine()}: {instructions()}; {', '.join(found)}"
    show_table(heads, [(stage, *times) for stage, times in by_stage.items()], title, heads[1:])
