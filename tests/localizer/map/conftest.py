"""A small generated tileset: 3 levels of a hilly square, a textured grid per tile."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.map.building.build import build_cache
from localizer.map.building.options import BuildOptions
from localizer.map.cache.cache import TileCache
from localizer.map.cache.tile import TileMesh

ORIGIN = Geodetic(47.2, 8.2, 430.0)
SIZE_M = 400.0
PLACE = (500_100.0, 5_228_300.0)  # of rasters: left and top in UTM zone 32
SEPARATION_M = 47.5


def height(east, north):
    """The test terrain, metres above the origin."""
    return 10 * np.sin(np.asarray(east) / 40) + 6 * np.cos(np.asarray(north) / 25)


def glb(positions, uvs, faces, image: bytes, mime: str = "image/jpeg", **extra) -> bytes:
    """A GLB of one textured primitive; `extra` replaces top-level keys of its JSON."""
    chunks = [
        np.asarray(positions, np.float32).tobytes(),
        np.asarray(uvs, np.float32).tobytes(),
        np.asarray(faces, np.uint32).tobytes(),
        image,
    ]
    views, binary = [], b""
    for chunk in chunks:
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(chunk)})
        binary += chunk + b"\0" * (-len(chunk) % 4)
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": views,
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": len(positions)},
            {"bufferView": 1, "componentType": 5126, "type": "VEC2", "count": len(uvs)},
            {"bufferView": 2, "componentType": 5125, "type": "SCALAR", "count": np.size(faces)},
        ],
        "images": [{"bufferView": 3, "mimeType": mime}],
        "textures": [{"source": 0}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "meshes": [
            {
                "primitives": [
                    {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}
                ]
            }
        ],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    } | extra
    return pack_glb(document, binary)


def pack_glb(document: dict, binary: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text
    body += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def unpack_glb(content: bytes) -> tuple[dict, bytes]:
    length = struct.unpack_from("<I", content, 12)[0]
    return json.loads(content[20 : 20 + length]), content[28 + length :]


def b3dm(content: bytes, rtc: list[float] | None = None) -> bytes:
    """A GLB in a b3dm."""
    features = json.dumps({"BATCH_LENGTH": 0} | ({"RTC_CENTER": rtc} if rtc else {})).encode()
    features += b" " * (-len(features) % 8)
    length = 28 + len(features) + len(content)
    header = struct.pack("<4s6I", b"b3dm", 1, length, len(features), 0, 0, 0)
    return header + features + content


def picture(seed: int, size: int = 64, extension: str = ".jpg") -> bytes:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(40, 220, (8, 8, 3), dtype=np.uint8)
    image = cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC)
    return cv2.imencode(extension, image)[1].tobytes()


def patch(west: float, south: float, size: float, cells: int):
    """Terrain patch in ENU metres: positions, uvs (v down), faces."""
    s = np.linspace(0, 1, cells + 1)
    u, v = np.meshgrid(s, s)
    east, north = west + u * size, south + (1 - v) * size
    positions = np.stack([east, north, height(east, north)], -1).reshape(-1, 3)
    uvs = np.stack([u, v], -1).reshape(-1, 2)
    i = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    n = cells + 1
    faces = np.concatenate([np.stack([i, i + n, i + 1], 1), np.stack([i + 1, i + n, i + n + 1], 1)])
    return positions, uvs, faces


def y_up(enu):
    return np.stack([enu[:, 0], enu[:, 2], -enu[:, 1]], -1)


def write_obj(folder: Path, positions, uvs, faces, heads=("mtllib m.mtl", "usemtl a")) -> Path:
    """m.obj of a textured mesh; uvs: v down. heads: lines before its own."""
    lines = [*heads, *(f"v {x} {y} {z}" for x, y, z in positions)]
    lines += [f"vt {u} {1 - v}" for u, v in uvs]
    lines += ["f " + " ".join(f"{i + 1}/{i + 1}" for i in face) for face in faces]
    (folder / "m.obj").write_text("\n".join(lines))
    return folder / "m.obj"


def write_tileset(folder: Path, *, levels: int = 3, refine: str = "REPLACE") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    seeds = iter(range(1000))

    def node(level: int, west: float, south: float, size: float) -> dict:
        name = f"{level}_{west:.0f}_{south:.0f}.glb"
        positions, uvs, faces = patch(west, south, size, 8)
        (folder / name).write_bytes(glb(y_up(positions), uvs, faces, picture(next(seeds))))
        half = size / 2
        leaf = level == levels - 1
        children = [
            node(level + 1, west + i * half, south + j * half, half)
            for i in (0, 1)
            for j in (0, 1)
            if not leaf
        ]
        box = [west + half, south + half, 0, half, 0, 0, 0, half, 0, 0, 0, 20]
        return {
            "boundingVolume": {"box": box},
            "geometricError": 0.0 if leaf else 40.0 / 2**level,
            "content": {"uri": name},
            "children": children,
        }

    root = node(0, -SIZE_M / 2, -SIZE_M / 2, SIZE_M)
    asset = {"version": "1.1", "extras": {"geoid_separation_m": SEPARATION_M}}
    return write_tree(folder, root | {"refine": refine}, asset=asset)


def write_tree(folder: Path, root: dict, name: str = "tileset.json", *, asset=None) -> Path:
    """A tileset's JSON; `root` is placed about the origin and 100 m wide unless it says otherwise.

    What is None in `root` is left out.
    """
    known = {
        "transform": LocalFrame(ORIGIN).ecef_from_enu.matrix.T.ravel().tolist(),
        "boundingVolume": {"sphere": [0, 0, 0, 100]},
        "geometricError": 0,
    }
    node = {key: value for key, value in (known | root).items() if value is not None}
    document = {"asset": asset or {"version": "1.0"}, "geometricError": 500, "root": node}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(json.dumps(document))
    return folder / name


def write_raster(path: Path, data, crs="EPSG:32632", step=1.0, place=PLACE, **options) -> Path:
    """A GeoTIFF of bands or of one. options: of its profile, tags, and what rasterio sets after."""
    data = data if data.ndim == 3 else data[None]
    tags = options.pop("tags", {})
    kinds = ("units", "scales", "offsets", "colorinterp")
    told = {kind: options.pop(kind) for kind in kinds if kind in options}
    profile = {
        "driver": "GTiff", "width": data.shape[2], "height": data.shape[1], "count": data.shape[0],
        "dtype": data.dtype, "crs": crs,
        "transform": from_origin(*place, *np.broadcast_to(step, 2)),
    } | options  # fmt: skip
    with rasterio.open(path, "w", **profile) as out:
        for name, value in told.items():
            setattr(out, name, value)
        out.write(data)
        if tags:
            out.update_tags(**tags)
    return path


def cut_out(source: Path, out: Path, share: float = 0.25) -> Path:
    """The middle of a raster, `share` of its sides, as a raster of its own."""
    with rasterio.open(source) as whole:
        left, bottom, right, top = whole.bounds
        middle, reach = (left + right) / 2, share * (right - left) / 2
        centre, height = (bottom + top) / 2, share * (top - bottom) / 2
        part = (middle - reach, centre - height, middle + reach, centre + height)
        window = whole.window(*part).round_offsets().round_lengths()
        profile = whole.profile | {
            "driver": "GTiff", "width": window.width, "height": window.height,
            "transform": whole.window_transform(window),
        }  # fmt: skip
        with rasterio.open(out, "w", **profile) as file:
            file.write(whole.read(window=window))
    return out


@pytest.fixture(scope="session")
def make() -> SimpleNamespace:
    """The builders of this file."""
    return SimpleNamespace(
        glb=glb,
        b3dm=b3dm,
        picture=picture,
        patch=patch,
        y_up=y_up,
        tileset=write_tileset,
        height=height,
        origin=ORIGIN,
        separation=SEPARATION_M,
    )


@pytest.fixture(scope="session")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """tileset.json of a tileset of 21 tiles."""
    return write_tileset(tmp_path_factory.mktemp("source"))


@pytest.fixture(scope="session")
def cache_path(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The cache of `source`; read only."""
    out = tmp_path_factory.mktemp("built") / "cache"
    build_cache(source, out, BuildOptions(workers=1))
    return out


@pytest.fixture(scope="session")
def cache(cache_path: Path) -> TileCache:
    return TileCache.open(cache_path)


def built(source: Path, out: Path, **options) -> TileCache:
    """A cache that was built in this process."""
    build_cache(source, out, BuildOptions(workers=1, **options))
    return TileCache.open(out)


def leaf_meshes(cache: TileCache) -> list[TileMesh]:
    """The finest tiles of a cache."""
    index = cache.index
    return [cache.load_tile(tile) for node in index.leaves for tile in index.tiles_of(node)]


@pytest.fixture
def build(tmp_path: Path) -> Callable[..., TileCache]:
    """Build into a fresh folder in this process and open the result."""
    return lambda source, **options: built(source, tmp_path / "cache", **options)
