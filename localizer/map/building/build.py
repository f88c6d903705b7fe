"""Building a tile cache: every importer's tiles go through here, in parallel, atomically."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from localizer.errors import GeoreferenceError, MapSourceError
from localizer.geometry.geo import Geodetic, LocalFrame, geodetic_from_ecef
from localizer.map.building.assembly import assemble
from localizer.map.building.sources import find_source, read_source
from localizer.map.building.staging import Record, publish, staging
from localizer.map.building.workers import ImportJob, Progress, import_all, tiles_of
from localizer.map.cache.cache import HIGHEST_GEOID_M, LOWEST_GEOID_M, Manifest
from localizer.map.importers.georeference import Georeference, UpAxis
from localizer.map.source import SourceNode, SourceTree, VerticalDatum

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
    progress: Progress | None = None,
    scheduler: str | None = None,
) -> Manifest:
    """Import a map source into a tile cache at `out`.

    source: a `tileset.json`, a mesh (glTF, GLB, OBJ), a DSM and an orthophoto, or a folder that
    holds one of these.
    geoid_separation_m: height of the geoid above the ellipsoid at the map (MAVLink altitudes are
    above the geoid); needed unless the source carries it. vertical_datum: what the source's heights
    are; "amsl" ones are lifted by the separation; needed unless the source's format fixes it.
    georeference, up_axis: of a mesh, see `read_georeference` and `mesh_tree`. origin: of the world
    frame, else the source's centre. skip_bad_tiles: leave out tiles that cannot be imported (their
    parents are shown there) instead of failing. workers: processes, else one per core; more than
    one needs the usual ``if __name__ == "__main__"`` guard in a script. scheduler: address of a
    Dask scheduler whose workers share the file system, instead of local processes. progress: told
    the number of imported tiles and of all, at the start and after each. An interrupted build goes
    on where it stopped.
    """
    given = [Path(source)] if isinstance(source, str | Path) else [Path(s) for s in source]
    sources, georeference = find_source(given, georeference)
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
    progress: Progress | None = None,
    scheduler: str | None = None,
) -> Manifest:
    """Build a cache from any importer's tree; see `build_cache`. name: of the source."""
    separation, datum = _heights(tree, geoid_separation_m, vertical_datum, name)
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
        job = ImportJob(staged, frame, lift)
        tell = progress or (lambda _done, _total: None)
        records = import_all(tree.root, job, workers or os.cpu_count() or 1, scheduler, tell)
        skipped = _failures(tree.root, records)
        if skipped and not skip_bad_tiles:
            raise MapSourceError(_failure_text(name, skipped))
        index, manifest = assemble(tree, records, staged, frame)
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


def _failures(root: SourceNode, records: dict[int, Record]) -> dict[str, str]:
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


def _heights(
    tree: SourceTree, separation_m: float | None, datum: VerticalDatum | None, source: str
) -> tuple[float, VerticalDatum]:
    """Geoid separation and vertical datum, as given or as the source says; all that is missing is
    named at once.
    """
    if datum not in (None, "ellipsoidal", "amsl"):
        raise GeoreferenceError(f"vertical datum {datum!r}: ellipsoidal and amsl are known")
    separation_m = tree.geoid_separation_m if separation_m is None else separation_m
    datum = datum or tree.vertical_datum
    missing = []
    if datum is None:
        missing.append(
            "what its heights are above: give the vertical datum (--vertical-datum), ellipsoidal "
            "(WGS84) or amsl (the geoid)"
        )
    if separation_m is None:
        missing.append(
            "how high the geoid is above the WGS84 ellipsoid there: give the geoid separation in "
            "metres (--geoid-separation), from an EGM96 or EGM2008 calculator"
        )
    if datum is None or separation_m is None:
        raise GeoreferenceError(f"{source} does not say " + "; nor ".join(missing))
    if not LOWEST_GEOID_M <= separation_m <= HIGHEST_GEOID_M:
        raise GeoreferenceError(f"a geoid separation of {separation_m} m does not occur on Earth")
    return separation_m, datum


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
