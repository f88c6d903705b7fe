"""What a build of a cache may be told, beyond its source and its place."""

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
    """How a source becomes a cache; None stands for what the source itself says.

    geoid_separation_m: height of the geoid above the ellipsoid at the map (MAVLink altitudes are
    above the geoid), else the source's own, else EGM96's. vertical_datum: what the source's heights
    are; "amsl" ones are lifted by the separation; needed unless the source's format or CRS says it.

    georeference, up_axis: of a mesh, see `read_georeference` and `mesh_tree`. height_unit, nodata:
    of a DSM, see `read_rasters`. origin: of the world frame, else the source's centre. attribution:
    whose data it is; imagery_date: of its pictures, as 2024, 2024-06 or 2024-06-30; sensor: that
    took them; heights: what they hold, else measured (`MapKind`).

    skip_bad_tiles: leave out tiles that cannot be imported (their parents are shown there) instead
    of failing. overwrite: replace a cache of another source or of other options. rules: what a
    source may ask for, and which doubts about it are meant.

    workers: processes, else one per core; more than one needs the usual
    ``if __name__ == "__main__"`` guard in a script. apart: read the source in processes with limits
    of memory and time, else unless workers is 1. scheduler: address of a Dask scheduler whose
    workers share the file system, instead of local processes.
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
