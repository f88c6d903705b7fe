"""``companion plan``: forecast where along a mission vision works."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from companion.cli.output import show_table, tell
from companion.config import load_config
from companion.terminal.steps import show_count, show_work
from companion.writing import make_folder, write_result, writing


def plan_command(
    mission: Annotated[
        Path, typer.Argument(help="QGroundControl's .plan, or .waypoints (QGC WPL 110)")
    ],
    config: Annotated[Path, typer.Option(help="deployment YAML: camera, mount, localizer")],
    map_cache: Annotated[
        Path | None, typer.Option("--map", help="tile cache; default: the deployment's")
    ] = None,
    out: Annotated[Path, typer.Option(help="folder of the report")] = Path("plan"),
    condition: Annotated[
        list[str] | None,
        typer.Option(help="day, season, dusk, night, fog, rain or snow; default: day"),
    ] = None,
    sigma: Annotated[
        float, typer.Option(min=0.05, max=100, help="largest acceptable position sigma, m")
    ] = 1.0,
    spacing: Annotated[
        float, typer.Option(min=2, max=1000, help="distance between the forecast positions, m")
    ] = 25.0,
    speed: Annotated[
        float, typer.Option(min=0.1, max=100, help="speed if the mission has none, m/s")
    ] = 10.0,
    pitch: Annotated[
        float, typer.Option(min=-90, max=0, help="gimbal pitch if the mission has none")
    ] = -75.0,
    flown: Annotated[
        Path | None, typer.Option(help="compare the forecast with this record of the mission")
    ] = None,
    alternatives: Annotated[bool, typer.Option(help="search alternatives for failing legs")] = True,
) -> None:
    """Forecast a mission over its map. Exit code 1: a leg fails, or not all was judged."""
    from companion.planning import page
    from companion.planning import verdicts as check
    from companion.planning.mission import read_mission
    from companion.planning.plan import Question, aim_of, make_plan
    from companion.planning.verdicts import MissionLimits
    from companion.preflight.map_pin import map_hash
    from localizer.forecast.forecast import FORECAST_CONDITIONS
    from localizer.map.cache.cache import TileCache
    from localizer.pictures import write_rgb

    conditions = tuple(dict.fromkeys(condition or ["day"]))
    unknown = [c for c in conditions if c not in FORECAST_CONDITIONS]
    if unknown:
        raise typer.BadParameter(
            f"--condition {unknown[0]}: one of {', '.join(FORECAST_CONDITIONS)}"
        )
    deployment = load_config(config)
    planned = read_mission(mission)
    cache = TileCache.open(map_cache or deployment.map)
    frames = None if flown is None else check.recorded_frames(flown, cache)
    make_folder(out, "--out")
    question = replace(
        Question(mission, conditions, MissionLimits(sigma)),
        spacing_m=spacing, speed_m_s=speed, pitch_deg=pitch, seek=alternatives,
    )  # fmt: skip
    with show_count(Console(stderr=True), "points") as count:
        plan = make_plan(planned, cache, deployment, question, count)
    camera = deployment.camera.model.camera().without_distortion()
    with show_work(Console(stderr=True), "drawing the images"):
        sheet = page.render_map_square(plan, cache)
        aim = aim_of(deployment, pitch)
        shown = (
            ("Track", page.track_picture(sheet, plan)),
            ("Ground that is seen", page.heat_picture(sheet, plan, cache, camera, aim)),
        )
    legs = () if frames is None else check.flown_legs(plan.verdicts, *frames)
    document = page.as_data(plan) | {"map_sha256": map_hash(cache.path)}
    with writing(out, "--out"):
        for name, (_, rgb) in zip(("track.png", "heat.png"), shown, strict=True):
            write_rgb(out / name, rgb)
        page.write_page(plan, shown, out / "plan.html")
        write_result(out / "plan.json", json.dumps(document, indent=1))
    _print("legs", page.LEG_HEADINGS, [page.leg_row(v) for v in plan.verdicts])
    _print("without vision", page.STRETCH_HEADINGS, map(page.stretch_row, plan.stretches))
    _print("alternatives", page.PROPOSAL_HEADINGS, page.proposal_rows(plan))
    if legs:
        _print("flown", check.FLOWN_HEADINGS, [leg.row for leg in legs])
        tell(check.flown_words(legs))
    for note in plan.notes:
        tell(escape(note), "dim")
    tell(
        f"{escape(page.verdict_words(plan))} {escape(str(out / 'plan.html'))}",
        "green" if plan.holds else "red",
    )
    raise typer.Exit(0 if plan.holds else 1)


def _print(title: str, headings: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    made = [tuple(map(escape, row)) for row in rows]
    if made:
        show_table(headings, made, title)
