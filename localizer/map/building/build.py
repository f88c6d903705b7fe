"""Builds a tile cache from any importer's tiles, in parallel and atomically; tree and manifest."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from localizer.errors import GeoreferenceError, MapSourceError
from localizer.geometry.geo import Geodetic, LocalFrame, geodetic_from_ecef
from localizer.geometry.pose import Array
from localizer.map.building.content import (
    extent_warnings,
    heights_of,
    require_in_volumes,
    require_upright,
)
from localizer.map.building.options import BuildOptions
from localizer.map.building.sources import find_source, read_source
from localizer.map.building.staging import (
    Staging,
    StoredTile,
    TileRecord,
    publish,
    staging,
    write_index,
)
from localizer.map.building.workers import (
    ImportJob,
    Progress,
    call_in_process,
    import_all,
    tiles_of,
)
from localizer.map.cache.cache import ADD, REPLACE, Manifest, TileIndex, tile_name
from localizer.map.inspection.kind import measure_kind
from localizer.map.kind import IMAGERY_DATE
from localizer.map.source import SourceNode, SourceTree


@dataclass(eq=False)
class _Node:
    """A node of the tree with the records of its tiles."""

    source: SourceNode
    keys: list[int]
    records: list[TileRecord]
    children: list[_Node]

    @property
    def tiles(self) -> list[StoredTile]:
        return [tile for record in self.records for tile in record.tiles]

    @property
    def failed(self) -> bool:
        return any(record.error is not None for record in self.records)


def _graft(root: SourceNode, records: dict[int, TileRecord]) -> _Node:
    """The tree with records, pruned where a tile is missing.

    If a child of a REPLACE node could not be imported, all children of this node are left out: its
    coarser surface is shown, and there is no hole.
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
    """Whether the node, or its children instead of it, were imported completely."""
    if node.failed:
        return bool(node.children) and all(_covers(c) for c in node.children)
    return True


@dataclass(frozen=True, eq=False)
class Assembled:
    """A cache before publishing. figures: fields of the `Manifest` that the tiles determine;
    leaves: the finest tiles; volumes: ECEF corners (8, 3) that the source states for nodes, with
    their tiles.
    """

    index: TileIndex
    figures: dict[str, Any]
    leaves: list[StoredTile]
    volumes: list[tuple[Array, list[StoredTile]]]


def assemble(
    tree: SourceTree, records: dict[int, TileRecord], staged: Staging, frame: LocalFrame
) -> Assembled:
    """Place the imported tiles in the staging folder. `MapSourceError` if no tile has a surface."""
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
    return Assembled(
        index,
        _figures(nodes, child_start, tiles, frame),
        [tile for node in nodes if not node.children for tile in node.tiles],
        [(n.source.corners, n.tiles) for n in nodes if n.source.corners is not None and n.tiles],
    )


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


def _figures(
    nodes: list[_Node], child_start: list[int], tiles: list[StoredTile], frame: LocalFrame
) -> dict[str, Any]:
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
    return {
        "gsd_m": float(np.median(gsd)) if gsd else 0.0,
        "levels": int(depth.max()),
        "tiles": len(tiles),
        "triangles": sum(t.triangles for t in leaves),
        "bytes": sum(t.file_bytes for t in tiles),
        "extent": tuple((float(lat), float(lon)) for lat, lon, _ in geodetic),
        "height_range_m": (float(heights.min()), float(heights.max())),
    }


_NAMED_FAILURES = 20  # how many bad tiles an error message lists


def build_cache(
    source: Path | Sequence[Path],
    out: Path,
    options: BuildOptions | None = None,
    *,
    progress: Progress | None = None,
    name: str | None = None,
) -> Manifest:
    """Import a map source into a tile cache at `out`, which must not exist unless `overwrite` is
    set.

    An interrupted build continues; an error leaves `out` as it was (`MapSourceError`,
    `GeoreferenceError` or `MapCacheError`).

    source: a `tileset.json`, a mesh (glTF, GLB, OBJ), a DSM and an orthophoto, or a folder with one
    of these. progress: called with the number of imported tiles and of all tiles.

    name: of the source, in errors and in the manifest; None: its files.
    """
    options = options or BuildOptions()
    given = [Path(source)] if isinstance(source, str | Path) else [Path(s) for s in source]
    sources, georeference = find_source(given, options.georeference)
    named = name or " ".join(map(str, sources))
    if options.is_apart:
        what = f"{named}: its reading"
        tree = call_in_process(
            read_source, sources, georeference, options, rules=options.rules, what=what
        )
    else:
        tree = read_source(sources, georeference, options)
    return build_tree(tree, out, named, options, progress=progress)


def build_tree(
    tree: SourceTree,
    out: Path,
    name: str,
    options: BuildOptions | None = None,
    *,
    progress: Progress | None = None,
) -> Manifest:
    """Build a cache from any importer's tree; see `build_cache`. name: of the source.
    `MapSourceError` if a tile cannot be read and bad tiles are not to be skipped.
    """
    options = options or BuildOptions()
    rules = options.rules
    date = _date(options.imagery_date) or tree.imagery_date
    _require_on_earth(tree)
    separation, datum, doubts = heights_of(
        tree, options.geoid_separation_m, options.vertical_datum, name, rules
    )
    lift = separation if datum == "amsl" else 0.0
    frame = LocalFrame(options.origin or _origin(tree, lift))
    parameters = {
        "origin": [frame.origin.latitude_deg, frame.origin.longitude_deg, frame.origin.height_m],
        "vertical_datum": datum,
        "geoid_separation_m": separation,
        "options": tree.options,
        "source_fingerprint": fingerprint(tree.files),
    }
    with staging(Path(out), parameters, overwrite=options.overwrite) as staged:
        job = ImportJob(staged, frame, lift, rules)
        records = import_all(tree.root, job, options, progress or (lambda _done, _total: None))
        skipped = _failures(tree.root, records)
        if skipped and not options.skip_bad_tiles:
            raise MapSourceError(_failure_text(name, skipped))
        built = assemble(tree, records, staged, frame)
        doubts += require_upright(built.leaves, tree.up_axis, name, rules)
        doubts += require_in_volumes(built.volumes, frame, lift, name, rules)
        doubts += extent_warnings(
            built.figures["extent"], built.figures["height_range_m"], separation, name, rules
        )
        manifest = Manifest(
            origin=frame.origin,
            vertical_datum=datum,
            geoid_separation_m=separation,
            source=name,
            attribution=tree.attribution if options.attribution is None else options.attribution,
            build=parameters,
            skipped=skipped,
            warnings=(*tree.warnings, *doubts),
            index_sha256="",
            **built.figures,
        )
        cache = write_index(staged, built.index, manifest)
        kind = measure_kind(
            cache,
            heights=options.heights,
            imagery_date=date,
            sensor=options.sensor or tree.sensor,
        )
        return publish(staged, Path(out), cache.manifest.model_copy(update={"kind": kind}))


def _date(imagery_date: str | None) -> str | None:
    if imagery_date is not None and not re.fullmatch(IMAGERY_DATE, imagery_date):
        raise MapSourceError(
            f"imagery date {imagery_date!r}: give a year, a month or a day, as 2024-06-30"
        )
    return imagery_date


def _failures(root: SourceNode, records: dict[int, TileRecord]) -> dict[str, str]:
    named = enumerate(tiles_of(root))
    return {t.name: e for k, t in named if (e := records[k].error) is not None}


def _failure_text(source: str, failures: dict[str, str]) -> str:
    lines = [f"{name}: {why}" for name, why in list(failures.items())[:_NAMED_FAILURES]]
    more = len(failures) - len(lines)
    return "\n  ".join(
        [
            f"{source}: {len(failures)} tiles cannot be imported; repair them or leave "
            "them out (--skip-bad-tiles)",
            *lines,
            *([f"and {more} more"] if more else []),
        ]
    )


def _require_on_earth(tree: SourceTree) -> None:
    if not 6.2e6 < np.linalg.norm(tree.centre) < 6.5e6:
        raise GeoreferenceError(
            "the source is not placed on Earth: its root transform or volume does not lead to ECEF "
            "coordinates; it needs a georeference"
        )


def _origin(tree: SourceTree, lift: float) -> Geodetic:
    lat, lon, h = geodetic_from_ecef(tree.centre)
    return Geodetic(round(float(lat), 9), round(float(lon), 9), round(float(h) + lift, 4))


def fingerprint(files: Iterable[Path]) -> str:
    """Hash of files' names, sizes and times, to detect changes."""
    digest = hashlib.sha256()
    for path in files:
        try:
            stat = path.stat()
        except OSError:
            digest.update(f"{path} missing\n".encode())
            continue
        digest.update(f"{path} {stat.st_size} {stat.st_mtime_ns}\n".encode())
    return digest.hexdigest()
