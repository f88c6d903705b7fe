"""Fetches one source over one area into one GeoTIFF: plan, estimate, download."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from localizer.errors import MapFetchError
from localizer.map.fetch.area import Area
from localizer.map.fetch.catalogue import CatalogueSource
from localizer.map.fetch.cloud import degree_files, plan_files
from localizer.map.fetch.http_client import HttpClient
from localizer.map.fetch.mosaic import assemble, check_piece
from localizer.map.fetch.raster import FetchPlan, Piece
from localizer.map.fetch.stac import stac_files
from localizer.map.fetch.tiles import plan_tiles
from localizer.map.fetch.web_map import plan_blocks

_LINE_BYTES_PER_S = 2e6  # that a line and a server are taken to give, for an estimate
_LEAST_KNOWN = 0.5  # of a raster, below which it is no map of the place

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class FetchEstimate:
    """Estimated size and time of a download."""

    requests: int
    bytes: float
    seconds: float
    pixels: tuple[int, int]


def make_plan(
    source: CatalogueSource, area: Area, resolution_m: float, client: HttpClient
) -> FetchPlan:
    """Plan all requests; may query the service (capabilities, catalogue, file header)."""
    if source.kind in ("wms", "wcs"):
        return plan_blocks(source, area, resolution_m, client)
    if source.kind in ("xyz", "tms", "wmts"):
        return plan_tiles(source, area, resolution_m, client)
    if source.kind == "stac":
        files = stac_files(source, area, client)
    else:
        files = degree_files(source, area)
    return plan_files(source, area, resolution_m, files, client)


def estimate(source: CatalogueSource, plan: FetchPlan) -> FetchEstimate:
    """Estimate the download before it starts."""
    seconds = max(plan.requests / source.rate_per_s, plan.bytes / _LINE_BYTES_PER_S)
    size = plan.grid.width, plan.grid.height
    return FetchEstimate(plan.requests, plan.bytes, seconds, size)


def fetch(
    source: CatalogueSource, plan: FetchPlan, folder: Path, out: Path, client: HttpClient,
    progress: Progress = lambda _done, _total: None,
) -> float:  # fmt: skip
    """Download the raster to `out`. folder: keeps the pieces, for this download alone: those of an
    interrupted run of this plan are reused, and all its files are deleted if they are of another
    plan. Returns the share of valid pixels. `MapFetchError` if the source has less than half of the
    area.
    """
    _claim(source, plan, folder)
    missing = [p for p in plan.pieces if not (folder / p.name).exists()]
    done = len(plan.pieces) - len(missing)
    progress(done, len(plan.pieces))
    few = 4 * source.parallel  # at a time, so that an end does not wait for thousands
    with ThreadPoolExecutor(source.parallel, thread_name_prefix="fetch") as pool:
        for first in range(0, len(missing), few):
            part = missing[first : first + few]
            for _ in pool.map(lambda piece: _keep(source, piece, folder, client), part):
                done += 1
                progress(done, len(plan.pieces))
    known = assemble(source, plan, folder, out)
    if known < _LEAST_KNOWN:
        out.unlink(missing_ok=True)
        raise MapFetchError(
            f"{source.name}: has only {100 * known:.0f} % of the area; name another source"
        )
    return known


def _keep(source: CatalogueSource, piece: Piece, folder: Path, client: HttpClient) -> None:
    """Download a piece and write its file when it is complete; an empty file means "no data"."""
    data = piece.get(client)
    if data is not None:
        check_piece(source, piece, data)
    path = folder / piece.name
    partial = folder / f".{piece.name}.part"
    partial.write_bytes(data or b"")
    os.replace(partial, path)


def _claim(source: CatalogueSource, plan: FetchPlan, folder: Path) -> None:
    """Mark the folder as this plan's; pieces of another plan are removed."""
    told = {
        "source": source.model_dump(mode="json"), "crs": plan.grid.crs.to_wkt(),
        "left": plan.grid.left, "top": plan.grid.top, "pixel": plan.grid.pixel,
        "size": [plan.grid.width, plan.grid.height], "pieces": [p.name for p in plan.pieces],
    }  # fmt: skip
    key = hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()
    mark = folder / "plan.sha256"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not mark.exists() or mark.read_text() != key:
            for path in folder.iterdir():
                path.unlink()
            mark.write_text(key)
    except OSError as error:
        raise MapFetchError(f"{folder}: cannot be used: {error}") from error
