"""``companion map``: build and inspect tile caches."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

app = typer.Typer(no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Tile caches."""


@app.command("build")
def build(
    source: Annotated[Path, typer.Argument(help="tileset.json")],
    out: Annotated[Path, typer.Option(help="folder of the cache")],
    geoid_separation: Annotated[float | None, typer.Option(help="metres")] = None,
) -> None:
    """Import a source into a tile cache."""
    from localizer.map.build import build_cache

    manifest = build_cache(source, out, geoid_separation_m=geoid_separation)
    Console().print(f"[green]{out}[/]: {manifest.tiles} tiles, {manifest.triangles} triangles")
