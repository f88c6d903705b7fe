"""Building a tile cache: every importer's tiles go through here, in parallel, atomically."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from scipy.spatial import ConvexHull, QhullError

from localizer.errors import GeoreferenceError, MapSourceError
from localizer.geo import Geodetic, LocalFrame, geodetic_from_ecef
from localizer.map.cache import ADD, REPLACE, Manifest, TileIndex, tile_name
from localizer.map.georeference import Georeference, UpAxis, read_georeference
from localizer.map.levels import with_levels
from localizer.map.source import SourceMesh, SourceNode, SourceTree, TileSource, VerticalDatum
from localizer.map.staging import Record, Staging, StoredTile, publish, staging
from localizer.map.tiles3d import read_tileset
from localizer.pose import Array

_MESHES = (".glb", ".gltf", ".obj")
_RASTERS = (".tif", ".tiff", ".vrt")
_IMPORTABLE = (
    "3D Tiles (tileset.json or its folder), a mesh (.glb, .gltf, .obj) with a georeference, or a "
    "DSM and an orthophoto (GeoTIFF)"
)
_NAMED_FAILURES = 20  # how many bad tiles an error message lists


def build_cache(
    source: Path | Sequence[Path],
    out: Path,
    *,
    geoid_separation_m: float | None = None,
    vertical_datum: VerticalDatum | None = None,
    georeference: Georeference | Path | None = None,
    up_axis: UpAxis | None = None,
    origin: Geodetic | None = None,
    attribution: str | None = None,
    skip_bad_tiles: bool = False,
    overwrite: bool = False,
    workers: int | None = None,
    progress: bool = True,
    scheduler: str | None = None,
) -> Manifest:
    """Import a map source into a tile cache at `out`.

    source: a `tileset.json` or its folder, a mesh (glTF, GLB, OBJ), or a DSM and an orthophoto.
    geoid_separation_m: height of the geoid above the ellipsoid at the map (MAVLink altitudes are
    above the geoid); needed unless the source carries it. vertical_datum: what the source's heights
    are; "amsl" ones are lifted by the separation; needed unless the source's format fixes it.
    georeference, up_axis: of a mesh, see `read_georeference` and `read_mesh`. origin: of the world
    frame, else the source's centre. skip_bad_tiles: leave out tiles that cannot be imported (their
    parents are shown there) instead of failing. workers: processes, else one per core; more than
    one needs the usual ``if __name__ == "__main__"`` guard in a script. scheduler: address of a
    Dask scheduler whose workers share the file system, instead of local processes. An interrupted
    build goes on where it stopped.
    """
    sources = [Path(source)] if isinstance(source, str | Path) else [Path(s) for s in source]
    named = " ".join(map(str, sources))
    return build_tree(
        read_source(sources, georeference, up_axis),
        out,
        name=named,
        geoid_separation_m=geoid_separation_m,
        vertical_datum=vertical_datum,
        origin=origin,
        attribution=attribution,
        skip_bad_tiles=skip_bad_tiles,
        overwrite=overwrite,
        workers=workers,
        progress=progress,
        scheduler=scheduler,
    )


def build_tree(
    tree: SourceTree,
    out: Path,
    *,
    name: str,
    geoid_separation_m: float | None = None,
    vertical_datum: VerticalDatum | None = None,
    origin: Geodetic | None = None,
    attribution: str | None = None,
    skip_bad_tiles: bool = False,
    overwrite: bool = False,
    workers: int | None = None,
    progress: bool = True,
    scheduler: str | None = None,
) -> Manifest:
    """Build a cache from any importer's tree; see `build_cache`. name: of the source."""
    separation = _geoid_separation(tree, geoid_separation_m, name)
    datum = _vertical_datum(tree, vertical_datum, name)
    lift = separation if datum == "amsl" else 0.0
    frame = LocalFrame(origin or _origin(tree, lift))
    parameters = {
        "origin": [frame.origin.latitude_deg, frame.origin.longitude_deg, frame.origin.height_m],
        "vertical_datum": datum,
        "geoid_separation_m": separation,
        "options": tree.options,
        "source_fingerprint": _fingerprint(tree.files),
    }
    with staging(Path(out), parameters, overwrite=overwrite) as staged:
        job = _Job(staged, frame, lift)
        records = _import_all(
            tree.root, job, workers or os.cpu_count() or 1, scheduler, progress=progress
        )
        skipped = _failures(tree.root, records)
        if skipped and not skip_bad_tiles:
            raise MapSourceError(_failure_text(name, skipped))
        index, manifest = _assemble(tree, records, staged, frame)
        manifest = manifest.model_copy(
            update={
                "vertical_datum": datum,
                "geoid_separation_m": separation,
                "source": name,
                "attribution": tree.attribution if attribution is None else attribution,
                "build": parameters,
                "skipped": skipped,
            }
        )
        return publish(staged, Path(out), index, manifest)


def read_source(
    sources: Sequence[Path],
    georeference: Georeference | Path | None = None,
    up_axis: UpAxis | None = None,
) -> SourceTree:
    """The tile tree of any source that can be imported."""
    for path in sources:
        if not path.exists():
            raise MapSourceError(f"{path}: no such file or folder")
    if all(path.suffix.lower() in _RASTERS for path in sources):
        return _read_rasters(sources)
    if len(sources) > 1:
        raise MapSourceError("several sources can only be a DSM and an orthophoto")
    if sources[0].suffix.lower() in _MESHES:
        return _read_mesh(sources[0], georeference, up_axis)
    if sources[0].is_dir() or sources[0].suffix.lower() == ".json":
        return with_levels(read_tileset(sources[0]))
    raise MapSourceError(f"{sources[0]}: not a source that can be imported: {_IMPORTABLE}")


def _read_rasters(sources: Sequence[Path]) -> SourceTree:
    try:
        from localizer.map.raster import read_rasters
    except ImportError as error:
        raise MapSourceError(
            f"rasters need the packages rasterio and fast-simplification: {error}"
        ) from error
    return read_rasters(sources)


def _read_mesh(
    source: Path, georeference: Georeference | Path | None, up_axis: UpAxis | None
) -> SourceTree:
    if georeference is None:
        raise GeoreferenceError(
            f"{source}: a mesh does not say where on Earth it stands; give a georeference file"
        )
    if isinstance(georeference, Path):
        georeference = read_georeference(georeference)
    try:
        from localizer.map.mesh import read_mesh
    except ImportError as error:
        raise MapSourceError(f"meshes need the package fast-simplification: {error}") from error
    return read_mesh(source, georeference, up_axis)


@dataclass(frozen=True)
class _Job:
    """What a worker needs besides the tile. lift_m: added to heights."""

    staged: Staging
    frame: LocalFrame
    lift_m: float

    def run(self, key: int, tile: TileSource) -> Record:
        try:
            meshes = [self._to_enu(m) for m in tile.load() if len(m.faces)]
        except MapSourceError as error:
            return self.staged.reject(key, str(error))
        except MemoryError:
            return self.staged.reject(key, "does not fit into memory")
        return self.staged.store(key, meshes)

    def _to_enu(self, mesh: SourceMesh) -> SourceMesh:
        positions = mesh.positions
        if self.lift_m:
            lat, lon, _ = np.radians(geodetic_from_ecef(positions.mean(axis=0)))
            up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
            positions = positions + self.lift_m * up
        enu = self.frame.ecef_from_enu.inverse.apply(positions)
        if np.abs(enu).max() > 1e6:
            raise MapSourceError("lies more than 1000 km from the map's origin")
        return replace(mesh, positions=enu)


def _tiles(root: SourceNode) -> Iterator[TileSource]:
    for node in root.walk():
        yield from node.tiles


def _import_all(
    root: SourceNode, job: _Job, workers: int, scheduler: str | None, *, progress: bool
) -> dict[int, Record]:
    """Records of every source tile, by its place in `_tiles` order."""
    records: dict[int, Record] = {}
    todo: list[tuple[int, TileSource]] = []
    for key, tile in enumerate(_tiles(root)):
        done = job.staged.record(key)
        if done is not None and done.error is None:
            records[key] = done
        else:
            todo.append((key, tile))
    if not records and not todo:
        raise MapSourceError("the source has no tile with content")
    columns = (TextColumn("importing tiles"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeRemainingColumn(), disable=not progress) as bar:
        task = bar.add_task("", total=len(records) + len(todo), completed=len(records))
        if scheduler is not None:
            run = _run_dask(job, todo, scheduler)
        else:
            run = _run_here(job, todo) if workers == 1 else _run_pool(job, todo, workers)
        for key, record in run:
            records[key] = record
            bar.advance(task)
    return records


def _run_here(job: _Job, todo: Iterable[tuple[int, TileSource]]) -> Iterator[tuple[int, Record]]:
    for key, tile in todo:
        yield key, job.run(key, tile)


def _run_dask(
    job: _Job, todo: list[tuple[int, TileSource]], address: str
) -> Iterator[tuple[int, Record]]:
    try:
        from distributed import Client, as_completed
    except ImportError as error:
        raise MapSourceError(f"a Dask scheduler needs the package distributed: {error}") from error
    with Client(address) as client:
        queue = iter(todo)
        room = 4 * max(
            1, sum(client.nthreads().values())
        )  # queued tiles, so that memory is bounded
        running = as_completed(
            [client.submit(_numbered, job, *item, pure=False) for item in islice(queue, room)]
        )
        for future in running:
            yield future.result()
            for item in islice(queue, 1):
                running.add(client.submit(_numbered, job, *item, pure=False))


def _numbered(job: _Job, key: int, tile: TileSource) -> tuple[int, Record]:
    return key, job.run(key, tile)


def _run_pool(
    job: _Job, todo: list[tuple[int, TileSource]], workers: int
) -> Iterator[tuple[int, Record]]:
    pending: dict[Future[Record], tuple[int, TileSource]] = {}
    queue = iter(todo)
    suspects: list[tuple[int, TileSource]] = []
    pool = _pool(min(workers, max(1, len(todo))))
    try:
        while True:
            # A short queue bounds memory: each pending tile is at most one decoded tile.
            for item in queue:
                pending[pool.submit(job.run, *item)] = item
                if len(pending) >= 2 * workers:
                    break
            if not pending:
                break
            done, _ = wait(pending, return_when=FIRST_COMPLETED)
            try:
                for future in done:
                    record = future.result()
                    yield pending.pop(future)[0], record
            except BrokenProcessPool:
                suspects += pending.values()
                pending.clear()
                pool.shutdown(wait=False)
                pool = _pool(workers)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
    for item in suspects:
        yield item[0], _run_alone(job, *item)


def _run_alone(job: _Job, key: int, tile: TileSource) -> Record:
    """A tile that was in flight when a worker died: does it kill this one too?"""
    with _pool(1) as pool:
        try:
            return pool.submit(job.run, key, tile).result()
        except BrokenProcessPool:
            return job.staged.reject(key, "its decoder crashed: the file is damaged")


def _pool(workers: int) -> ProcessPoolExecutor:
    # Not fork: OpenCV's and the caller's threads do not survive it.
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(workers, mp_context=context, initializer=_start_worker)


def _start_worker() -> None:
    cv2.setNumThreads(1)


def _failures(root: SourceNode, records: dict[int, Record]) -> dict[str, str]:
    named = enumerate(_tiles(root))
    return {t.name: e for k, t in named if (e := records[k].error) is not None}


def _failure_text(source: str, failures: dict[str, str]) -> str:
    lines = [f"{name}: {why}" for name, why in list(failures.items())[:_NAMED_FAILURES]]
    more = len(failures) - len(lines)
    return "\n  ".join(
        [
            f"{source}: {len(failures)} tiles cannot be imported; repair them or ask to skip them",
            *lines,
            *([f"and {more} more"] if more else []),
        ]
    )


def _geoid_separation(tree: SourceTree, given: float | None, source: str) -> float:
    value = tree.geoid_separation_m if given is None else given
    if value is None:
        raise GeoreferenceError(
            f"{source} does not say how high the geoid is above the WGS84 ellipsoid there; give "
            "the geoid separation in metres (e.g. from an EGM96 or EGM2008 calculator)"
        )
    if not -120 <= value <= 100:
        raise GeoreferenceError(f"a geoid separation of {value} m does not occur on Earth")
    return value


def _vertical_datum(tree: SourceTree, given: VerticalDatum | None, source: str) -> VerticalDatum:
    if given not in (None, "ellipsoidal", "amsl"):
        raise GeoreferenceError(f"vertical datum {given!r}: ellipsoidal and amsl are known")
    datum = given or tree.vertical_datum
    if datum is None:
        raise GeoreferenceError(
            f"{source} does not say what its heights are; give the vertical datum: ellipsoidal "
            "(WGS84) or amsl (above the geoid)"
        )
    return datum


def _origin(tree: SourceTree, lift: float) -> Geodetic:
    if not 6.2e6 < np.linalg.norm(tree.centre) < 6.5e6:
        raise GeoreferenceError(
            "the source is not placed on Earth: its root transform or volume does not lead to ECEF "
            "coordinates; it needs a georeference"
        )
    lat, lon, h = geodetic_from_ecef(tree.centre)
    return Geodetic(round(float(lat), 9), round(float(lon), 9), round(float(h) + lift, 4))


def _fingerprint(files: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in files:
        try:
            stat = path.stat()
        except OSError:
            digest.update(f"{path} missing\n".encode())
            continue
        digest.update(f"{path} {stat.st_size} {stat.st_mtime_ns}\n".encode())
    return digest.hexdigest()


@dataclass(eq=False)
class _Node:
    """A node with its stored tiles, on the way to the index."""

    source: SourceNode
    keys: list[int]
    records: list[Record]
    children: list[_Node]

    @property
    def tiles(self) -> list[StoredTile]:
        return [tile for record in self.records for tile in record.tiles]

    @property
    def failed(self) -> bool:
        return any(record.error is not None for record in self.records)


def _graft(root: SourceNode, records: dict[int, Record]) -> _Node:
    """The tree with records, pruned where a tile is missing.

    Where a child of a REPLACE node could not be imported, nothing below the node is used: its
    coarser surface is shown instead of a hole.
    """
    first: dict[int, int] = {}
    key = 0
    order = list(root.walk())
    for node in order:
        first[id(node)] = key
        key += len(node.tiles)
    built: dict[int, _Node] = {}
    for node in reversed(order):
        keys = list(range(first[id(node)], first[id(node)] + len(node.tiles)))
        children = [built.pop(id(c)) for c in node.children]
        result = _Node(node, keys, [records[k] for k in keys], children)
        whole = all(_covers(c) for c in children)
        if node.replaces and node.stands_in and result.tiles and not whole:
            result.children = []
        result.children = [c for c in result.children if c.tiles or c.children]
        built[id(node)] = result
    return built[id(root)]


def _covers(node: _Node) -> bool:
    """Whether the node, or what is below it, shows everything it should."""
    if node.failed:
        return bool(node.children) and all(_covers(c) for c in node.children)
    return True


def _assemble(
    tree: SourceTree, records: dict[int, Record], staged: Staging, frame: LocalFrame
) -> tuple[TileIndex, Manifest]:
    root = _graft(tree.root, records)
    nodes = [root]
    child_start = []
    for node in nodes:  # grows while it is walked: breadth first, children side by side
        child_start.append(len(nodes))
        nodes.extend(node.children)
    tiles: list[StoredTile] = []
    tile_start = []
    for node in nodes:
        tile_start.append(len(tiles))
        for key, record in zip(node.keys, node.records, strict=True):
            for part, tile in enumerate(record.tiles):
                _link(staged.tile_path(key, part), staged.folder / tile_name(len(tiles)))
                tiles.append(tile)
    if not tiles:
        raise MapSourceError("not one tile of the source has a surface")
    low, high = _boxes(nodes, child_start)
    index = TileIndex(
        box_min=low,
        box_max=high,
        geometric_error=np.array([n.source.geometric_error for n in nodes]),
        gsd=np.array([max((t.gsd for t in n.tiles), default=0.0) for n in nodes]),
        refine=np.array([REPLACE if n.source.replaces else ADD for n in nodes], np.uint8),
        child_start=np.array(child_start, np.int32),
        child_count=np.array([len(n.children) for n in nodes], np.int32),
        tile_start=np.array(tile_start, np.int32),
        tile_count=np.array([len(n.tiles) for n in nodes], np.int32),
        ecef_from_tile=_tile_transforms(tiles, frame),
        size=np.array([t.size for t in tiles], np.int64),
        digest=np.array([list(bytes.fromhex(t.sha256)) for t in tiles], np.uint8),
    )
    return index, _manifest(nodes, child_start, tiles, frame)


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)  # the part stays, so that a build killed here can go on
    except OSError:
        os.replace(source, target)


def _boxes(nodes: list[_Node], child_start: list[int]) -> tuple[Array, Array]:
    low = np.full((len(nodes), 3), np.inf)
    high = np.full((len(nodes), 3), -np.inf)
    for i in reversed(range(len(nodes))):
        for tile in nodes[i].tiles:
            low[i] = np.minimum(low[i], tile.box_min)
            high[i] = np.maximum(high[i], tile.box_max)
        below = slice(child_start[i], child_start[i] + len(nodes[i].children))
        if nodes[i].children:
            low[i] = np.minimum(low[i], low[below].min(axis=0))
            high[i] = np.maximum(high[i], high[below].max(axis=0))
    return low, high


def _tile_transforms(tiles: list[StoredTile], frame: LocalFrame) -> Array:
    transforms = np.tile(frame.ecef_from_enu.matrix, (len(tiles), 1, 1))
    transforms[:, :3, 3] = frame.ecef_from_enu.apply(np.array([t.center for t in tiles]))
    return transforms


def _manifest(
    nodes: list[_Node], child_start: list[int], tiles: list[StoredTile], frame: LocalFrame
) -> Manifest:
    depth = np.ones(len(nodes), int)
    for i, node in enumerate(nodes):
        depth[child_start[i] : child_start[i] + len(node.children)] = depth[i] + 1
    leaves = [t for n in nodes if not n.children for t in n.tiles]
    gsd = [t.gsd for t in leaves if t.gsd > 0]
    corners = np.array([c for t in leaves for c in (t.box_min, t.box_max)])
    boxes = np.array([(*t.box_min, *t.box_max) for t in leaves])
    footprint = np.concatenate(
        [boxes[:, [0, 1]], boxes[:, [3, 1]], boxes[:, [3, 4]], boxes[:, [0, 4]]]
    )
    try:
        outline = footprint[ConvexHull(footprint).vertices]
    except QhullError as error:
        raise MapSourceError("the source's surface has no extent on the ground") from error
    flat = np.column_stack([outline, np.zeros(len(outline))])
    geodetic = frame.geodetic_from_enu(flat)
    heights = frame.geodetic_from_enu(corners)[:, 2]
    return Manifest(
        origin=frame.origin,
        vertical_datum="ellipsoidal",
        geoid_separation_m=0.0,
        source="",
        attribution="",
        gsd_m=float(np.median(gsd)) if gsd else 0.0,
        levels=int(depth.max()),
        tiles=len(tiles),
        triangles=sum(t.triangles for t in leaves),
        bytes=sum(t.file_bytes for t in tiles),
        extent=tuple((float(lat), float(lon)) for lat, lon, _ in geodetic),
        height_range_m=(float(heights.min()), float(heights.max())),
        build={},
        skipped={},
        index_sha256="",
    )
