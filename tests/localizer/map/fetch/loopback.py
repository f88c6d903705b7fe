"""A small world on disk, and servers of it on loopback: files by ranges, tiles, MapServer.

Nothing here or in the tests goes beyond this machine.
"""

from __future__ import annotations

import json
import os
import subprocess
import threading
import time
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlencode, urlsplit

import cv2
import numpy as np
import rasterio
from pyproj import Transformer
from rasterio.transform import from_origin
from rasterio.warp import Resampling, reproject

CRS = "EPSG:32632"
LEFT, TOP = 462_000.0, 5_250_400.0
SIDE_M = 400
STEP_M, TEXEL_M = 1.0, 0.5
MAPSERV = "/usr/lib/cgi-bin/mapserv"


def height_m(east, north):
    """Above the geoid, of a place in the world's CRS."""
    x, y = np.asarray(east) - LEFT, TOP - np.asarray(north)
    return 430.0 + 12.0 * np.sin(x / 60.0) + 0.04 * y


def colour(east, north):
    """(..., 3) uint8: squares of 25 m, and a slope in each channel."""
    x, y = np.asarray(east) - LEFT, TOP - np.asarray(north)
    square = ((x // 25 + y // 25) % 2) * 70.0
    return np.stack([40 + x / 4 + square, 40 + y / 4 + square, 120 + square], -1).astype(np.uint8)


def places(step_m):
    """East and north of the pixels' centres, north first."""
    at = (np.arange(round(SIDE_M / step_m)) + 0.5) * step_m
    return np.meshgrid(LEFT + at, TOP - at)


def geographic(east, north):
    """Latitude and longitude, degrees."""
    lon, lat = Transformer.from_crs(CRS, 4326, always_xy=True).transform(east, north)
    return lat, lon


def rectangle(margin_m=60.0):
    """West, south, east, north inside the world."""
    reach = SIDE_M - margin_m
    south, west = geographic(LEFT + margin_m, TOP - reach)
    north, east = geographic(LEFT + reach, TOP - margin_m)
    return west, south, east, north


def write_world(folder: Path):
    """surface.tif and ortho.tif as cloud-optimised GeoTIFFs, and tiles in Web Mercator."""
    heights = height_m(*places(STEP_M)).astype(np.float32)[None]
    picture = np.moveaxis(colour(*places(TEXEL_M)), -1, 0)
    for name, data, step in (("surface", heights, STEP_M), ("ortho", picture, TEXEL_M)):
        with rasterio.open(
            folder / f"{name}.tif", "w", driver="COG", crs=CRS, dtype=data.dtype,
            transform=from_origin(LEFT, TOP, step, step), count=len(data),
            width=data.shape[2], height=data.shape[1], blocksize=128, compress="deflate",
        ) as file:  # fmt: skip
            file.write(data)
    return folder


def tile(folder: Path, zoom: int, x: int, y: int) -> bytes | None:
    """An XYZ tile of the orthophoto as PNG; None beside it."""
    half, count = 20_037_508.342789244, 2**zoom
    span = 2 * half / count
    transform = from_origin(-half + x * span, half - y * span, span / 256, span / 256)
    out = np.zeros((3, 256, 256), np.uint8)
    with rasterio.open(folder / "ortho.tif") as data:
        reproject(
            data.read(), out, src_transform=data.transform, src_crs=data.crs,
            dst_transform=transform, dst_crs="EPSG:3857", resampling=Resampling.bilinear,
        )  # fmt: skip
    if not out.any():
        return None
    return cv2.imencode(".png", cv2.cvtColor(np.moveaxis(out, 0, -1), cv2.COLOR_RGB2BGR))[
        1
    ].tobytes()


class SearchedCatalogue:
    """A STAC API of `write_stac`'s items and many more, one a page. methods: by which it can be
    searched; endless: its pages never end.
    """

    def __init__(self) -> None:
        self.items: list[dict[str, Any]] = []
        self.methods: tuple[str, ...] = ("GET", "POST")
        self.endless = False

    def answer(
        self, url: str, path: str, query: dict[str, str] | None, posted: Any
    ) -> dict[str, Any] | None:
        """Of the landing page and of its search; None where the method is not offered."""
        if path == "/api":
            offered = [{"rel": "search", "href": f"{url}/api/search", "method": m}
                       for m in self.methods]  # fmt: skip
            return {"type": "Catalog", "stac_version": "1.0.0", "id": "api", "links": offered}
        if ("POST" if query is None else "GET") not in self.methods:
            return None
        asked = posted if query is None else query
        box = asked["bbox"] if query is None else [float(v) for v in query["bbox"].split(",")]
        layers: Any = asked.get("collections", [])
        found = [
            item for item in self.items
            if (not layers or item["collection"] in layers)
            and item["bbox"][0] < box[2] and item["bbox"][2] > box[0]
            and item["bbox"][1] < box[3] and item["bbox"][3] > box[1]
        ]  # fmt: skip
        at = int(asked.get("token", 0))
        links: list[dict[str, Any]] = []
        if at + 1 < len(found) or self.endless:
            token = (at + 1) % len(found)
            if query is None:
                links.append({"rel": "next", "href": f"{url}/api/search", "method": "POST",
                              "merge": True, "body": {"token": token}})  # fmt: skip
            else:
                more = urlencode(query | {"token": token})
                links.append({"rel": "next", "href": f"{url}/api/search?{more}"})
        return {"type": "FeatureCollection", "features": found[at : at + 1], "links": links}


class Served:
    """What a server was asked, and how it shall behave. broken: answers of the next requests
    instead of their own: a status, with headers.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.asked: list[str] = []
        self.ranges: list[str] = []
        self.times: list[float] = []
        self.broken: list[tuple[int, dict[str, str]]] = []
        self.ranged = True
        self.bytes = 0
        self.port = 0
        self.catalogue = SearchedCatalogue()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"


class _QuietServer(ThreadingHTTPServer):
    """A client may leave after its test, in any other test. To print that traceback, CPython 3.11
    parses source code, and then a parse in the other test's thread fails.
    """

    def handle_error(self, request: object, client_address: object) -> None:
        """Nothing: a client that left is no error of a test."""


@contextmanager
def serving(folder: Path):
    """The folder, its tiles and MapServer over its map file."""
    served = Served(folder)

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *_: object) -> None: ...

        def do_GET(self) -> None:
            served.asked.append(self.path)
            served.times.append(time.monotonic())
            if served.broken:
                status, headers = served.broken.pop(0)
                self._send(status, b"busy", headers)
                return
            parts = urlsplit(self.path)
            if parts.path == "/mapserv":
                self._mapserver(parts.query)
            elif parts.path.startswith(("/tiles/", "/tms/")):
                self._tile(parts.path)
            elif parts.path.startswith("/api"):
                self._search(parts.path, dict(parse_qsl(parts.query)))
            else:
                self._file(parts.path)

        def do_POST(self) -> None:
            served.asked.append(self.path)
            length = int(self.headers["Content-Length"])
            self._search(urlsplit(self.path).path, None, json.loads(self.rfile.read(length)))

        def _search(self, path: str, query: dict[str, str] | None, posted: Any = None) -> None:
            document = served.catalogue.answer(served.url, path, query, posted)
            self._send(405 if document is None else 200, json.dumps(document or {}).encode())

        def _mapserver(self, query: str) -> None:
            environment = os.environ | {
                "REQUEST_METHOD": "GET", "QUERY_STRING": query,
                "MS_MAPFILE": str(served.folder / "world.map"),
                "MAPSERVER_CONFIG_FILE": str(served.folder / "mapserver.conf"),
            }  # fmt: skip
            done = subprocess.run([MAPSERV], env=environment, capture_output=True, check=False)
            head, _, body = done.stdout.partition(b"\r\n\r\n")
            kind = "text/plain"
            for line in head.decode("latin-1").splitlines():
                name, _, value = line.partition(":")
                kind = value.strip() if name.lower() == "content-type" else kind
            self._send(200, body, {"Content-Type": kind})

        def _tile(self, path: str) -> None:
            kind, z, x, y = path.strip("/").removesuffix(".png").split("/")
            zoom, row = int(z), int(y)
            row = 2**zoom - 1 - row if kind == "tms" else row
            data = tile(served.folder, zoom, int(x), row)
            self._send(404 if data is None else 200, data or b"", {"Content-Type": "image/png"})

        def _file(self, path: str) -> None:
            file = served.folder / path.strip("/")
            if not file.is_file():
                self._send(404, b"no such file")
                return
            data, asked = file.read_bytes(), self.headers.get("Range")
            if asked is None or not served.ranged:
                self._send(200, data)
                return
            served.ranges.append(asked)
            first, last = asked.removeprefix("bytes=").split("-")
            part = data[int(first) : int(last) + 1]
            told = {"Content-Range": f"bytes {first}-{int(first) + len(part) - 1}/{len(data)}"}
            self._send(206, part, told)

        def _send(self, status: int, data: bytes, headers: dict[str, str] | None = None) -> None:
            served.bytes += len(data)
            self.send_response(status)
            for name, value in (headers or {}).items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

    server = _QuietServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    served.port = server.server_port
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield served
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def write_map_file(folder: Path, url: str) -> None:
    """MapServer's: WMS and WCS of the two rasters."""
    (folder / "mapserver.conf").write_text(
        'CONFIG\n ENV\n MS_MAP_PATTERN "."\n PROJ_LIB "/usr/share/proj"\n END\nEND\n'
    )
    layers = "".join(
        f"""
  LAYER
    NAME "{name}"
    TYPE RASTER
    STATUS ON
    DATA "{folder / f"{name}.tif"}"
    PROJECTION "init=epsg:32632" END
    {'PROCESSING "RESAMPLE=BILINEAR"' if name == "ortho" else ""}
    METADATA
      "wms_title" "{name}" "wms_enable_request" "*"
      "wcs_label" "{name}" "wcs_enable_request" "*" "wcs_rangeset_name" "bands"
      "wcs_rangeset_label" "bands" "wcs_formats" "GTIFF32" "wcs_size" "400 400"
      "wcs_extent" "{LEFT} {TOP - SIDE_M} {LEFT + SIDE_M} {TOP}" "wcs_resolution" "1 1"
      "wcs_native_format" "image/tiff" "wcs_imagemode" "FLOAT32" "wcs_bandcount" "1"
    END
  END"""
        for name in ("ortho", "surface")
    )
    (folder / "world.map").write_text(
        f"""MAP
  NAME "world"
  EXTENT {LEFT} {TOP - SIDE_M} {LEFT + SIDE_M} {TOP}
  SIZE 400 400
  MAXSIZE 4096
  PROJECTION "init=epsg:32632" END
  OUTPUTFORMAT NAME "GTIFF32" DRIVER "GDAL/GTiff" MIMETYPE "image/tiff" IMAGEMODE FLOAT32
    EXTENSION "tif" END
  OUTPUTFORMAT NAME "png" DRIVER "AGG/PNG" MIMETYPE "image/png" IMAGEMODE RGB END
  OUTPUTFORMAT NAME "jpeg" DRIVER "AGG/JPEG" MIMETYPE "image/jpeg" IMAGEMODE RGB
    FORMATOPTION "QUALITY=95" END
  WEB METADATA
    "ows_title" "world" "ows_onlineresource" "{url}/mapserv?" "ows_enable_request" "*"
    "ows_srs" "EPSG:32632 EPSG:4326 EPSG:3857 EPSG:25832"
  END END{layers}
END
"""
    )


def write_stac(folder: Path, url: str) -> list[dict[str, Any]]:
    """A static catalogue by pystac: a collection of the orthophoto here, one of it elsewhere.
    Returns its items.
    """
    import datetime

    import pystac

    west, south, east, north = rectangle(0.0)
    catalogue = pystac.Catalog("world", "a world on loopback")
    places_of = {"photos": (west, south, east, north), "elsewhere": (20.0, 10.0, 21.0, 11.0)}
    for name, box in places_of.items():
        extent = pystac.Extent(
            pystac.SpatialExtent([list(box)]),
            pystac.TemporalExtent([[datetime.datetime(2024, 6, 1), None]]),
        )
        collection = pystac.Collection(name, name, extent)
        for year in (2021, 2024):
            ring = [[box[0], box[1]], [box[2], box[1]], [box[2], box[3]], [box[0], box[3]]]
            item = pystac.Item(
                f"{name}-{year}", {"type": "Polygon", "coordinates": [[*ring, ring[0]]]},
                list(box), datetime.datetime(year, 6, 1), {},
            )  # fmt: skip
            file = "ortho.tif" if year == 2024 else "old.tif"
            item.add_asset("thumbnail", pystac.Asset(f"{url}/x.jpg", media_type="image/jpeg"))
            item.add_asset("visual", pystac.Asset(f"{url}/{file}", media_type=pystac.MediaType.COG))
            collection.add_item(item)
        catalogue.add_child(collection)
    catalogue.normalize_hrefs(f"{url}/stac")
    written = [item.to_dict() for item in catalogue.get_items(recursive=True)]
    catalogue.save(pystac.CatalogType.ABSOLUTE_PUBLISHED, dest_href=str(folder / "stac"))
    return written


def wmts_capabilities(url: str) -> str:
    """Of the tiles, by OGC 07-057r7."""
    matrices = "".join(
        f"""<TileMatrix><ows:Identifier>{z}</ows:Identifier>
        <ScaleDenominator>{559082264.0287178 / 2**z}</ScaleDenominator>
        <TopLeftCorner>-20037508.342789244 20037508.342789244</TopLeftCorner>
        <TileWidth>256</TileWidth><TileHeight>256</TileHeight>
        <MatrixWidth>{2**z}</MatrixWidth><MatrixHeight>{2**z}</MatrixHeight></TileMatrix>"""
        for z in range(14, 20)
    )
    return f"""<?xml version="1.0"?>
<Capabilities xmlns="http://www.opengis.net/wmts/1.0" xmlns:ows="http://www.opengis.net/ows/1.1"
  version="1.0.0"><Contents>
  <Layer><ows:Title>ortho</ows:Title><ows:Identifier>ortho</ows:Identifier>
    <Style isDefault="true"><ows:Identifier>plain</ows:Identifier></Style>
    <Format>image/png</Format>
    <TileMatrixSetLink><TileMatrixSet>google</TileMatrixSet></TileMatrixSetLink>
    <ResourceURL format="image/png" resourceType="tile"
      template="{url}/tiles/{{TileMatrix}}/{{TileCol}}/{{TileRow}}.png"/></Layer>
  <TileMatrixSet><ows:Identifier>google</ows:Identifier>
    <ows:SupportedCRS>urn:ogc:def:crs:EPSG::3857</ows:SupportedCRS>{matrices}</TileMatrixSet>
</Contents></Capabilities>"""
