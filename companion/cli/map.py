"""``companion map``: build and inspect tile caches."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.console import Console
from rich.markup import escape

from companion.cli.before.map_check import check_command
from companion.cli.before.map_fetch import fetch_command, raise_command, sources_command
from companion.cli.output import show_table, tell, tell_warnings
from companion.errors import ConfigError
from companion.terminal.steps import READING, show_count, show_work
from companion.writing import result_file, write_result, writing

if TYPE_CHECKING:
    from localizer.map.importers.rules import ImportRules

app = typer.Typer(no_args_is_help=True, help="Build and inspect tile caches.")

CachePath = Annotated[Path, typer.Argument(help="folder of a tile cache")]


@app.callback()
def _group() -> None:
    """Tile caches: import a map source, check it, look at it."""


app.command("check")(check_command)
app.command("fetch")(fetch_command)
app.command("raise")(raise_command)
app.command("sources")(sources_command)


@app.command("build")
def build(
    source: Annotated[
        list[Path],
        typer.Argument(
            help="3D Tiles (tileset.json or its folder), an OpenDroneMap result folder, a mesh "
            "(.glb, .gltf, .obj) with a georeference, or a DSM and an orthophoto (GeoTIFF)"
        ),
    ],
    out: Annotated[Path, typer.Option(help="folder of the cache to make")],
    geoid_separation: Annotated[
        float | None,
        typer.Option(help="geoid above the ellipsoid, m; default: the source's, then EGM96"),
    ] = None,
    vertical_datum: Annotated[
        Literal["ellipsoidal", "amsl"] | None,
        typer.Option(help="datum of the source's heights: WGS84 ellipsoid or geoid (amsl)"),
    ] = None,
    georeference: Annotated[
        Path | None, typer.Option(help="georeference of a mesh: JSON, or ODM's offset file")
    ] = None,
    up_axis: Annotated[
        Literal["y", "z"] | None,
        typer.Option(help="upward axis of a mesh or tileset; default: y (glTF), z (OBJ)"),
    ] = None,
    height_unit: Annotated[
        str | None, typer.Option(help="height unit of a DSM that states none: m, ft or us-ft")
    ] = None,
    nodata: Annotated[
        float | None, typer.Option(help="missing cells of a DSM that states none")
    ] = None,
    flat_ground: Annotated[
        float | None,
        typer.Option(help="height of the ground, m, below an orthophoto without a DSM: a flat map"),
    ] = None,
    attribution: Annotated[str | None, typer.Option(help="attribution of the source")] = None,
    imagery_date: Annotated[
        str | None, typer.Option(help="date of the imagery: 2024, 2024-06 or 2024-06-30")
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option(help="sensor that took the source's images; default: as its tags state"),
    ] = None,
    heights: Annotated[
        Literal["surface", "terrain", "flat"] | None,
        typer.Option(
            help="what the heights contain: surface (buildings and trees), terrain or flat; "
            "default: measured"
        ),
    ] = None,
    skip_bad_tiles: Annotated[
        bool, typer.Option(help="skip tiles that cannot be imported")
    ] = False,
    overwrite: Annotated[bool, typer.Option(help="replace an existing cache")] = False,
    workers: Annotated[
        int | None, typer.Option(min=1, help="number of processes; default: one per core")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="address of a Dask scheduler that shares the file system")
    ] = None,
    overview: Annotated[
        bool,
        typer.Option(
            "--overview",
            help="compute the overview for relocalization now, not on first use",
        ),
    ] = False,
    limit: Annotated[
        list[str] | None,
        typer.Option(help="NAME=NUMBER: raise the limit that an error message names"),
    ] = None,
    trust: Annotated[
        list[str] | None,
        typer.Option(help="accept the input that an error message doubts by this name"),
    ] = None,
) -> None:
    """Import a source into a tile cache; continues an interrupted build."""
    from localizer.map.building.build import build_cache
    from localizer.map.building.options import BuildOptions
    from localizer.map.importers.rules import ImportRules

    rules = ImportRules.of(limit or (), trust or ())
    name = None
    if flat_ground is not None:
        _require_flat(flat_ground, source, height_unit, heights)
        height_unit, name = "m", str(source[0])
    try:
        with (
            _with_ground(source, flat_ground, out, rules) as sources,
            show_count(Console(stderr=True), "importing tiles", begins=READING) as bar,
        ):
            manifest = build_cache(
                sources,
                out,
                BuildOptions(
                    geoid_separation_m=geoid_separation,
                    vertical_datum=vertical_datum,
                    georeference=georeference,
                    up_axis=up_axis,
                    height_unit=height_unit,
                    nodata=nodata,
                    attribution=attribution,
                    imagery_date=imagery_date,
                    sensor=sensor,
                    heights=heights,
                    skip_bad_tiles=skip_bad_tiles,
                    overwrite=overwrite,
                    workers=workers,
                    apart=True,
                    scheduler=scheduler,
                    rules=rules,
                ),
                progress=bar,
                name=name,
            )
    except KeyboardInterrupt:
        tell("interrupted: the same command goes on with what is done", err=True)
        raise
    tell(
        f"[green]{escape(str(out))}[/] from {escape(manifest.source)}: {manifest.tiles} tiles, "
        f"{manifest.triangles} triangles, {manifest.gsd_m:.3f} m texels, "
        f"{manifest.bytes / 1e6:.1f} MB"
    )
    if manifest.skipped:
        tell(f"[yellow]{len(manifest.skipped)} source tiles were left out")
    tell_warnings(manifest.warnings)
    if overview:
        _make_overview(out)


def _require_flat(
    ground_m: float, source: list[Path], height_unit: str | None, heights: str | None
) -> None:
    """`ConfigError` if the options contradict a flat ground."""
    from localizer.map.importers.height_crs import unit_of
    from localizer.map.importers.rules import HIGHEST_M, LOWEST_M

    option = f"--flat-ground {ground_m:g}"
    if not LOWEST_M <= ground_m <= HIGHEST_M:
        raise ConfigError(f"{option}: give metres from {LOWEST_M:g} to {HIGHEST_M:g}")
    if len(source) != 1:
        raise ConfigError("--flat-ground is for an orthophoto alone; leave it out with a DSM")
    if height_unit is not None and unit_of(height_unit) != 1.0:
        raise ConfigError(f"{option} is in metres; leave out --height-unit {height_unit}")
    if heights not in (None, "flat"):
        raise ConfigError(f"{option} makes a flat map; leave out --heights {heights}")


@contextmanager
def _with_ground(
    source: list[Path], ground_m: float | None, out: Path, rules: ImportRules
) -> Iterator[list[Path]]:
    """The source, and a flat ground in a folder beside the cache that is removed afterwards. The
    workers of a scheduler can read this folder. Warnings name a raster by its file name, so the
    ground has the name of the orthophoto.
    """
    from localizer.map.importers.raster_file import write_flat_ground

    with ExitStack() as stack:
        if ground_m is not None:
            with writing(out, "--out"):
                out.parent.mkdir(parents=True, exist_ok=True)
                made = TemporaryDirectory(prefix=f"{out.name}.ground-", dir=out.parent)
                ground = Path(stack.enter_context(made)) / source[0].name
                write_flat_ground(source[0], ground_m, ground, rules)
            source = [*source, ground]
        yield source


@app.command("info")
def info(
    cache: CachePath,
    geojson: Annotated[Path | None, typer.Option(help="file for the map's outline")] = None,
    kml: Annotated[Path | None, typer.Option(help="file for the map's outline")] = None,
) -> None:
    """Coverage, heights, texel size, levels and sizes."""
    if geojson is not None:
        result_file(geojson, "--geojson", (".geojson", ".json"))
    if kml is not None:
        result_file(kml, "--kml", (".kml",))
    from localizer.geometry.geo import geo_box
    from localizer.geometry.geoid import geoid_separation
    from localizer.map.cache.cache import TileCache
    from localizer.map.inspection.inspect import as_geojson, as_kml, levels
    from localizer.map.inspection.kind import map_kind
    from localizer.map.kind import HEIGHTS_HOLD

    opened = TileCache.open(cache)
    m, kind = opened.manifest, map_kind(opened)
    box = geo_box(m.extent)
    egm96 = geoid_separation(m.origin.latitude_deg, m.origin.longitude_deg)
    size = opened.index.box_max[0] - opened.index.box_min[0]
    facts = {
        "source": m.source,
        "attribution": m.attribution or "not given",
        "heights hold": HEIGHTS_HOLD[kind.heights],
        "imagery": f"resolves {kind.effective_resolution_m:.3f} m, of "
        f"{kind.imagery_date or 'a date not known'}, by {kind.sensor or 'a sensor not known'}",
        "origin": f"{m.origin.latitude_deg:.7f}, {m.origin.longitude_deg:.7f}, "
        f"{m.origin.height_m:.2f} m (ellipsoidal)",
        "latitude": f"{box.south:.6f} to {box.north:.6f}",
        "longitude": f"{box.west:.6f} to {box.east:.6f}",
        "heights of the source": m.vertical_datum,
        "geoid separation": f"{m.geoid_separation_m:.2f} m (EGM96 there: {egm96:.2f} m)",
        "extent": f"{size[0]:.0f} x {size[1]:.0f} m, {m.height_range_m[0]:.1f} to "
        f"{m.height_range_m[1]:.1f} m (ellipsoidal)",
        "texel size": f"{m.gsd_m:.3f} m",
        "tiles": f"{m.tiles} in {m.levels} levels, {m.bytes / 1e6:.1f} MB",
        "triangles": f"{m.triangles} at the finest level",
        "left out": f"{len(m.skipped)} source tiles",
    }
    show_table(("", str(cache)), facts.items())
    rows = [
        (str(one.level), str(one.tiles), f"{one.gsd_m:.2f}", f"{one.geometric_error_m:.2f}",
         f"{one.megabytes:.2f}")
        for one in levels(opened)
    ]  # fmt: skip
    show_table(("level", "tiles", "texel m", "geometric error m", "MB"), rows)
    tell_warnings(m.warnings)
    for file, written, option in ((geojson, as_geojson, "--geojson"), (kml, as_kml, "--kml")):
        if file is not None:
            write_result(file, written(m, opened.path.name), option)


@app.command("verify")
def verify(cache: CachePath) -> None:
    """Check every tile's hash and list holes. Exit code 1: a tile is damaged.

    A hole may be in the source, for example under a bridge's parapet or at a ragged edge. Holes are
    listed and do not count as damage.
    """
    from companion.preflight.map_pin import map_hash
    from localizer.map.cache.cache import TileCache
    from localizer.map.inspection.inspect import verify as check

    opened = TileCache.open(cache)
    with show_work(Console(stderr=True), f"hashing {opened.manifest.tiles} tiles, seeking holes"):
        result = check(opened)
    tell_warnings(opened.manifest.warnings)
    for line in result.damaged:
        tell(f"[red]{line}")
    for hole in result.holes[:10]:
        lat, lon = hole.centre
        tell(f"hole of {hole.area_m2:.0f} m² at {lat:.6f}, {lon:.6f}")
    tell(
        f"{result.tiles - len(result.damaged)} of {result.tiles} tiles intact, "
        f"{len(result.holes)} holes, {result.covered_m2 / 1e6:.3f} km² covered"
    )
    tell(f"map_sha256: {map_hash(cache)}")
    if not result.ok:
        raise typer.Exit(1)


@app.command("render")
def render(
    cache: CachePath,
    latitude: Annotated[float, typer.Option(help="degrees")],
    longitude: Annotated[float, typer.Option(help="degrees")],
    height: Annotated[float, typer.Option(help="metres above the ellipsoid")],
    heading: Annotated[float, typer.Option(help="degrees clockwise from north")] = 0.0,
    pitch: Annotated[float, typer.Option(help="degrees above the horizon; -90 looks down")] = -90.0,
    width: Annotated[int, typer.Option(min=8, max=8192, help="pixels")] = 1280,
    image_height: Annotated[int, typer.Option(min=8, max=8192, help="pixels")] = 960,
    fov: Annotated[
        float, typer.Option(min=1, max=170, help="horizontal field of view, degrees")
    ] = 60.0,
    out: Annotated[Path, typer.Option(help="PNG; the depth is written beside it")] = Path(
        "view.png"
    ),
) -> None:
    """Render the map and its depth from a pose."""
    depth = out.with_name(f"{out.stem}_depth{out.suffix}")
    for file in (out, depth):
        result_file(file, "--out", (".png",))
    from localizer.geometry.camera import Camera
    from localizer.map.cache.cache import TileCache
    from localizer.map.inspection import inspect
    from localizer.pictures import write_rgb

    opened = TileCache.open(cache)
    pose = inspect.camera_pose(opened, latitude, longitude, height, heading, pitch)
    with show_work(Console(stderr=True), "rendering; the first time compiles the renderer"):
        view = inspect.render_view(opened, pose, Camera.from_fov(width, image_height, fov))
    with writing(out, "--out"):
        write_rgb(out, view.rgb)
        write_rgb(depth, inspect.depth_picture(view.depth))
    shown = view.depth[view.depth > 0]
    tell(f"{out}, {depth}: depth {shown.min():.1f} to {shown.max():.1f} m")


@app.command("export")
def export(
    cache: CachePath,
    out: Annotated[Path, typer.Option(help="GLB to write")],
    level: Annotated[
        int | None, typer.Option(min=0, help="level of the tile tree; default: the finest")
    ] = None,
) -> None:
    """Write the map's surface as one GLB (y up, metres about the cache's origin)."""
    result_file(out, "--out", (".glb",))
    from localizer.map.cache.cache import TileCache
    from localizer.map.inspection.inspect import export_glb

    opened = TileCache.open(cache)
    with writing(out, "--out"), show_work(Console(stderr=True), "joining the tiles"):
        triangles = export_glb(opened, out, level)
    tell(f"{out}: {triangles} triangles, {out.stat().st_size / 1e6:.1f} MB")


def _make_overview(cache: Path) -> None:
    """Compute the overview for relocalization, with progress."""
    from localizer.config import LocalizerConfig
    from localizer.map.cache.cache import TileCache
    from localizer.relocalization.relocalizer import open_relocalizer

    with show_count(Console(stderr=True), "overview", begins="the map from above") as show:
        opened = open_relocalizer(
            TileCache.open(cache),
            LocalizerConfig(),
            progress=show,
        )
    if opened is not None:
        with opened as relocalizer:
            view = relocalizer.overview
            tell(f"overview: {view.area_km2:.2f} km², {view.nbytes / 1e6:.1f} MB")
