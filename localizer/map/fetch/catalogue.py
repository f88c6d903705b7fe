"""Catalogue of map services: what each has, where, resolution, licence; and forbidden services."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pyproj import CRS
from pyproj.exceptions import CRSError

from localizer.errors import MapFetchError
from localizer.map.fetch.area import Area
from localizer.map.source import VerticalDatum
from localizer.plain_files import as_text, load_yaml

# Host (and all below it): whose it is, and what its terms say.
_FORBIDDEN = {
    "google.com": "Google's terms forbid to store, cut and derive from its map content",
    "googleapis.com": "Google's terms forbid to store, cut and derive from its map content",
    "gstatic.com": "Google's terms forbid to store, cut and derive from its map content",
    "googleusercontent.com": "Google's terms forbid to store its map content",
    "bing.com": "Microsoft's terms forbid to store Bing Maps' imagery",
    "virtualearth.net": "Microsoft's terms forbid to store Bing Maps' imagery",
    "apple.com": "Apple's terms forbid to store its map content",
    "apple-mapkit.com": "Apple's terms forbid to store its map content",
    "mapbox.com": "Mapbox's terms forbid to store its tiles outside its own programs",
    "arcgisonline.com": "Esri's basemaps may be kept by ArcGIS's own programs only",
    "here.com": "HERE's terms forbid to store its tiles",
    "hereapi.com": "HERE's terms forbid to store its tiles",
    "openstreetmap.org": "OpenStreetMap's tile servers do not serve bulk downloads",
    "yandex.net": "Yandex's terms forbid to store its tiles",
}
# Google publishes data of others under open licences in its cloud's storage.
_ALLOWED = ("storage.googleapis.com",)


def require_allowed(url: str) -> None:
    """`MapFetchError` for a forbidden service or an invalid URL."""
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise MapFetchError(f"{url}: no address of http or https")
    host = parts.hostname.lower().rstrip(".")
    if host in _ALLOWED:
        return
    labels = host.split(".")
    for i in range(len(labels)):
        why = _FORBIDDEN.get(".".join(labels[i:]))
        # Google's and Bing's names of every country: google.de, maps.google.co.uk.
        country = labels[i + 1 :]
        if labels[i] in ("google", "bing") and country and all(len(c) <= 3 for c in country):
            why = _FORBIDDEN[f"{labels[i]}.com"]
        if why is not None:
            raise MapFetchError(f"{host}: refused: {why}; name a source whose licence allows it")


Kind = Literal["wms", "wmts", "wcs", "xyz", "tms", "cog", "stac"]
Role = Literal["imagery", "surface", "terrain"]
SHIPPED = Path(__file__).with_name("sources.yaml")
_MOST_BYTES = 1 << 20


class CatalogueSource(BaseModel):
    """One map service. Unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    name: str = Field(
        pattern=r"^[a-z0-9][a-z0-9-]{1,60}$", description="name in --imagery, --heights"
    )
    title: str = Field(description="description for the list of sources")
    kind: Kind = Field(description="protocol")
    role: Role = Field(description="imagery, surface (with roofs and trees) or terrain (without)")
    url: str = Field(
        description="address; xyz and tms with {z} {x} {y}; cog may have {lat} and {lon}, the "
        "south-west corner of a degree as N47 and E008; stac a catalogue's file or an API"
    )
    licence: str = Field(min_length=3, description="name of the licence, and its address")
    attribution: str = Field(min_length=2, description="attribution; stored in the map")
    country: str = Field(min_length=2, max_length=60, description="country or region")
    bounds: tuple[float, float, float, float] = Field(
        description="west, south, east, north, degrees"
    )
    resolution_m: float = Field(gt=0.01, le=1000, description="metres a pixel of the finest data")
    layer: str = Field("", description="layer (wms, wmts), coverage (wcs), collection (stac)")
    style: str = Field("", description="of wms and wmts; empty: the default of the service")
    crs: str = Field("EPSG:3857", description="coordinate system of wms and wcs requests")
    format: str = Field("", description="requested MIME type; empty: JPEG, GeoTIFF for heights")
    version: str = Field("", description="of the protocol; empty: wms 1.3.0, wcs 2.0.1")
    axes: tuple[str, str] | None = Field(
        None, description="of wcs 2.0.1: names of easting and northing; null: read from the service"
    )
    matrix_set: str = Field("", description="of wmts; empty: the first in EPSG:3857")
    asset: str = Field(
        "", description="of stac: key of the asset, * for any text; empty: the first GeoTIFF"
    )
    most_zoom: int = Field(19, ge=0, le=24, description="finest zoom level of xyz and tms")
    tile_px: int = Field(256, ge=64, le=4096, description="side of a tile, of xyz and tms")
    piece_px: int = Field(1024, ge=64, le=8192, description="side of one request, pixels")
    vertical_datum: VerticalDatum | None = Field(None, description="of heights")
    nodata: float | None = Field(
        None, description="value of missing heights, if the file does not state it"
    )
    date: str | None = Field(None, description="date of the images: 2024, 2024-06 or 2024-06-30")
    rate_per_s: float = Field(4.0, gt=0, le=50, description="requests a second, at most")
    parallel: int = Field(4, ge=1, le=8, description="simultaneous requests, at most")

    @model_validator(mode="after")
    def _holds(self) -> CatalogueSource:
        west, south, east, north = self.bounds
        if not (-180 <= west < east <= 180 and -90 <= south < north <= 90):
            raise ValueError("bounds: west, south, east, north in degrees")
        if (self.role == "imagery") == (self.vertical_datum is not None):
            raise ValueError("vertical_datum: needed for heights, and for nothing else")
        if self.kind in ("wms", "wmts", "wcs") and not self.layer:
            raise ValueError(f"layer: {self.kind} needs it")
        if self.kind in ("xyz", "tms"):
            if not all(part in self.url for part in ("{z}", "{x}", "{y}")):
                raise ValueError("url: {z}, {x} and {y} stand in it")
            if self.role != "imagery":
                raise ValueError(f"role: {self.kind} gives imagery only")
        try:
            CRS(self.crs)
        except CRSError as error:
            raise ValueError(f"crs: {self.crs} is not known") from error
        return self

    @property
    def has_heights(self) -> bool:
        """Whether it has heights (not imagery)."""
        return self.role != "imagery"

    @property
    def area_deg2(self) -> float:
        """Area of its bounds; `choose` prefers small ones (national services) by it."""
        west, south, east, north = self.bounds
        return (east - west) * (north - south)


def load_sources(more: tuple[Path, ...] = ()) -> tuple[CatalogueSource, ...]:
    """Sources of the shipped file and of other files, which replace those of the same name.
    `MapFetchError` for invalid or forbidden ones.
    """
    found: dict[str, CatalogueSource] = {}
    for path in (SHIPPED, *more):
        for entry in _entries(path):
            try:
                source = CatalogueSource.model_validate(entry)
            except ValidationError as error:
                first = error.errors()[0]
                where = ".".join(str(part) for part in first["loc"])
                name = entry.get("name", "?") if isinstance(entry, dict) else "?"
                told = f"{where}: {first['msg']}" if where else first["msg"]
                raise MapFetchError(f"{path}: source {name}: {told}") from error
            require_allowed(source.url.replace("{", "").replace("}", ""))
            found[source.name] = source
    return tuple(found.values())


def _entries(path: Path) -> list[Any]:
    try:
        text = path.read_bytes()
        if len(text) > _MOST_BYTES:
            raise MapFetchError(f"{path}: over {_MOST_BYTES >> 20} MiB; that is no file of sources")
        document = load_yaml(as_text(text))
    except (OSError, ValueError, yaml.YAMLError, RecursionError) as error:
        raise MapFetchError(f"{path}: cannot be read: {error}") from error
    entries = document.get("sources") if isinstance(document, dict) else None
    if not isinstance(entries, list):
        raise MapFetchError(f"{path}: a list `sources` is expected")
    return entries


def choose(
    sources: tuple[CatalogueSource, ...], area: Area, role: str, name: str | None = None
) -> CatalogueSource:
    """The source `name`, which need not cover the whole area; None: the best that covers it: one of
    10 m or finer before coarser ones, surface before terrain models, then the finest, then that of
    the smallest bounds. role: imagery or heights. `MapFetchError` if there is none.
    """
    fitting = [s for s in sources if s.has_heights == (role == "heights")]
    if name is not None:
        for source in fitting:
            if source.name == name:
                if not area.meets(source.bounds):
                    raise MapFetchError(f"{name} has nothing at {area}")
                return source
        known = ", ".join(sorted(s.name for s in fitting))
        raise MapFetchError(f"no source of {role} is called {name}; there are: {known}")
    there = [s for s in fitting if area.within(s.bounds)]
    if not there:
        raise MapFetchError(
            f"no source of {role} covers {area}: name one in a YAML file (--sources; keys in "
            f"{SHIPPED.name} of the package), or bring your own GeoTIFF (`companion map build`)"
        )
    order = {"imagery": 0, "surface": 0, "terrain": 1}
    return min(there, key=lambda s: (math.ceil(math.log10(s.resolution_m / 10)) > 0,
                                     order[s.role], s.resolution_m, s.area_deg2))  # fmt: skip
