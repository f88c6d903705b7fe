"""WMS and WCS: imagery or heights of a rectangle, requested block by block."""

from __future__ import annotations

from functools import partial
from urllib.parse import urlencode, urlsplit, urlunsplit
from xml.etree.ElementTree import Element, ParseError

from pyproj import CRS

from localizer.errors import MapFetchError
from localizer.map.fetch.area import Area
from localizer.map.fetch.catalogue import CatalogueSource
from localizer.map.fetch.http_client import HttpClient, message_text, parse_xml, safe_url
from localizer.map.fetch.raster import (
    FetchGrid,
    FetchPlan,
    Piece,
    grid_over,
    metres_per_unit,
    north_first,
    split_grid,
)

_JPEG_BYTES, _HEIGHT_BYTES = 0.4, 4.0
_MARGIN = 2  # pixels of a coverage that is cut by its own grid, so that no seam stays


def plan_blocks(
    source: CatalogueSource, area: Area, resolution_m: float, client: HttpClient
) -> FetchPlan:
    """WMS GetMap or WCS GetCoverage for each block of a grid in the source's CRS."""
    crs = CRS(source.crs)
    per_unit = metres_per_unit(crs, area.centre[0])
    pixel = resolution_m / per_unit[0], resolution_m / per_unit[1]
    grid = grid_over(area.bounds_in(crs), pixel, crs)
    axes = _axes(source, client) if source.kind == "wcs" else ("", "")
    pieces = []
    for column, row, width, height in split_grid(grid, source.piece_px):
        window = grid.window(column, row, width, height)
        if source.kind == "wms":
            url = wms_url(source, window)
        elif source.version.startswith("1."):
            url = wcs_1_url(source, window)
        else:
            url = wcs_2_url(source, window, axes)
        get = partial(_image, url)
        placed = source.kind == "wcs"
        pieces.append(Piece(f"{column}-{row}", column, row, width, height, get, placed))
    size = _HEIGHT_BYTES if source.has_heights else _JPEG_BYTES
    return FetchPlan(grid, tuple(pieces), size, len(pieces))


def wms_url(source: CatalogueSource, window: FetchGrid) -> str:
    """URL of GetMap (OGC 06-042). Version 1.3.0 uses the CRS's own axis order."""
    version = source.version or "1.3.0"
    left, bottom, right, top = window.bounds
    bounds = (left, bottom, right, top)
    if version == "1.3.0" and north_first(window.crs):
        bounds = (bottom, left, top, right)
    return _with(
        source.url,
        {
            "SERVICE": "WMS", "VERSION": version, "REQUEST": "GetMap", "LAYERS": source.layer,
            "STYLES": source.style, "CRS" if version == "1.3.0" else "SRS": source.crs,
            # The picture says no place of its own: 9 digits were 6 cm off at 151 degrees east.
            "BBOX": ",".join(f"{v:.9f}" if abs(v) < 1e3 else f"{v:.4f}" for v in bounds),
            "WIDTH": str(window.width), "HEIGHT": str(window.height),
            "FORMAT": source.format or ("image/tiff" if source.has_heights else "image/jpeg"),
        },
    )  # fmt: skip


def wcs_1_url(source: CatalogueSource, window: FetchGrid) -> str:
    """URL of GetCoverage 1.0.0 (OGC 03-065r6): a rectangle, east first, and its pixel size."""
    bounds = ",".join(f"{v:.10g}" for v in window.bounds)
    return _with(
        source.url,
        {
            "SERVICE": "WCS", "VERSION": source.version, "REQUEST": "GetCoverage",
            "COVERAGE": source.layer, "CRS": source.crs, "BBOX": bounds,
            "WIDTH": str(window.width), "HEIGHT": str(window.height),
            "FORMAT": source.format or "image/tiff",
        },
    )  # fmt: skip


def wcs_2_url(source: CatalogueSource, window: FetchGrid, axes: tuple[str, str]) -> str:
    """URL of GetCoverage 2.0.1 (OGC 09-147r3): at its native resolution, with a margin."""
    left, bottom, right, top = window.bounds
    east, south = (_MARGIN * p for p in window.pixel)
    url = _with(
        source.url,
        {
            "SERVICE": "WCS", "VERSION": source.version or "2.0.1", "REQUEST": "GetCoverage",
            "COVERAGEID": source.layer, "FORMAT": source.format or "image/tiff",
        },
    )  # fmt: skip
    subsets = (
        (axes[0], left - east, right + east),
        (axes[1], bottom - south, top + south),
    )
    return url + "".join(f"&SUBSET={n}({low:.10g},{high:.10g})" for n, low, high in subsets)


def _axes(source: CatalogueSource, client: HttpClient) -> tuple[str, str]:
    """Names of the coverage's easting and northing axes, from the catalogue or the service."""
    if source.axes is not None or source.version.startswith("1."):
        return source.axes or ("", "")
    url = _with(
        source.url,
        {
            "SERVICE": "WCS", "VERSION": source.version or "2.0.1",
            "REQUEST": "DescribeCoverage", "COVERAGEID": source.layer,
        },
    )  # fmt: skip
    root = _document(client, url)
    for element in root.iter():
        labels = element.get("axisLabels", "").split()
        if element.tag.endswith("}Envelope") and len(labels) >= 2:
            lowered = [label.lower() for label in labels[:2]]
            swapped = lowered[0] in ("lat", "latitude", "n", "y", "northing")
            return (labels[1], labels[0]) if swapped else (labels[0], labels[1])
    raise MapFetchError(f"{safe_url(url)}: does not name the axes of {source.layer}; set `axes`")


def _document(client: HttpClient, url: str) -> Element:
    try:
        return parse_xml(client.get(url).data)
    except ParseError as error:
        raise MapFetchError(f"{safe_url(url)}: no XML: {error}") from error


def _image(url: str, client: HttpClient) -> bytes:
    answer = client.get(url)
    if "xml" in answer.kind or "html" in answer.kind or answer.kind == "text/plain":
        raise MapFetchError(f"{safe_url(url)}: refused: {message_text(answer.data)}")
    return answer.data


def _with(url: str, parameters: dict[str, str]) -> str:
    """The URL with further query parameters."""
    parts = urlsplit(url)
    query = "&".join(p for p in (parts.query.strip("&"), urlencode(parameters)) if p)
    return urlunsplit((parts.scheme, parts.netloc, parts.path, query, ""))
