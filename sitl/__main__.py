"""``python -m sitl``: the GNSS-denied demo flight, sequences, and the scenario suite."""

from __future__ import annotations

import json
import logging
import shlex
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from companion.errors import CompanionError, ReportError
from companion.reporting.report import write_page
from companion.terminal.steps import file_link, show_steps
from companion.writing import result_file, write_result
from localizer.errors import LocalizerError
from sitl.demo.assets import FlightAssets, prepare
from sitl.demo.companion_process import THIS_PROGRAM, free_console_port
from sitl.demo.flight import DemoRecord, FlightObservers, fly
from sitl.demo.kinematic import record_scenario
from sitl.demo.report import make_report, print_report
from sitl.demo.scenario import (
    Condition,
    Injection,
    Scenario,
    ScenarioError,
    VehicleChoice,
    check_inside,
    named_scenario,
    scenario_names,
)
from sitl.errors import FlightError, SimulationError
from sitl.geodesy import Location
from sitl.operator.follow_run import fly_follows
from sitl.rehearsal.rehearse import rehearse
from sitl.suite.case import SCENARIOS, load_cases
from sitl.suite.loop.case import LOOP_SCENARIOS, load_loop_cases
from sitl.suite.loop.evaluation import as_data, markdown, print_loop_row, read_rows
from sitl.suite.loop.runner import RunOptions, fly_loop, parse_seeds
from sitl.suite.runner import markdown as suite_table
from sitl.suite.runner import print_row, run_suite, write_report
from sitl.vehicles.launch import open_vehicle
from sitl.vehicles.process import VehicleKind

LINE_EVERY_S = 10.0


class LogProgress:
    """Prints a line when the phase changes, and every ten seconds."""

    def __init__(self, console: Console) -> None:
        self._console, self._begun = console, time.monotonic()
        self._printed_s = 0.0
        self._phase: str | None = None

    def __call__(self, phase: str, share: float) -> None:
        """Report a phase; share: how much of the whole work is done, 0 to 1."""
        now_s = time.monotonic() - self._begun
        if phase == self._phase and now_s - self._printed_s < LINE_EVERY_S:
            return
        self._phase, self._printed_s = phase, now_s
        self._console.print(f"{now_s:4.0f} s {100 * share:3.0f} % {phase}", highlight=False)


@contextmanager
def shown_progress(console: Console) -> Iterator[Callable[[str, float], None]]:
    """Context manager: yields a callback (phase, share done from 0 to 1) that shows progress on
    `console`: a bar in a terminal, otherwise lines.
    """
    if not console.is_terminal:
        yield LogProgress(console)
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("", total=1.0, visible=False)  # until there is something to tell

        def show(phase: str, share: float) -> None:
            bar.update(task, description=phase, completed=share, visible=True)

        yield show


# What a flight and its report leave in their folder.
_REPORT_FILES = (
    "companion", "companion.log", "companion.yaml", "flight.tlog", "frames.csv",
    "frames_report.csv", "latest", "report.html", "report.json", "truth.tum", "vehicle.csv",
    "vehicle.log",
)  # fmt: skip

_IDEAL = "a map that shares geometry and texture with the world, a perfect camera, no errors drawn"
_LOG_WIDTH = 200
Vehicles = Annotated[
    Literal["embedded", "ardupilot", "both"], typer.Option("--fc", help="simulated vehicle")
]

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False)


@app.callback()
def _group() -> None:
    """Simulated flights."""


@app.command()
def demo(
    seed: Annotated[int, typer.Option(min=0, help="world, traffic, light and noise")] = 0,
    fc: Annotated[VehicleChoice, typer.Option(help="simulated vehicle")] = "auto",
    scenario: Annotated[
        str | None, typer.Option(help="scenario YAML, or one of " + ", ".join(scenario_names()))
    ] = None,
    injection: Annotated[
        Injection | None, typer.Option(help="MAVLink message instead of the scenario's")
    ] = None,
    out: Annotated[Path, typer.Option(help="folder of the report")] = Path("report"),
    worlds: Annotated[Path | None, typer.Option(help="folder of generated worlds")] = None,
    ideal: Annotated[bool, typer.Option("--ideal", help=_IDEAL)] = False,
    map_: Annotated[
        Path | None, typer.Option("--map", help="your own tile cache, instead of a generated world")
    ] = None,
    live: Annotated[
        Path | None, typer.Option(help="tile cache that the camera sees; none: the map's own")
    ] = None,
    mission: Annotated[
        Path | None, typer.Option(help=".plan or .waypoints over --map; none: a triangle")
    ] = None,
    companion: Annotated[
        str | None, typer.Option(help="command of an installed companion that flies instead")
    ] = None,
) -> None:
    """Fly a GNSS-denied mission on vision alone and report its accuracy."""
    script = _script(scenario, ideal, injection=injection)
    open_vehicle(fc, Location(0.0, 0.0, 0.0))  # its errors come before minutes of generating
    console = Console()
    if map_ is not None:
        rehearsal = rehearse(map_, live, mission, script)
        assets, script = rehearsal.assets, rehearsal.scenario
        for note in rehearsal.notes:
            console.print(f"[yellow]{escape(note)}", highlight=False)
    elif live is not None or mission is not None:
        raise ScenarioError("--live and --mission belong to a --map")
    else:
        assets = _world_of(script, seed, worlds, ideal, console)
        check_inside(script, assets.world.size_m)
    _clear(out)
    port = free_console_port()
    with shown_progress(console) as progress:
        observers = FlightObservers(
            progress, partial(_tell_endpoint, console), port, partial(_tell_page, console)
        )
        program = shlex.split(companion) if companion else THIS_PROGRAM
        record = fly(assets, script, fc, seed, out, observers, program)
    _report(console, record, script, seed)


@app.command()
def sequence(
    out: Annotated[Path, typer.Argument(help="folder of the sequence")],
    seed: Annotated[int, typer.Option(min=0, help="world, traffic, light and noise")] = 0,
    scenario: Annotated[
        str | None, typer.Option(help="scenario YAML, or one of " + ", ".join(scenario_names()))
    ] = None,
    condition: Annotated[
        Condition | None, typer.Option(help="light and weather instead of the scenario's")
    ] = None,
    worlds: Annotated[Path | None, typer.Option(help="folder of generated worlds")] = None,
    ideal: Annotated[bool, typer.Option("--ideal", help=_IDEAL)] = False,
) -> None:
    """Record the scenario's path, flown without dynamics, as a sequence for `companion eval`."""
    script = _script(scenario, ideal, condition=condition)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ScenarioError(f"{out}: exists already and is not empty; give another folder")
    console = Console()
    assets = _world_of(script, seed, worlds, ideal, console)
    check_inside(script, assets.world.size_m)
    with show_steps(console) as say:
        say("rendering the path; a minute or more")
        count = record_scenario(assets, script, seed, out)
    console.print(f"[green]{out}[/]: {count} frames; its map is {assets.map_cache}")


@app.command()
def suite(
    fc: Vehicles = "embedded",
    only: Annotated[list[str] | None, typer.Option(help="scenario name; may be repeated")] = None,
    out: Annotated[Path, typer.Option(help="folder of the report")] = Path("report-suite"),
    jobs: Annotated[int | None, typer.Option(min=1, help="flights side by side")] = None,
    seed: Annotated[int, typer.Option(min=0, help="noise of fixes and embedded sensors")] = 1,
    scenarios: Annotated[Path, typer.Option(help="folder of scenario files")] = SCENARIOS,
) -> None:
    """Fly scenarios with simulated fixes; compare with measured ArduPilot. Exit 1: one fails."""
    cases, (console, options) = load_cases(only or (), scenarios), _runner(fc, out)
    rows = run_suite(cases, options.vehicles, jobs, seed, lambda row: print_row(console, row))
    console.print(escape(suite_table(rows)))
    write_report(rows, out)
    raise typer.Exit(0 if all(row.ok for row in rows) else 1)


@app.command()
def loop(
    fc: Vehicles = "embedded",
    only: Annotated[
        list[str] | None,
        typer.Option(help="flight, or `normal` for all without a fault; may be repeated"),
    ] = None,
    out: Annotated[Path, typer.Option(help="folder of the records")] = Path("report-loop"),
    seeds: Annotated[str, typer.Option(help="world, light and noise: 5, or 1..10")] = "5",
    worlds: Annotated[Path | None, typer.Option(help="folder of generated worlds")] = None,
    scenarios: Annotated[Path, typer.Option(help="folder of flights")] = LOOP_SCENARIOS,
    resume: Annotated[bool, typer.Option("--resume", help="skip flights that --out holds")] = False,
) -> None:
    """Fly the whole companion with injected faults, one flight a time; exit 1: one fails."""
    cases, (console, options) = (
        load_loop_cases(only or (), scenarios),
        _runner(fc, out, seeds, worlds),
    )
    options = replace(options, resume=resume)
    rows = fly_loop(cases, options, lambda row: print_loop_row(console, row))
    console.print(escape(markdown(rows)))
    names = {case.name for case in cases}
    asked = [row for row in rows if row.name in names and row.seed in options.seeds]
    raise typer.Exit(0 if all(row.ok for row in asked if row.vehicle in options.vehicles) else 1)


@app.command()
def follow(
    fc: Vehicles = "embedded",
    out: Annotated[Path, typer.Option(help="folder of the records")] = Path("report-follow"),
    seed: Annotated[int, typer.Option(min=0, max=10**6, help="of the world")] = 0,
    draws: Annotated[str, typer.Option(help="of car and errors: 5, or 5..7")] = "5..7",
    worlds: Annotated[Path | None, typer.Option(help="folder of generated worlds")] = None,
) -> None:
    """Follow a car that an operator clicks; roofs hide it twice for two seconds."""
    _, options = _runner(fc, out, draws, worlds)
    rows = fly_follows(options, seed)
    raise typer.Exit(0 if all(row.ok for row in rows) else 1)


@app.command()
def loop_table(
    folders: Annotated[list[Path], typer.Argument(help="--out folders of `loop`")],
    out: Annotated[Path | None, typer.Option(help="file for all flights as one JSON")] = None,
) -> None:
    """Print one table of the flights of several runs of `loop`."""
    files = [folder / "loop.json" for folder in folders]
    if out is not None:
        result_file(out, "--out", (".json",), *files)
    rows = [row for file in files for row in read_rows(file)]
    if out is not None:
        write_result(out, json.dumps(as_data(rows), indent=1, allow_nan=False), "--out")
    print(markdown(rows))


def _runner(
    fc: Literal["embedded", "ardupilot", "both"], out: Path, seeds: str = "1",
    worlds: Path | None = None,
) -> tuple[Console, RunOptions]:  # fmt: skip
    """Console and checked options for a command that flies several flights."""
    if out.exists() and not out.is_dir():
        raise ScenarioError(f"{out}: is a file; give a folder as --out")
    console = Console()
    if not console.is_terminal:
        console = Console(width=_LOG_WIDTH)  # a log has no width of its own

    def say(line: str) -> None:
        console.print(f"[dim]{escape(line)}[/]", highlight=False)

    vehicles: tuple[VehicleKind, ...] = ("ardupilot", "embedded") if fc == "both" else (fc,)
    return console, RunOptions(vehicles, out, parse_seeds(seeds), worlds, say, LogProgress(console))


def _tell_page(console: Console, address: str) -> None:
    console.print(f"watch it: [green]{address}[/]", highlight=False)


def _tell_endpoint(console: Console, endpoint: str) -> None:
    """An own line, which stays above the bar."""
    _, host, port = endpoint.split(":")
    console.print(f"ground station: [green]TCP {host} port {port}[/] (QGroundControl: Comm Links)")


def _script(name: str | None, ideal: bool, **options: str | None) -> Scenario:
    """The scenario of a command with the options that were given."""
    script = named_scenario(name) if name else Scenario()
    script = script.ideal() if ideal else script
    given = {key: value for key, value in options.items() if value is not None}
    return Scenario.model_validate(script.model_dump() | given) if given else script


def _world_of(
    script: Scenario, seed: int, worlds: Path | None, ideal: bool, console: Console
) -> FlightAssets:
    with shown_progress(console) as progress:
        return prepare(
            seed, worlds, progress, script.world_m, ideal, script.world, script.satellite
        )


def _report(console: Console, record: DemoRecord, script: Scenario, seed: int) -> None:
    """Of a flight that broke off, too: FlightError then says why, after its report."""
    try:
        report = make_report(record, script, seed)
    except ReportError as error:
        if record.broken is None:
            raise
        raise FlightError(f"{record.broken}; {error}") from error
    print_report(report, record.folder)
    console.print("open:", file_link(write_page(record.folder).resolve()), soft_wrap=True)
    if report.broken is not None:
        cause = "" if report.slow is None else f"; likely because {report.slow}"
        raise FlightError(f"{report.broken}{cause}")


def _clear(out: Path) -> None:
    """Remove an earlier report; anything else in the way is the user's."""
    if not out.exists():
        return
    if not out.is_dir():
        raise ScenarioError(f"{out}: is a file; give a folder as --out")
    foreign = [p.name for p in out.iterdir() if not any(p.match(x) for x in _REPORT_FILES)]
    if foreign:
        raise ScenarioError(
            f"{out}: holds other files than a flight's report, such as {min(foreign)}; "
            "give another --out"
        )
    shutil.rmtree(out)


def main() -> None:
    """Entry point: named errors become one clear line and exit code 2."""
    logging.basicConfig(level=logging.WARNING)
    # As an exception, so that a flight that is ended takes its processes with it.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        app()
    # OSError: of a disk or a folder, which the program cannot help and which names its path.
    except (SimulationError, CompanionError, LocalizerError, OSError) as error:
        # Escaped: a path or a value in the text may look like the console's markup.
        name, text = type(error).__name__, escape(str(error))
        Console(stderr=True).print(f"[bold red]{name}[/]: {text}", soft_wrap=True, highlight=False)
        sys.exit(2)


if __name__ == "__main__":
    main()
