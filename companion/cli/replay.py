"""``companion replay``: localize a recorded flight again and compare."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from companion.cli.before.shared_options import Record, RecordMap, RecordTlog
from companion.cli.console import listening, require_extra, serve
from companion.cli.output import show_table, tell, tell_warnings
from companion.errors import RecordError
from companion.terminal.steps import COMPILES, show_count, show_steps, tally
from localizer.geometry.pose import Array


def replay_command(
    record: Record,
    tlog: RecordTlog = None,
    map_cache: RecordMap = None,
    tolerance_m: Annotated[
        float, typer.Option(min=0, help="allowed difference, m; 95 % of the positions must meet it")
    ] = 1.0,
    page: Annotated[
        str | None,
        typer.Option("--console", help="address:port: show the record in a browser instead"),
    ] = None,
) -> None:
    """Localize a recorded flight again. Exit code 0: it agrees with the record, 1: it differs."""
    if page is not None:
        show_record(record, map_cache, page)
        return
    from companion.offline.record import load_record
    from companion.offline.replay import replay, summarize
    from localizer.map.cache.cache import TileCache

    loaded = load_record(record, tlog=tlog, map_cache=map_cache)
    with show_count(Console(stderr=True), "localizing", begins=COMPILES) as show:
        summary = summarize(replay(loaded, tally(show, len(loaded.estimates))))
    if doubt := loaded.tables.flown_map.mismatch(TileCache.open(loaded.config.map)):
        tell_warnings((doubt,))
    columns = ("", "median", "p95", "max")
    rows = (
        ("position differs, m", *_spread(summary.translation_m, 2)),
        ("rotation differs, °", *_spread(summary.rotation_deg, 3)),
    )
    show_table(columns, rows, str(record), columns[1:])
    tell(
        f"{summary.frames} frames: {summary.accepted_recorded} accepted in flight, "
        f"{summary.accepted_replayed} in the replay, {summary.accepted_both} in both"
    )
    agrees = summary.agrees(tolerance_m)
    tell("[green]agrees" if agrees else "[red]differs")
    raise typer.Exit(0 if agrees else 1)


def _spread(values: Array, digits: int) -> tuple[str, ...]:
    if not len(values):
        return ("-", "-", "-")
    return tuple(f"{x:.{digits}f}" for x in (*np.percentile(values, [50, 95]), values.max()))


def show_record(record: Path, map_cache: Path | None, listen: str) -> None:
    """Serve the page with the record until interrupted; records beside it can be downloaded.
    map_cache: None for the record's own map; listen: address:port.
    """
    require_extra()
    from companion.console.records import Records
    from companion.console.replay_source import ReplaySource
    from companion.console.server import ConsoleSite
    from companion.offline.record import read_record
    from companion.reporting.pictures import map_pictures

    tables = read_record(record)
    map_path = map_cache or tables.map_path
    if map_path is None:
        raise RecordError(f"{record}: does not say which map was flown on; give it as --map")
    config = listening("--console", listen)
    with (
        show_steps(Console(stderr=True)) as say,
        map_pictures(map_path, flown=tables.flown_map) as pictures,
    ):
        say(f"reading {record} and its map")
        source = ReplaySource(tables, pictures)
        for note in pictures.notes:
            say(note)
        records = Records(record.absolute().parent)
        say(f"serving {config.url} until Ctrl-C")
        serve(ConsoleSite(config, source, map_path, records, replay=True))
