"""Options of a cache build."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from localizer.geometry.geo import Geodetic
from localizer.map.importers.georeference import Georeference, UpAxis
from localizer.map.importers.rules import ImportRules
from localizer.map.kind import Heights
from localizer.map.source import VerticalDatum


@dataclass(frozen=True)
class BuildOptions:
    """Options of an import. None: as the source states.

    geoid_separation_m: geoid above the ellipsoid; None: the source's, otherwise EGM96's.
    vertical_datum: datum of the source's heights, needed if neither format nor CRS states it;
    "amsl" heights are lifted by the separation.

    georeference: of a mesh, see `read_georeference`. up_axis: of a mesh or a tileset,
    see `mesh_tree` and `read_tileset`. height_unit, nodata:
    of a DSM, see `read_rasters`. origin: of the world frame; None: the source's centre.
    imagery_date: 2024, 2024-06 or 2024-06-30. sensor: of the imagery. heights: what they contain;
    None: measured (`MapKind`).

    skip_bad_tiles: skip tiles that cannot be imported; their parents are shown. overwrite: replace
    a cache of another source or other options. rules: limits, and accepted doubts.

    workers: processes; None: one per core. More than one needs the ``if __name__ == "__main__"``
    guard. apart: read the source in processes with memory and time limits; None: unless workers
    is 1. scheduler: address of a Dask scheduler whose workers share the file system.
    """

    geoid_separation_m: float | None = None
    vertical_datum: VerticalDatum | None = None
    georeference: Georeference | Path | None = None
    up_axis: UpAxis | None = None
    height_unit: str | None = None
    nodata: float | None = None
    origin: Geodetic | None = None
    attribution: str | None = None
    imagery_date: str | None = None
    sensor: str | None = None
    heights: Heights | None = None
    skip_bad_tiles: bool = False
    overwrite: bool = False
    workers: int | None = None
    apart: bool | None = None
    scheduler: str | None = None
    rules: ImportRules = field(default_factory=ImportRules)

    @property
    def is_apart(self) -> bool:
        """Whether the source is read in processes with limits."""
        return self.workers != 1 if self.apart is None else self.apart
