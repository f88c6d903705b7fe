"""``companion convert``: camera poses from and to the formats of other programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console

from companion.cli.before.shared_options import numbers
from companion.cli.output import tell_notes
from companion.errors import ConfigError
from companion.terminal.steps import show_work
from companion.writing import refuse_input, writing
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.trajectory import StampedPose

OutputFormat = Literal["poses", "tum", "colmap", "photos", "autopilot"]


def convert_command(
    source: Annotated[
        Path, typer.Argument(help="a file; a folder for photos and for the record of a flight")
    ],
    out: Annotated[Path, typer.Argument(help="file to write; a folder of sidecars for photos")],
    of: Annotated[
        Literal[OutputFormat, "record"], typer.Option("--from", help="format of the source")
    ],
    to: Annotated[OutputFormat, typer.Option("--to", help="format of the result")],
    map_cache: Annotated[
        Path | None, typer.Option("--map", help="tile cache with the ENU frame")
    ] = None,
    origin: Annotated[
        str | None, typer.Option(help="LAT,LON,HEIGHT of the ENU frame, instead of --map")
    ] = None,
    heights: Annotated[
        Literal["amsl", "ellipsoidal"] | None,
        typer.Option(help="datum of the heights in photo tags"),
    ] = None,
    geoid_separation: Annotated[
        float | None, typer.Option(help="geoid above the ellipsoid, m; default: the map's")
    ] = None,
    times: Annotated[
        Path | None,
        typer.Option(help="timestamps.txt ('name nanoseconds') for poses without a time"),
    ] = None,
) -> None:
    """Convert camera poses: pose lines, TUM, COLMAP, photos' tags, autopilot angles, records."""
    from companion.convert.formats import READERS, WRITERS, MapReference
    from companion.convert.photos import Heights

    _refuse_footage(source, out, to)
    refuse_input(out, "OUT", source, source / "estimates.csv", times)
    frame, separation = _frame(map_cache, origin)
    if geoid_separation is not None:
        separation = _on_earth(geoid_separation)
    above = None
    if heights is not None:
        if heights == "amsl" and separation is None:
            raise ConfigError("--heights amsl needs --geoid-separation or --map")
        above = Heights(heights, separation or 0.0)
    notes: list[str] = []
    place = MapReference(frame, above, notes.append)
    with show_work(Console(stderr=True), f"converting {source}"):
        poses = _dated(READERS[of](source, place), times, needed=to == "tum")
        with writing(out):
            WRITERS[to](out, poses, place)
    tell_notes(notes)
    typer.echo(f"{out}: {len(poses)} poses")


def _refuse_footage(source: Path, out: Path, to: OutputFormat) -> None:
    """`ConfigError` if the result would replace a photo, its sidecar or a video."""
    from companion.recorded.photo_tags import PHOTO_SUFFIXES, RAW_SUFFIXES
    from companion.recorded.video import VIDEO_SUFFIXES

    if to == "photos":
        refuse_input(out, "OUT", source.parent if source.is_file() else None)
    elif out.suffix.lower() in PHOTO_SUFFIXES | RAW_SUFFIXES | VIDEO_SUFFIXES | {".xmp"}:
        raise ConfigError(f"OUT {out}: a footage file's name; give a text file, as poses.txt")


def _on_earth(separation_m: float) -> float:
    from localizer.map.cache.cache import HIGHEST_GEOID_M, LOWEST_GEOID_M

    if not LOWEST_GEOID_M <= separation_m <= HIGHEST_GEOID_M:  # NaN is not either
        raise ConfigError(f"--geoid-separation {separation_m}: no such separation occurs on Earth")
    return separation_m


def _frame(map_cache: Path | None, origin: str | None) -> tuple[LocalFrame | None, float | None]:
    """The ENU frame and the geoid separation (m) there; None for what is not given."""
    if map_cache is not None and origin is not None:
        raise ConfigError("give either --map or --origin LAT,LON,HEIGHT")
    if origin is not None:
        lat, lon, height = numbers(origin, "--origin", ("LAT", "LON", "HEIGHT"))
        return LocalFrame(Geodetic(lat, lon, height)), None
    if map_cache is None:
        return None, None
    from localizer.map.cache.cache import TileCache

    cache = TileCache.open(map_cache)
    return cache.frame, cache.manifest.geoid_separation_m


def _dated(
    poses: Sequence[StampedPose], times: Path | None, *, needed: bool
) -> tuple[StampedPose, ...]:
    """The poses with the file's times, or with its names for their times. needed: times are."""
    if times is None:
        if needed and any(pose.time_ns is None for pose in poses):
            raise ConfigError("these poses have no times: give --times timestamps.txt")
        return tuple(poses)
    from companion.sources.folder_source import read_timestamps

    by_name = read_timestamps(times)
    names = {time_ns: name for name, time_ns in by_name.items()}
    dated = []
    for pose in poses:
        if pose.name in by_name:
            dated.append(replace(pose, time_ns=by_name[pose.name]))
        elif pose.time_ns in names:
            dated.append(replace(pose, name=names[pose.time_ns]))
        else:
            raise ConfigError(f"--times {times}: says nothing of {pose.name}")
    return tuple(dated)
