"""``companion calibrate``: measure camera and mounting of a deployment."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console
from rich.markup import escape

from companion.cli.before.shared_options import Record, RecordMap, RecordTlog
from companion.cli.output import show_table, tell
from companion.config import load_config
from companion.errors import ConfigError
from companion.terminal.steps import show_count
from companion.writing import result_file, write_result

app = typer.Typer(
    no_args_is_help=True, help="Camera, mounting and times, from a flight or a board."
)


@app.command("flight")
def flight_command(
    record: Record,
    tlog: RecordTlog = None,
    map_cache: RecordMap = None,
    frames: Annotated[int, typer.Option(min=20, max=2000, help="largest number of frames")] = 200,
    config: Annotated[
        Path | None, typer.Option(help="deployment file that the record was flown with")
    ] = None,
    write: Annotated[bool, typer.Option(help="change that file and keep the old one")] = False,
    report: Annotated[Path | None, typer.Option("--json", help="file for all figures")] = None,
) -> None:
    """Estimate camera, mounting angles, lever arm, time and map offset from a shadow flight."""
    from companion.calibrate.flight import calibrate
    from companion.calibrate.proposal import (
        blind_spots,
        require_flown_with,
        setting_changes,
        write_changed,
    )
    from companion.offline.record import load_record
    from localizer.map.cache.cache import TileCache

    if write and config is None:
        raise ConfigError("--write needs --config: which deployment file is to be changed?")
    if report is not None:
        result_file(report, "--json", (".json",), config, tlog, *record.glob("*.json"))
    if config is not None:
        load_config(config)
    loaded = load_record(record, 0.0, tlog, map_cache)
    with show_count(Console(stderr=True), "images") as count:
        found = calibrate(loaded, frames, count)
    wanted = setting_changes(loaded.config, found)
    _show_numbers(found)
    blind = blind_spots(found)
    tell("This flight does not determine:" if blind else "This flight determines all.")
    for line in blind:
        tell(f"  {escape(line)}")
    doubt = loaded.tables.flown_map.mismatch(TileCache.open(loaded.config.map))
    for note in (*found.notes, *filter(None, (doubt,))):
        tell(escape(note), "yellow")
    tell(
        f"{found.frames} images, {found.parts} of their parts: {found.before_px:.2f} px from the "
        f"map with the deployment's camera, {found.after_px:.2f} px with the one found"
    )
    _show_changes(wanted)
    if report is not None:
        text = json.dumps(_figures(found, wanted, blind), indent=1)
        write_result(report, text, "--json")
    if write and config is not None:
        require_flown_with(config, wanted)
        kept = write_changed(config, wanted, f"calibrated by `companion calibrate flight {record}`")
        tell(f"{config} is changed; before it: {kept}", "green")


def _show_numbers(found: Any) -> None:
    from companion.calibrate.unknowns import UNKNOWNS

    rows = [
        (n.name, f"{value * n.scale:+.3g}", f"{sigma * n.scale:.2g}", n.unit,
         "yes" if sigma <= n.useful else "no")
        for n, value, sigma in zip(UNKNOWNS, found.shared, found.sigmas, strict=True)
    ]  # fmt: skip
    headings = ("", "differs by", "1 sigma", "unit", "determined")
    show_table(headings, rows, "against the deployment", headings[1:3])


def _show_changes(wanted: tuple[Any, ...]) -> None:
    rows = [(".".join(c.key), str(c.before), str(c.after)) for c in wanted]
    show_table(("key", "before", "after"), rows, "deployment")


def _figures(found: Any, wanted: tuple[Any, ...], blind: tuple[str, ...]) -> dict[str, Any]:
    from companion.calibrate.unknowns import UNKNOWNS

    return {
        "numbers": [
            {"name": n.name, "unit": n.unit, "value": float(v * n.scale),
             "sigma": float(s * n.scale)}
            for n, v, s in zip(UNKNOWNS, found.shared, found.sigmas, strict=True)
        ],
        "covariance": found.covariance.tolist(), "cannot_tell": list(blind),
        "changes": {".".join(c.key): [c.before, c.after] for c in wanted},
        "pictures": found.frames, "parts": found.parts,
        "before_px": found.before_px, "after_px": found.after_px, "notes": list(found.notes),
    }  # fmt: skip


@app.command("board")
def board_command(
    source: Annotated[
        str | None, typer.Argument(help="the stream: udp://, rtsp://, /dev/video0, file or folder")
    ] = None,
    sheet: Annotated[
        Path | None, typer.Option("--print", help="write the board to print: .pdf or .png")
    ] = None,
    paper: Annotated[Literal["a4", "a3", "letter"], typer.Option(help="paper of the board")] = "a4",
    seconds: Annotated[
        float, typer.Option(min=1, max=3600, help="longest time of a stream")
    ] = 180.0,
    config: Annotated[Path | None, typer.Option(help="deployment file to change")] = None,
    keep: Annotated[Path | None, typer.Option(help="folder for the used views")] = None,
) -> None:
    """Calibrate a camera from views of a printed board; names the views that are missing."""
    from companion.calibrate.board import write_sheet

    if sheet is not None:
        made = write_sheet(sheet, paper)
        tell(
            f"{sheet}: print it at 100 % on {paper} and glue it on a flat plate; a square is then "
            f"{made.square_mm:g} mm (another size does no harm)"
        )
    if source is None:
        if sheet is None:
            raise typer.BadParameter("give the stream, or --print a file for the board")
        return
    _film(source, seconds, keep, config)


def _film(source: str, seconds: float, keep: Path | None, config: Path | None) -> None:
    from companion.calibrate.board import solve_lens, watch_board
    from companion.calibrate.proposal import lens_changes, write_changed

    def told(taken: int, word: str, missing: list[str]) -> None:
        wanted = "; ".join(missing[:3]) or "nothing: enough"
        tell(f"{taken:2d} views ({word}); missing: {wanted}")

    before = load_config(config) if config is not None else None
    filmed = watch_board(source, seconds, told, keep)
    lens = solve_lens(filmed.views, filmed.width, filmed.height)
    c = lens.camera
    tell(
        f"{lens.views[0]} of {lens.views[1]} views, {lens.rms_px:.2f} px rms; focal lengths "
        f"{c.fx:.2f}, {c.fy:.2f} px (sigma {lens.sigmas[0]:.2f}), principal point {c.cx:.2f}, "
        f"{c.cy:.2f} px (sigma {lens.sigmas[2]:.2f})"
    )
    if filmed.missing:
        tell(f"not seen: {'; '.join(filmed.missing)}", "yellow")
    wanted = lens_changes(before, lens)
    _show_changes(wanted)
    if config is not None:
        kept = write_changed(config, wanted, "lens by `companion calibrate board`")
        tell(f"{config} is changed; before it: {kept}", "green")
