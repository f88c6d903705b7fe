"""Builds a tile cache from any importer's tiles, in parallel and atomically."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from localizer.errors import GeoreferenceError, MapSourceError
from localizer.geometry.geo import Geodetic, LocalFrame, geodetic_from_ecef
from localizer.map.building.assembly import assemble
from localizer.map.building.content import (
    extent_warnings,
    heights_of,
    require_in_volumes,
    require_upright,
)
from localizer.map.building.isolation import call_in_process
from localizer.map.building.options import BuildOptions
from localizer.map.building.sources import find_source, read_source
from localizer.map.building.staging import TileRecord, publish, staging, write_index
from localizer.map.building.workers import ImportJob, Progress, import_all, tiles_of
from localizer.map.cache.cache import Manifest
from localizer.map.inspection.kind import measure_kind
from localizer.map.kind import IMAGERY_DATE
from localizer.map.source import SourceNode, SourceTree

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
