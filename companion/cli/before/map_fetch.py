"""``companion map fetch``: make a map of an area from public services."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from companion.errors import ConfigError
from companion.terminal.steps import READING, show_count, show_work
from companion.writing import result_file

if TYPE_CHECKING:
    from localizer.map.fetch.area import Area
    from localizer.map.fetch.catalogue import CatalogueSource
    from localizer.map.fetch.http_client import HttpClient
    from localizer.map.fetch.raster import FetchPlan
    from localizer.map.footprints.footprint import Footprints

_FINEST_M = 0.2  # what a flight at 100 m and a working width of 320 can use, and some more
_MB = 1e6

Sources = Annotated[list[Path] | None, typer.Option(help="YAML file of more sources")]

HeightProperty = Annotated[
    str | None, typer.Option(help="GeoJSON property; default: height and its usual spellings")
]


@dataclass(frozen=True)
class _Part:
    """One of the two rasters (imagery or heights) with its download."""

    source: CatalogueSource
    plan: FetchPlan
    client: HttpClient
    folder: Path
    out: Path


def fetch_command(
    out: Annotated[Path, typer.Option(help="folder of the cache to make")],
    rectangle: Annotated[str | None, typer.Option(help="WEST,SOUTH,EAST,NORTH in degrees")] = None,
    circle: Annotated[
        str | None, typer.Option(help="LATITUDE,LONGITUDE,RADIUS: degrees and metres")
    ] = None,
    mission: Annotated[
        Path | None, typer.Option(help=".plan or .waypoints, with --margin around it")
    ] = None,
    margin: Annotated[
        float, typer.Option(min=10, max=20_000, help="margin around a mission, m")
    ] = 400.0,
    imagery: Annotated[str | None, typer.Option(help="source; default: the finest")] = None,
    heights: Annotated[
        str | None, typer.Option(help="source; default: the finest, GLO-30 if there is no other")
    ] = None,
    sources: Sources = None,
    resolution: Annotated[
        float, typer.Option(min=0.02, max=100, help="imagery resolution, m; not finer than its own")
    ] = _FINEST_M,
    most_mb: Annotated[
        float, typer.Option(min=0.1, max=100_000, help="largest download, MB")
    ] = 2000.0,
    only_estimate: Annotated[
        bool, typer.Option("--estimate", help="print the estimate and exit")
    ] = False,
    footprints: Annotated[
        Path | None,
        typer.Option(help="buildings to raise on a bare terrain: GeoJSON or CityGML with heights"),
    ] = None,
    height_property: HeightProperty = None,
    footprints_attribution: Annotated[
        str | None, typer.Option(help="attribution of the footprints if their file has none")
    ] = None,
    keep: Annotated[
        bool, typer.Option("--keep", help="keep the fetched GeoTIFFs beside the cache")
    ] = False,
    overwrite: Annotated[bool, typer.Option(help="replace an existing cache")] = False,
    workers: Annotated[int | None, typer.Option(min=1, help="processes of the import")] = None,
) -> None:
    """Fetch orthophoto and heights and make a verified cache; continues an interrupted run."""
    from localizer.map.fetch.catalogue import choose, load_sources

    area = _area(rectangle, circle, mission, margin)
    buildings = None
    if footprints is not None:
        from localizer.map.footprints.raise_buildings import read_footprints

        buildings = read_footprints(footprints, height_property)
        if footprints_attribution is not None:
            buildings = replace(buildings, attribution=footprints_attribution)
    known = load_sources(tuple(sources or ()))
    console = Console()
    console.print(f"area: {area}", highlight=False, soft_wrap=True)
    work = out.with_name(f"{out.name}.fetch")
    chosen = [
        (role, choose(known, area, role, name))
        for role, name in (("imagery", imagery), ("heights", heights))
    ]
    with show_work(Console(stderr=True), "asking what the services have"):
        parts = [_planned(one, area, resolution, most_mb, work, role) for role, one in chosen]
    if buildings is not None and parts[1].source.role != "terrain":
        raise ConfigError(
            f"--footprints: {parts[1].source.name} is a surface, which has its buildings; name a "
            "terrain with --heights"
        )
    total = _print_estimate(console, parts)
    if total > most_mb:
        raise ConfigError(
            f"about {total:.0f} MB, more than --most-mb {most_mb:.0f}: a smaller area, a coarser "
            "--resolution, or a higher --most-mb"
        )
    if only_estimate:
        return
    for part in parts:
        _fetched(console, part, area)
    if buildings is not None:
        parts[1] = _raise_buildings(console, parts[1], buildings)
    _built(console, parts, out, overwrite, workers)
    if not keep:
        shutil.rmtree(work, ignore_errors=True)


def raise_command(
    terrain: Annotated[Path, typer.Argument(help="GeoTIFF of bare heights in metres")],
    footprints: Annotated[Path, typer.Argument(help="GeoJSON or CityGML with heights")],
    out: Annotated[Path, typer.Option(help="GeoTIFF of the surface to write")],
    height_property: HeightProperty = None,
) -> None:
    """Raise buildings on a terrain from footprints: a surface for `map build`."""
    result_file(out, "--out", (".tif", ".tiff"), terrain, footprints)
    from localizer.map.footprints.raise_buildings import raise_buildings, read_footprints

    with show_work(Console(stderr=True), "raising buildings"):
        done = raise_buildings(terrain, read_footprints(footprints, height_property), out)
    Console().print(f"{out}: {done.line()}", markup=False, highlight=False, soft_wrap=True)


def sources_command(
    sources: Sources = None,
    keys: Annotated[bool, typer.Option("--keys", help="keys of a source's entry")] = False,
) -> None:
    """List the map services of `map fetch`, licences and attributions."""
    from localizer.map.fetch.catalogue import CatalogueSource, load_sources

    console = Console()
    if keys:
        table = Table("key", "meaning", box=SIMPLE_HEAD)
        for name, info in CatalogueSource.model_fields.items():
            table.add_row(name, escape(info.description or ""))
        console.print(table)
        return
    for source in load_sources(tuple(sources or ())):
        _print_source(console, source)


def _print_source(console: Console, source: CatalogueSource) -> None:
    """Print a source. The name comes first and uncut, to be copied; long lines continue below."""
    head = f"{source.name}  ({source.country}, {source.role}, {source.resolution_m:g} m)"
    console.print(head, style="bold", markup=False, highlight=False, soft_wrap=True)
    for what, text in (
        ("what", source.title), ("licence", source.licence), ("attribution", source.attribution),
    ):  # fmt: skip
        if console.is_terminal:
            line = Table.grid(padding=(0, 1))
            line.add_column(width=16, no_wrap=True)
            line.add_column(overflow="fold")
            line.add_row(f"    {what}:", escape(text))
            console.print(line)
        else:
            console.print(f"    {what}: {text}", markup=False, highlight=False, soft_wrap=True)


def _area(rectangle: str | None, circle: str | None, mission: Path | None, margin: float) -> Area:
    from companion.planning.mission import read_mission
    from localizer.map.fetch.area import Area, area_around

    if sum(given is not None for given in (rectangle, circle, mission)) != 1:
        raise ConfigError("give one of --rectangle, --circle and --mission")
    if rectangle is not None:
        return Area(*_numbers("--rectangle", rectangle, 4))
    if circle is not None:
        latitude, longitude, radius = _numbers("--circle", circle, 3)
        return area_around(np.array([[latitude, longitude]]), radius)
    assert mission is not None
    planned = read_mission(mission)
    places = [(p.latitude_deg, p.longitude_deg) for p in planned.path]
    for unknown in planned.not_judged:
        if unknown.flies:
            Console(stderr=True).print(
                f"[yellow]warning:[/] not on a known way: {escape(unknown.text)}; a larger "
                "--margin may be needed",
                soft_wrap=True,
            )
    circles = [abs(p.circle.radius_m) for p in planned.path if p.circle is not None]
    return area_around(np.array(places), margin + max(circles, default=0.0))


def _numbers(option: str, text: str, count: int) -> list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        raise ConfigError(f"{option} {text}: {count} numbers with commas between them")
    return numbers


def _planned(
    source: CatalogueSource, area: Area, resolution: float, most_mb: float, work: Path, role: str
) -> _Part:
    from localizer.map.fetch.fetch import make_plan
    from localizer.map.fetch.http_client import HttpClient

    client = HttpClient(source.rate_per_s, round(most_mb * _MB))
    wanted = source.resolution_m if source.has_heights else max(source.resolution_m, resolution)
    plan = make_plan(source, area, wanted, client)
    return _Part(source, plan, client, work / f"{role}-pieces", work / f"{role}.tif")


def _print_estimate(console: Console, parts: list[_Part]) -> float:
    """Print a line for each source, with what it lacks; returns the megabytes of all."""
    from localizer.map.fetch.fetch import estimate

    total = 0.0
    for part in parts:
        expected = estimate(part.source, part.plan)
        total += expected.bytes / _MB
        width, height = expected.pixels
        console.print(
            f"{part.source.name}: {part.source.title}; {width} x {height} pixels, about "
            f"{expected.requests} requests, {expected.bytes / _MB:.1f} MB, "
            f"{expected.seconds:.0f} s at {part.source.rate_per_s:g} requests/s",
            highlight=False, soft_wrap=True,
        )  # fmt: skip
        console.print(f"  licence: {part.source.licence}", highlight=False, soft_wrap=True)
        for name in part.plan.lacking:
            console.print(
                f"[yellow]warning:[/] {part.source.name} has no {escape(name)}: sea, or land that "
                "it lacks; the map has a hole there",
                highlight=False, soft_wrap=True,
            )  # fmt: skip
    return total


def _fetched(console: Console, part: _Part, area: Area) -> None:
    from localizer.map.fetch.fetch import fetch

    what = f"fetching {part.source.name}"
    with _counted_text(what) as progress:
        known = fetch(part.source, part.plan, part.folder, part.out, part.client, progress)
    console.print(
        f"{part.source.name}: {part.client.bytes / _MB:.1f} MB in {part.client.requests} requests, "
        f"{100 * known:.1f} % of its raster known",
        highlight=False, soft_wrap=True,
    )  # fmt: skip


@contextmanager
def _counted_text(what: str) -> Iterator[Callable[[int, int], None]]:
    try:
        with show_count(Console(stderr=True), what) as progress:
            yield progress
    except KeyboardInterrupt:
        Console(stderr=True).print("interrupted: the same command goes on with what has come")
        raise


def _raise_buildings(console: Console, part: _Part, footprints: Footprints) -> _Part:
    """The terrain with buildings raised on it, as a source with both attributions."""
    from localizer.map.footprints.raise_buildings import raise_buildings

    out = part.out.with_name("raised.tif")
    with show_work(Console(stderr=True), "raising buildings"):
        done = raise_buildings(part.out, footprints, out)
    console.print(f"{footprints.path.name}: {done.line()}", markup=False, highlight=False,
                  soft_wrap=True)  # fmt: skip
    if not footprints.attribution:
        console.print("[yellow]warning:[/] nobody says whose the footprints are: name them with "
                      "--footprints-attribution", soft_wrap=True)  # fmt: skip
    buildings = footprints.attribution or footprints.path.name
    whose = f"{part.source.attribution}; buildings: {buildings}"
    return replace(part, out=out, source=part.source.model_copy(update={"attribution": whose}))


def _built(
    console: Console, parts: list[_Part], out: Path, overwrite: bool, workers: int | None
) -> None:
    from localizer.map.building.build import build_cache
    from localizer.map.building.options import BuildOptions
    from localizer.map.cache.cache import TileCache
    from localizer.map.inspection.inspect import verify

    imagery, heights = (part.source for part in parts)
    whose = dict.fromkeys((imagery.attribution, heights.attribution))
    licences = dict.fromkeys((imagery.licence, heights.licence))
    options = BuildOptions(
        vertical_datum=heights.vertical_datum,
        attribution=f"{'; '.join(whose)} (licences: {'; '.join(licences)})",
        imagery_date=imagery.date,
        sensor=imagery.title,
        overwrite=overwrite,
        workers=workers,
        apart=True,
    )
    with show_count(Console(stderr=True), "importing tiles", begins=READING) as bar:
        manifest = build_cache([parts[1].out, parts[0].out], out, options, progress=bar)
    for text in manifest.warnings:
        console.print(f"[yellow]warning:[/] {escape(text)}", soft_wrap=True)
    with show_work(Console(stderr=True), "verifying the cache"):
        found = verify(TileCache.open(out))
    for line in found.damaged:
        console.print(f"[red]{escape(line)}")
    if found.damaged:
        raise typer.Exit(1)
    console.print(
        f"[green]{escape(str(out))}[/]: {manifest.tiles} tiles, all intact, "
        f"{found.covered_m2 / 1e6:.2f} km² covered, {len(found.holes)} holes, "
        f"{manifest.gsd_m:.2f} m texels; © {escape(str(options.attribution))}",
        soft_wrap=True,
    )
