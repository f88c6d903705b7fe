"""``companion map check``: whether a map is suitable, in words and images."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from companion.cli.output import show_table, tell
from companion.terminal.steps import show_work
from companion.writing import make_folder, writing

_SPEED_M_S = 10.0
_COLOURS = {"good": "green", "advice": "yellow", "bad": "red"}


def check_command(
    cache: Annotated[Path, typer.Argument(help="folder of a tile cache")],
    out: Annotated[Path, typer.Option(help="folder of the images")] = Path("map-check"),
    height: Annotated[
        float, typer.Option(min=5, max=5000, help="mission height above the ground, m")
    ] = 120.0,
    config: Annotated[
        Path | None, typer.Option(help="deployment YAML: its camera and working width")
    ] = None,
    fov: Annotated[
        float,
        typer.Option(min=1, max=170, help="horizontal field of view without a deployment, degrees"),
    ] = 65.0,
    width: Annotated[
        int, typer.Option(min=64, max=2048, help="working width, without a deployment")
    ] = 320,
) -> None:
    """Check heights, coverage, holes, texels, detail, seams and shift. Exit code 1: one is bad."""
    from companion.config import load_config
    from localizer.map.cache.cache import TileCache
    from localizer.map.inspection.check import MapUse, check_map
    from localizer.pictures import write_rgb
    from localizer.tracking.pipeline import working_camera

    pixel_rad, half_view_deg = 2 * math.tan(math.radians(fov) / 2) / width, fov / 2
    if config is not None:
        deployment = load_config(config)
        camera = working_camera(deployment.camera.model.camera(), deployment.localizer.width)
        pixel_rad, half_view_deg = 1 / camera.fx, camera.horizontal_fov_deg / 2
    opened = TileCache.open(cache)
    make_folder(out, "--out")
    with show_work(Console(stderr=True), f"looking at {opened.manifest.tiles} tiles"):
        made = check_map(opened, MapUse(height, pixel_rad, half_view_deg))
    with writing(out, "--out"):
        for name, rgb in made.pictures.items():
            write_rgb(out / f"{name}.png", rgb)
    rows = [
        (f"[{_COLOURS[f.grade.value]}]{f.grade.value}[/]", f.name, escape(f.found), escape(f.words))
        for f in made.findings
    ]
    show_table(("", "what", "found", "meaning"), rows)
    bad = [f.name for f in made.findings if f.grade.value == "bad"]
    east_m, north_m = made.size_m
    area = f"{east_m:.0f} x {north_m:.0f} m, {max(made.size_m) / _SPEED_M_S:.0f} s of flight"
    verdict = (
        f"This map will not do: {', '.join(bad)}."
        if bad
        else f"This map will do where it is: {area} from end to end at {_SPEED_M_S:.0f} m/s."
    )
    tell(verdict)
    if made.usable is None:
        tell("No part of it is usable.")
    elif bad or not made.usable.is_whole:
        tell(f"Usable without a gap: {made.usable.line()}; keep what the camera sees inside it.")
    tell(f"Images: {escape(str(out))}")
    raise typer.Exit(0 if made.ok else 1)
