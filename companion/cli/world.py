"""``companion world build``: generated worlds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console

from companion.terminal.steps import show_work
from companion.writing import writing

app = typer.Typer(no_args_is_help=True, help="Generated worlds for tests and demos.")


@app.callback()
def _group() -> None:
    """Keep ``build`` a subcommand although it is the only one."""


@app.command("build")
def build(
    out: Annotated[Path, typer.Option(help="folder of the tileset")],
    seed: Annotated[int, typer.Option(min=0, help="seed of the world")] = 0,
    variant: Annotated[
        Literal["survey", "live"],
        typer.Option(help="survey: as a map shows it; live: another day and season"),
    ] = "survey",
    size: Annotated[
        float, typer.Option(min=400, max=4000, help="side length, a multiple of 400 m")
    ] = 1600.0,
) -> None:
    """Generate a world and write it as a 3D Tiles 1.1 tileset."""
    from localizer.synth.world import build_world

    work = show_work(Console(stderr=True), f"building world {seed} ({variant})")
    with writing(out, "--out"), work:
        info = build_world(seed, out, variant=variant, size_m=size)
    Console().print(f"[green]{out}/tileset.json[/]: world {seed}, {info.size_m:.0f} m a side")
