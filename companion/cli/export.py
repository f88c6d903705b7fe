"""``companion export`` and ``companion klv``: a record for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from companion.cli.before.shared_options import RecordMap, RecordTlog
from companion.cli.output import tell
from companion.errors import ConfigError
from companion.terminal.steps import show_count, show_steps, tally
from companion.writing import result_file


def export_command(
    record: Annotated[
        Path, typer.Argument(help="folder that `companion run` recorded, or a demo's")
    ],
    mcap: Annotated[
        bool, typer.Option("--mcap", help="MCAP for Foxglove, Lichtblick and Rerun")
    ] = False,
    out: Annotated[
        Path | None, typer.Option(help="file to write; default: record.mcap in the record")
    ] = None,
    tlog: RecordTlog = None,
) -> None:
    """Write a record in a format that other programs open."""
    if not mcap:
        raise ConfigError("say which format: --mcap, the only one so far; the .tlog needs none")
    with show_steps(Console(stderr=True)) as say:
        say(f"reading {record}")
        from companion.export.mcap_export import export_mcap

        written = export_mcap(record, out, tlog, lambda n: say(f"{n} rows written"))
    for note in written.notes:
        tell(f"note: {escape(note)}")
    told = f"{written.messages} messages of {written.rows} rows, images and MAVLink messages"
    path = escape(str(written.path))
    tell(f"{told}: [green]{path}[/]")


def klv_command(
    video: Annotated[Path, typer.Argument(help="recording of the camera's stream")],
    record: Annotated[Path, typer.Option(help="folder that `companion run` recorded")],
    out: Annotated[
        Path | None, typer.Option(help="file to write; default: .klv.ts beside the video")
    ] = None,
    map_cache: RecordMap = None,
    begin: Annotated[
        float | None,
        typer.Option(
            help="seconds from the record's start to the first frame; default: MISP timestamps"
        ),
    ] = None,
    mission: Annotated[str, typer.Option(help="mission name in each packet")] = "",
) -> None:
    """Write the video as MPEG-TS with MISB ST 0601 metadata, without encoding it again."""
    from companion.reporting.klv_recording import describe_recording

    path = result_file(out or video.with_suffix(".klv.ts"), "--out", (".ts",), video)
    with show_count(Console(stderr=True), "describing") as show:
        written = describe_recording(
            video, record, path, map_cache=map_cache, begin_s=begin, mission=mission,
            progress=tally(show),
        )  # fmt: skip
    tell(
        f"{written.described} of {written.pictures} frames described: [green]{escape(str(path))}[/]"
    )
