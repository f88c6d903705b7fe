"""Figures, integrity, images and outline (GeoJSON, KML) of a tile cache, and export to GLB."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image as PillowImage

from localizer.errors import MapCacheError, OutsideMapError
from localizer.geometry.camera import Camera
from localizer.geometry.geo import Corner, Geodetic, level_camera, split_outline
from localizer.geometry.pose import Array, Pose
from localizer.map.cache.cache import Manifest, TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.map.cache.tile import TileMesh
from localizer.render.numba_raster import NumbaRenderer
from localizer.types import Image, RenderedView

HOLE_CELL_M = 1.0
MIN_HOLE_M2 = 25.0  # smaller gaps are ponds, glass roofs and other failures of photogrammetry
_MAX_CELLS = 20_000 * 20_000


@dataclass(frozen=True)
class LevelSummary:
    """One depth of the tile tree. gsd_m: median texel size; megabytes: on disk."""

    level: int
    tiles: int
    gsd_m: float
    geometric_error_m: float
    megabytes: float


@dataclass(frozen=True)
class Hole:
    """A gap that surface surrounds. centre: latitude, longitude in degrees."""

    area_m2: float
    centre: tuple[float, float]


@dataclass(frozen=True)
class Verification:
    """Result of `verify`. damaged: a text for each damaged tile; holes: largest first; covered_m2:
    ground area with map.
    """

    tiles: int
    damaged: tuple[str, ...]
    holes: tuple[Hole, ...]
    covered_m2: float

    @property
    def ok(self) -> bool:
        """Whether every tile is intact; holes do not count."""
        return not self.damaged


def levels(cache: TileCache) -> list[LevelSummary]:
    """Figures of each level, coarsest first."""
    index = cache.index
    depth = _depths(cache)
    result = []
    for level in range(int(depth.max()) + 1):
        nodes = np.flatnonzero((depth == level) & (index.tile_count > 0))
        tiles = [t for n in nodes for t in index.tiles_of(int(n))]
        gsd = index.gsd[nodes]
        size = sum(cache.tile_path(t).stat().st_size for t in tiles if cache.tile_path(t).exists())
        result.append(
            LevelSummary(
                level,
                len(tiles),
                float(np.median(gsd[gsd > 0])) if (gsd > 0).any() else 0.0,
                float(np.median(index.geometric_error[nodes])) if len(nodes) else 0.0,
                size / 1e6,
            )
        )
    return result


def verify(cache: TileCache) -> Verification:
    """Check every tile's hash, and find holes in the finest surface."""
    damaged: list[str] = []
    leaf = set(_cut(cache, None))
    seen = _Occupancy(cache)
    for tile in cache.tile_ids:
        try:
            mesh = cache.load_tile(tile)
        except MapCacheError as error:
            damaged.append(str(error))
            continue
        if tile in leaf:
            seen.add(mesh)
    return Verification(len(cache.tile_ids), tuple(damaged), tuple(seen.holes()), seen.covered_m2())


def camera_pose(
    cache: TileCache,
    latitude_deg: float,
    longitude_deg: float,
    height_m: float,
    heading_deg: float = 0.0,
    pitch_deg: float = -90.0,
) -> Pose:
    """World pose of a level camera. height_m: ellipsoidal; heading: clockwise from north; pitch: of
    the optical axis above the horizon, -90 looks straight down.
    """
    p = Geodetic(latitude_deg, longitude_deg, height_m)  # names what is no place on Earth
    position = cache.frame.enu_from_geodetic(p.latitude_deg, p.longitude_deg, p.height_m)
    return level_camera(position, np.radians(heading_deg), np.radians(pitch_deg))


def render_view(cache: TileCache, world_from_camera: Pose, camera: Camera) -> RenderedView:
    """Render one view at full detail; `OutsideMapError` if the map is not in view."""
    with TileStreamer(cache) as streamer:
        renderer = NumbaRenderer(streamer)
        try:
            view = renderer.render(world_from_camera, camera, wait=True)
        finally:
            renderer.close()
    if not (view.depth > 0).any():
        raise OutsideMapError(f"{cache.path}: the view shows nothing of the map; {_place(cache)}")
    return view


def _place(cache: TileCache) -> str:
    low, high = cache.index.box_min[0], cache.index.box_max[0]
    middle = cache.frame.position((low + high) / 2)
    east, north = (high - low)[:2]
    lowest, highest = cache.manifest.height_range_m
    return (
        f"it lies about {middle.latitude_deg:.5f}, {middle.longitude_deg:.5f}, {east:.0f} x "
        f"{north:.0f} m, between {lowest:.0f} and {highest:.0f} m (ellipsoidal)"
    )


def depth_picture(depth: NDArray[np.float32]) -> Image:
    """Depth (H, W), m, as false colours (H, W, 3) RGB: near is red, far is blue, no surface (0) is
    black. The scale is linear in 1/depth between this picture's 1st and 99th percentile.
    """
    shown = depth > 0
    if not shown.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    inverse = np.where(shown, 1 / np.maximum(depth, 1e-6), 0)
    low, high = np.percentile(inverse[shown], (1, 99))
    scaled = np.clip((inverse - low) / max(high - low, 1e-9), 0, 1)
    colours = cv2.applyColorMap((255 * scaled).astype(np.uint8), cv2.COLORMAP_TURBO)
    return np.where(shown[..., None], cv2.cvtColor(colours, cv2.COLOR_BGR2RGB), 0).astype(np.uint8)


def export_glb(cache: TileCache, out: Path, level: int | None = None) -> int:
    """Write the surface as one GLB, y up, metres from the cache's origin; returns the number of
    triangles.

    level: depth of the tile tree to export (with leaves above it); None: the finest.
    `OutsideMapError` if the map has no such level.
    """
    finest = int(_depths(cache).max())
    if level is not None and level > finest:
        raise OutsideMapError(f"{cache.path}: no level {level}, the finest is {finest}")
    scene = trimesh.Scene()
    triangles = 0
    for tile in _cut(cache, level):
        mesh = cache.load_tile(tile)
        points = mesh.world_from_tile.apply(mesh.positions)
        y_up = np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=-1)
        material = trimesh.visual.material.PBRMaterial(
            baseColorTexture=PillowImage.fromarray(np.ascontiguousarray(mesh.mips[0])),
            metallicFactor=0.0,
            roughnessFactor=1.0,
            doubleSided=True,
        )
        # trimesh counts v upwards, as its glTF writer expects.
        uv = np.column_stack([mesh.uvs[:, 0], 1.0 - mesh.uvs[:, 1]])
        visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
        part = trimesh.Trimesh(y_up, mesh.faces, visual=visual, process=False)
        scene.add_geometry(part, geom_name=f"tile{tile:07d}")
        triangles += len(mesh.faces)
    out.write_bytes(scene.export(file_type="glb"))
    return triangles


def _depths(cache: TileCache) -> NDArray[np.int32]:
    index = cache.index
    depth = np.zeros(len(index.refine), np.int32)
    for node in range(len(depth)):
        start = index.child_start[node]
        depth[start : start + index.child_count[node]] = depth[node] + 1
    return depth


def _cut(cache: TileCache, level: int | None) -> Iterator[int]:
    """Tiles that show the surface once: at a depth of the tree, or (None) the finest."""
    index = cache.index
    depth = _depths(cache)
    last = depth.max() if level is None else level
    # ADD (refine 1): the node's own tiles stay beside its children's.
    stays = (index.child_count == 0) | (index.refine != 0)
    for node in np.flatnonzero((depth == last) | (stays & (depth < last))):
        yield from index.tiles_of(int(node))


class _Occupancy:
    """Which cells of the ground some triangle covers, from above."""

    def __init__(self, cache: TileCache) -> None:
        self._frame = cache.frame
        self._low: Array = cache.index.box_min[0, :2]
        extent = cache.index.box_max[0, :2] - self._low
        self._cell = max(HOLE_CELL_M, float(np.sqrt(np.prod(extent) / _MAX_CELLS)))
        width, height = (int(n) for n in np.ceil(extent / self._cell))
        self._grid = np.zeros((height + 3, width + 3), np.uint8)  # a free cell around it

    def add(self, mesh: TileMesh) -> None:
        points = mesh.world_from_tile.apply(mesh.positions)[:, :2]
        cells = np.floor((points - self._low) / self._cell).astype(np.int32) + 1
        for triangle in cells[mesh.faces]:
            cv2.fillConvexPoly(self._grid, triangle, 1)

    def covered_m2(self) -> float:
        return float(self._grid.sum(dtype=np.int64)) * self._cell**2

    def holes(self) -> list[Hole]:
        """Enclosed areas without map, largest first."""
        count, labels, stats, centroids = cv2.connectedComponentsWithStats(
            1 - self._grid, connectivity=4
        )
        outside = labels[0, 0]
        found = []
        for label in range(1, count):
            area = float(stats[label, cv2.CC_STAT_AREA]) * self._cell**2
            if label != outside and area >= MIN_HOLE_M2:
                east, north = (centroids[label] - 0.5) * self._cell + self._low
                lat, lon, _ = self._frame.geodetic_from_enu([east, north, 0.0])
                found.append(Hole(area, (float(lat), float(lon))))
        return sorted(found, key=lambda hole: -hole.area_m2)


def as_geojson(manifest: Manifest, name: str) -> str:
    """GeoJSON text with one feature: the map's outline as a polygon, counter-clockwise, longitude
    first. An outline across the 180th meridian becomes two polygons. name: a property of it.
    """
    rings = _rings(manifest)
    geometry: dict[str, Any] = {"type": "Polygon", "coordinates": rings}
    if len(rings) > 1:
        geometry = {"type": "MultiPolygon", "coordinates": [[ring] for ring in rings]}
    feature = {
        "type": "Feature",
        "geometry": geometry,
        "properties": {
            "name": name,
            "attribution": manifest.attribution,
            "gsd_m": manifest.gsd_m,
            "lowest_m": manifest.height_range_m[0],
            "highest_m": manifest.height_range_m[1],
            "geoid_separation_m": manifest.geoid_separation_m,
        },
    }
    return json.dumps({"type": "FeatureCollection", "features": [feature]}, indent=1) + "\n"


def as_kml(manifest: Manifest, name: str) -> str:
    """One placemark: the outline as a polygon on the ground, or as two, as in GeoJSON."""
    polygons = "".join(
        "<Polygon><outerBoundaryIs><LinearRing><coordinates>"
        + " ".join(f"{lon:.8f},{lat:.8f}" for lon, lat in ring)
        + "</coordinates></LinearRing></outerBoundaryIs></Polygon>"
        for ring in _rings(manifest)
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark>'
        f"<name>{escape(name)}</name><description>{escape(manifest.attribution)}</description>"
        f"<MultiGeometry>{polygons}</MultiGeometry>"
        "</Placemark></Document></kml>\n"
    )


def _rings(manifest: Manifest) -> list[list[Corner]]:
    """(longitude, latitude) corners, counter-clockwise, the first again at the end."""
    return [_closed(ring) for ring in split_outline([(lon, lat) for lat, lon in manifest.extent])]


def _closed(corners: list[Corner]) -> list[Corner]:
    following = [*corners[1:], corners[0]]
    area = sum(x * b - a * y for (x, y), (a, b) in zip(corners, following, strict=True))
    if area < 0:
        corners = corners[::-1]
    return [*corners, corners[0]]
