"""``companion try``: find out from footage whether vision works in an area."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.text import Text

from companion.cli.before.shared_options import FieldOfView, FootageCamera, MountPitch, WorkingWidth
from companion.cli.output import tell, tell_notes
from companion.terminal.steps import COMPILES, file_link, show_count, show_steps
from companion.writing import make_folder, refuse_input

if TYPE_CHECKING:
    from companion.recorded.flight import RecordedFlight


def try_command(
    footage: Annotated[Path, typer.Argument(help="a photo, a folder of photos, or a video")],
    map_cache: Annotated[
        Path | None, typer.Option("--map", help="tile cache made by `companion map build`")
    ] = None,
    report: Annotated[Path, typer.Option(help="folder of the report")] = Path("try-report"),
    places: Annotated[
        Path | None,
        typer.Option(help="CSV or text with the photos' positions; default: beside them"),
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(help="the flight's .bin, .tlog or .ulg; default: beside the footage"),
    ] = None,
    camera: FootageCamera = None,
    fov: FieldOfView = None,
    mount_pitch: MountPitch = -90.0,
    frames: Annotated[
        int, typer.Option(min=1, max=2000, help="largest number of frames that are used")
    ] = 100,
    searches: Annotated[
        int,
        typer.Option(min=0, max=2000, help="frames whose position is searched on the map"),
    ] = 20,
    width: WorkingWidth = 320,
) -> None:
    """Try recorded footage over a map: verdict, report and deployment file.

    Exit code 0: vision works there; 1: it does not, or there is no map.
    """
    from companion.recorded.footage import FootageOptions, read_footage
    from companion.trial.deployment import refuse_edited

    inputs = (footage, footage / "frames.csv", places, log, camera)
    for name in ("report.html", "trial.json", "frames.csv", "deployment.yaml"):
        refuse_input(report / name, "--report", *inputs)
    make_folder(report, "--report")
    refuse_edited(report / "deployment.yaml")
    console = Console(stderr=True)
    options = FootageOptions(report, frames, places, log, camera, fov, mount_pitch)
    with show_count(console, "reading footage") as count:
        flight = read_footage(footage, options, count)
    if map_cache is None:
        _print_map(flight)
        raise typer.Exit(1)
    _try(flight, map_cache, report, width, searches)


def _print_map(flight: RecordedFlight) -> None:
    from companion.trial.result import flat_map_advice, wanted_map

    tell_notes((f"camera by {flight.camera.source}", *flight.notes))
    wanted = wanted_map(flight)
    tell(
        f"{len(flight.frames)} frames, {flight.located_count} with a position; no map is given. "
        f"{wanted.sentence}."
    )
    for line in (f"Where open data exist: {wanted.command('area')}", flat_map_advice(flight)):
        if line:
            tell(line)


def _try(flight: RecordedFlight, map_cache: Path, report: Path, width: int, searches: int) -> None:
    from companion.trial.deployment import write_trial_deployment
    from companion.trial.page import write_trial
    from companion.trial.result import trial_verdict
    from companion.trial.run import run_trial
    from localizer.map.cache.cache import TileCache

    TileCache.open(map_cache)  # what is missing is said before anything is computed
    console = Console(stderr=True)

    def stage(what: str) -> AbstractContextManager[Callable[..., None]]:
        return show_count(console, what, begins=COMPILES if what == "localizing" else "begun")

    trial = run_trial(flight, map_cache, width, searches, stage)
    judgement = trial_verdict(trial)
    tell_notes((f"camera by {flight.camera.source}", *trial.notes))
    with show_steps(console) as say:
        page = write_trial(report, trial, judgement, map_cache, say)
    deployment = write_trial_deployment(report / "deployment.yaml", trial, map_cache)
    tell(judgement.sentence, "bold")
    tell(f"deployment file: {escape(str(deployment))}")
    tell(Text.assemble("report: ", file_link(page)))
    raise typer.Exit(judgement.exit_code)
