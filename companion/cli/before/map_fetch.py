"""``companion map fetch``: make a map of an area from public services."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from companion.cli.before.shared_options import numbers
from companion.cli.output import show_table, tell, tell_warnings
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
    tell(f"area: {area}")
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
    total = _print_estimate(parts)
    if total > most_mb:
        raise ConfigError(
            f"about {total:.0f} MB, more than --most-mb {most_mb:.0f}: a smaller area, a coarser "
            "--resolution, or a higher --most-mb"
        )
    if only_estimate:
        return
    for part in parts:
        _fetched(part, area)
    if buildings is not None:
        parts[1] = _raise_buildings(parts[1], buildings)
    _built(parts, out, overwrite, workers)
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
    tell(escape(f"{out}: {done.line()}"))


def sources_command(
    sources: Sources = None,
    keys: Annotated[bool, typer.Option("--keys", help="keys of a source's entry")] = False,
) -> None:
    """List the map services of `map fetch`, licences and attributions."""
    from localizer.map.fetch.catalogue import CatalogueSource, load_sources

    if keys:
        fields = CatalogueSource.model_fields.items()
        rows = [(name, escape(info.description or "")) for name, info in fields]
        show_table(("key", "meaning"), rows)
        return
    for source in load_sources(tuple(sources or ())):
        _print_source(source)


def _print_source(source: CatalogueSource) -> None:
    """Print a source. The name comes first and uncut, to be copied; long lines continue below."""
    head = f"{source.name}  ({source.country}, {source.role}, {source.resolution_m:g} m)"
    tell(escape(head), "bold")
    for what, text in (
        ("what", source.title), ("licence", source.licence), ("attribution", source.attribution),
    ):  # fmt: skip
        if (console := Console()).is_terminal:
            line = Table.grid(padding=(0, 1))
            line.add_column(width=16, no_wrap=True)
            line.add_column(overflow="fold")
            line.add_row(f"    {what}:", escape(text))
            console.print(line)
        else:
            tell(escape(f"    {what}: {text}"))


def _area(rectangle: str | None, circle: str | None, mission: Path | None, margin: float) -> Area:
    from companion.planning.mission import read_mission
    from localizer.map.fetch.area import Area, area_around

    if sum(given is not None for given in (rectangle, circle, mission)) != 1:
        raise ConfigError("give one of --rectangle, --circle and --mission")
    if rectangle is not None:
        return Area(*numbers(rectangle, "--rectangle", ("WEST", "SOUTH", "EAST", "NORTH")))
    if circle is not None:
        latitude, longitude, radius = numbers(circle, "--circle", ("LAT", "LON", "RADIUS"))
        return area_around(np.array([[latitude, longitude]]), radius)
    assert mission is not None
    planned = read_mission(mission)
    places = [(p.latitude_deg, p.longitude_deg) for p in planned.path]
    for unknown in planned.not_judged:
        if unknown.flies:
            tell(
                f"[yellow]warning:[/] not on a known way: {escape(unknown.text)}; a larger "
                "--margin may be needed",
                err=True,
            )
    circles = [abs(p.circle.radius_m) for p in planned.path if p.circle is not None]
    return area_around(np.array(places), margin + max(circles, default=0.0))


def _planned(
    source: CatalogueSource, area: Area, resolution: float, most_mb: float, work: Path, role: str
) -> _Part:
    from localizer.map.fetch.fetch import make_plan
    from localizer.map.fetch.http_client import HttpClient

    client = HttpClient(source.rate_per_s, round(most_mb * _MB))
    wanted = source.resolution_m if source.has_heights else max(source.resolution_m, resolution)
    plan = make_plan(source, area, wanted, client)
    return _Part(source, plan, client, work / f"{role}-pieces", work / f"{role}.tif")


def _print_estimate(parts: list[_Part]) -> float:
    """Print a line for each source, with what it lacks; returns the megabytes of all."""
    from localizer.map.fetch.fetch import estimate

    total = 0.0
    for part in parts:
        expected = estimate(part.source, part.plan)
        total += expected.bytes / _MB
        width, height = expected.pixels
        tell(
            f"{part.source.name}: {part.source.title}; {width} x {height} pixels, about "
            f"{expected.requests} requests, {expected.bytes / _MB:.1f} MB, "
            f"{expected.seconds:.0f} s at {part.source.rate_per_s:g} requests/s"
        )
        tell(f"  licence: {part.source.licence}")
        tell_warnings(
            f"{part.source.name} has no {name}: sea, or land that it lacks; the map has a hole "
            "there"
            for name in part.plan.lacking
        )
    return total


def _fetched(part: _Part, area: Area) -> None:
    from localizer.map.fetch.fetch import fetch

    try:
        with show_count(Console(stderr=True), f"fetching {part.source.name}") as progress:
            known = fetch(part.source, part.plan, part.folder, part.out, part.client, progress)
    except KeyboardInterrupt:
        tell("interrupted: the same command goes on with what has come", err=True)
        raise
    tell(
        f"{part.source.name}: {part.client.bytes / _MB:.1f} MB in {part.client.requests} requests, "
        f"{100 * known:.1f} % of its raster known"
    )


def _raise_buildings(part: _Part, footprints: Footprints) -> _Part:
    """The terrain with buildings raised on it, as a source with both attributions."""
    from localizer.map.footprints.raise_buildings import raise_buildings

    out = part.out.with_name("raised.tif")
    with show_work(Console(stderr=True), "raising buildings"):
        done = raise_buildings(part.out, footprints, out)
    tell(escape(f"{footprints.path.name}: {done.line()}"))
    if not footprints.attribution:
        tell_warnings(
            ("nobody says whose the footprints are: name them with --footprints-attribution",)
        )
    buildings = footprints.attribution or footprints.path.name
    whose = f"{part.source.attribution}; buildings: {buildings}"
    return replace(part, out=out, source=part.source.model_copy(update={"attribution": whose}))


def _built(parts: list[_Part], out: Path, overwrite: bool, workers: int | None) -> None:
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
    tell_warnings(manifest.warnings)
    with show_work(Console(stderr=True), "verifying the cache"):
        found = verify(TileCache.open(out))
    for line in found.damaged:
        tell(f"[red]{escape(line)}")
    if found.damaged:
        raise typer.Exit(1)
    tell(
        f"[green]{escape(str(out))}[/]: {manifest.tiles} tiles, all intact, "
        f"{found.covered_m2 / 1e6:.2f} km² covered, {len(found.holes)} holes, "
        f"{manifest.gsd_m:.2f} m texels; © {escape(str(options.attribution))}"
    )
