"""Fetches imagery by tiles (XYZ, TMS, WMTS) or rectangles, and heights (WMS, WCS)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any
from urllib.parse import quote, urlencode, urlsplit, urlunsplit
from xml.etree.ElementTree import Element, ParseError

from pyproj import CRS
from pyproj.exceptions import CRSError

from localizer.errors import MapFetchError
from localizer.map.fetch.area import Area
from localizer.map.fetch.catalogue import CatalogueSource, require_allowed
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


_BYTES = 0.4  # a pixel, of a photograph as JPEG
_HALF_M = 20_037_508.342789244  # of the square of Web Mercator
_PIXEL_M = 0.28e-3  # of OGC 07-057r7: what a scale denominator counts in
_GAP = (204, 400, 404)  # of a tile that is not there
_SLACK = 1.3  # a level may be that much coarser than wished: the next has four times the pixels


@dataclass(frozen=True)
class Level:
    """One zoom level. left, top: of the first tile; pixel: CRS units; address: URL with {column}
    and {row}, rows from the north.
    """

    crs: CRS
    left: float
    top: float
    pixel: float
    side: tuple[int, int]
    count: tuple[int, int]
    address: str
    south_first: bool = False


def plan_tiles(
    source: CatalogueSource, area: Area, resolution_m: float, client: HttpClient
) -> FetchPlan:
    """Plan the tiles over an area, at about the requested resolution. `MapFetchError` if the source
    has none there.
    """
    if source.kind == "wmts":
        level = _wmts_level(source, area, resolution_m, client)
    else:
        level = _mercator_level(source, area, resolution_m)
    grid = grid_over(
        area.bounds_in(level.crs), (level.pixel, level.pixel), level.crs, (level.left, level.top)
    )
    width, height = level.side
    column = round((grid.left - level.left) / level.pixel)
    row = round((level.top - grid.top) / level.pixel)
    first = max(column // width, 0), max(row // height, 0)
    last = (
        min((column + grid.width - 1) // width, level.count[0] - 1),
        min((row + grid.height - 1) // height, level.count[1] - 1),
    )
    if last[0] < first[0] or last[1] < first[1]:
        raise MapFetchError(f"{source.name}: has no tiles at {area}")
    split_grid(grid, min(width, height))  # within the limits
    pieces = []
    for tile_row in range(first[1], last[1] + 1):
        for tile in range(first[0], last[0] + 1):
            told = level.count[1] - 1 - tile_row if level.south_first else tile_row
            url = level.address.replace("{column}", str(tile)).replace("{row}", str(told))
            at = tile * width - column, tile_row * height - row
            get = partial(_tile, url)
            pieces.append(Piece(f"{tile}-{tile_row}", *at, width, height, get))
    return FetchPlan(grid, tuple(pieces), _BYTES, len(pieces))


def _mercator_level(source: CatalogueSource, area: Area, resolution_m: float) -> Level:
    crs, side = CRS.from_epsg(3857), source.tile_px
    coarsest = 2 * _HALF_M / side * metres_per_unit(crs, area.centre[0])[0]
    zoom = math.ceil(math.log2(max(coarsest / (_SLACK * resolution_m), 1.0)))
    zoom = min(zoom, source.most_zoom)
    address = source.url.replace("{z}", str(zoom))
    address = address.replace("{x}", "{column}").replace("{y}", "{row}")
    pixel = 2 * _HALF_M / side / 2**zoom
    count = 2**zoom, 2**zoom
    south_first = source.kind == "tms"
    return Level(crs, -_HALF_M, _HALF_M, pixel, (side, side), count, address, south_first)


def _wmts_level(
    source: CatalogueSource, area: Area, resolution_m: float, client: HttpClient
) -> Level:
    service = _capabilities(source, client)
    layer = service.contents.get(source.layer)
    if layer is None:
        known = ", ".join(sorted(service.contents)[:10])
        raise MapFetchError(f"{source.name}: has no layer {source.layer}, but {known}")
    name, crs = _matrix_set(source, service, layer)
    per_unit = metres_per_unit(crs, area.centre[0])[0]
    # A scale denominator counts in metres of the CRS, stretched ones too.
    unit_m = 111_319.49079327358 if crs.is_geographic else crs.axis_info[0].unit_conversion_factor
    matrices = sorted(
        service.tilematrixsets[name].tilematrix.values(), key=lambda m: -m.scaledenominator
    )
    chosen = matrices[-1]
    for matrix in matrices:
        if matrix.scaledenominator * _PIXEL_M / unit_m * per_unit <= _SLACK * resolution_m:
            chosen = matrix
            break
    left, top = chosen.topleftcorner[::-1] if north_first(crs) else chosen.topleftcorner
    return Level(
        crs, left, top, chosen.scaledenominator * _PIXEL_M / unit_m,
        (chosen.tilewidth, chosen.tileheight), (chosen.matrixwidth, chosen.matrixheight),
        _wmts_address(source, service, layer, name, chosen.identifier),
    )  # fmt: skip


def _capabilities(source: CatalogueSource, client: HttpClient) -> Any:
    try:
        from owslib.wmts import WebMapTileService
    except ImportError as error:
        raise MapFetchError("WMTS needs OWSLib: pip install -e '.[fetch]' in a checkout") from error

    url = source.url
    if not url.lower().endswith(".xml") and "request=" not in url.lower():
        parameters = {"SERVICE": "WMTS", "REQUEST": "GetCapabilities", "VERSION": "1.0.0"}
        url += ("&" if "?" in url else "?") + urlencode(parameters)
    data = client.get(url).data
    try:
        parse_xml(data)  # refused before another parser sees it, if it brings entities
        return WebMapTileService(url, xml=data)
    except (ParseError, AttributeError, KeyError, ValueError, TypeError) as error:
        raise MapFetchError(
            f"{safe_url(url)}: no capabilities of a WMTS: {message_text(data)}"
        ) from error


def _matrix_set(source: CatalogueSource, service: Any, layer: Any) -> tuple[str, CRS]:
    known = {}
    for name in layer.tilematrixsetlinks:
        if name in service.tilematrixsets:
            try:
                known[name] = CRS(service.tilematrixsets[name].crs)
            except CRSError:
                continue
    if source.matrix_set:
        if source.matrix_set in known:
            return source.matrix_set, known[source.matrix_set]
        raise MapFetchError(f"{source.name}: no matrix set {source.matrix_set}, but {list(known)}")
    wanted = CRS(source.crs)
    for name, crs in known.items():
        if crs == wanted or crs.to_epsg() == wanted.to_epsg():
            return name, crs
    raise MapFetchError(
        f"{source.name}: no matrix set of {source.layer} in {source.crs}; set matrix_set or crs: "
        f"{', '.join(f'{name} ({crs.name})' for name, crs in known.items())}"
    )


def _wmts_address(
    source: CatalogueSource, service: Any, layer: Any, matrix_set: str, matrix: str
) -> str:
    style = source.style or next(
        (name for name, style in layer.styles.items() if style.get("isDefault")),
        next(iter(layer.styles), "default"),
    )
    style = style or "default"
    tiled = [r for r in layer.resourceURLs if r.get("resourceType") == "tile"]
    wanted = source.format or "image/jpeg"
    tiled.sort(key=lambda r: r.get("format") != wanted)
    if tiled:
        address = str(tiled[0]["template"])
        given = {
            "TileMatrixSet": matrix_set, "TileMatrix": matrix, "Style": style,
            "Layer": source.layer,
        }  # fmt: skip
        given |= {name: str(d.get("default")) for name, d in layer.dimensions.items()}
        for name, value in given.items():
            for spelt in (name, name.lower()):
                address = address.replace(f"{{{spelt}}}", quote(value, safe=":"))
        address = address.replace("{TileRow}", "{row}").replace("{TileCol}", "{column}")
    else:
        formats = layer.formats or [wanted]
        parameters = {
            "SERVICE": "WMTS", "REQUEST": "GetTile", "VERSION": "1.0.0", "LAYER": source.layer,
            "STYLE": style, "TILEMATRIXSET": matrix_set, "TILEMATRIX": matrix,
            "FORMAT": wanted if wanted in formats else formats[0],
        }  # fmt: skip
        base = source.url.split("?")[0]
        for method in _get_tile_methods(service):
            base = str(method).rstrip("?&")
        joint = "&" if "?" in base else "?"
        address = f"{base}{joint}{urlencode(parameters)}&TILEROW={{row}}&TILECOL={{column}}"
    require_allowed(address.replace("{", "").replace("}", ""))
    return address


def _get_tile_methods(service: Any) -> list[str]:
    for operation in getattr(service, "operations", ()):
        if operation.name == "GetTile":
            return [m["url"] for m in operation.methods if m.get("type", "").lower() == "get"][:1]
    return []


def _tile(url: str, client: HttpClient) -> bytes | None:
    answer = client.get(url, missing=_GAP)
    if answer.status in _GAP or not answer.data:
        return None
    if "xml" in answer.kind or "html" in answer.kind:
        raise MapFetchError(f"{safe_url(url)}: refused: {message_text(answer.data)}")
    return answer.data
