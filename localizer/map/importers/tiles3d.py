"""Reads 3D Tiles 1.0 and 1.1, explicit tilesets: tree and content (b3dm, glb, glTF)."""

from __future__ import annotations

import json
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np

from localizer.errors import MapSourceError
from localizer.geometry.geo import Geodetic, LocalFrame, ecef_from_geodetic, geodetic_from_ecef
from localizer.geometry.pose import Array
from localizer.map.importers.georeference import UpAxis
from localizer.map.importers.gltf import gltf_bounds, gltf_weight, read_gltf
from localizer.map.importers.gltf_data import vector
from localizer.map.importers.materials import transform_mesh
from localizer.map.importers.referenced_files import file_of, files_beside
from localizer.map.importers.rules import DEFAULT_RULES, ImportRules, require_plain_file
from localizer.map.source import SourceMesh, SourceNode, SourceTree

_MAX_USES = 64  # of one tileset: each of a few that name each other multiplies their tiles
_SCALE_SLACK = 0.01  # of a transform: a map's projection may be left in it
_SAMPLED_TILES = 24  # whose headers tell where the content lies
_BESIDE_M = 1000.0  # from the content: an origin so near is the source's own
_GZIP = b"\x1f\x8b"
_PACKED = {b"\x28\xb5\x2f\xfd": "compressed with zstd", b"PK\x03\x04": "a ZIP archive"}

# glTF is y up, 3D Tiles z up: (x, y, z) -> (x, -z, y).
_Z_UP = {
    "Y": np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]),
    "X": np.array([[0.0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]]),
    "Z": np.eye(4),
}


@dataclass(frozen=True, eq=False)
class ContentFile:
    """A tile's content. folder: the tileset's; ecef_from_tile: (4, 4); up_axis: of its glTF. What
    reads the file raises `MapSourceError` if that fails.
    """

    path: Path
    folder: Path
    ecef_from_tile: Array
    up_axis: str
    rules: ImportRules = DEFAULT_RULES

    @property
    def name(self) -> str:
        """How errors name it."""
        return str(self.path.relative_to(self.folder))

    def size_bytes(self) -> int:
        """Size of the file; 0 if it cannot be read."""
        try:
            return self.path.stat().st_size
        except OSError:
            return 0

    def weight(self) -> tuple[int, int]:
        """Triangles and texels by the file's headers."""
        return gltf_weight(self._gltf()[0], self._beside, self.rules)

    def load(self) -> list[SourceMesh]:
        """Read the file's meshes; positions in ECEF metres (float64). `MapSourceError` if the file
        is malformed or exceeds a limit.
        """
        data, rtc = self._gltf()
        meshes, gltf_rtc = read_gltf(data, self._beside, self.rules)
        T = self._ecef_from_gltf(rtc + gltf_rtc)
        return [transform_mesh(m, T) for m in meshes]

    def corners(self) -> Array:
        """(N, 3) ECEF corners, m, of boxes that hold the content, by the file's headers where they
        state them. `MapSourceError` if the file is malformed.
        """
        data, rtc = self._gltf()
        corners, gltf_rtc = gltf_bounds(data, self._beside, self.rules)
        T = self._ecef_from_gltf(rtc + gltf_rtc)
        return np.asarray(corners @ T[:3, :3].T + T[:3, 3])

    def _ecef_from_gltf(self, centre: Array) -> Array:
        """Tile transform, then RTC_CENTER (in z-up axes), then the turn of the glTF's up axis."""
        centred = np.eye(4)
        centred[:3, 3] = centre
        return np.asarray(self.ecef_from_tile @ centred @ _Z_UP[self.up_axis])

    def _gltf(self) -> tuple[bytes, Array]:
        """The glTF or GLB of the content, and the centre (3,) that it is relative to."""
        data = read_file(self.path, self.rules)
        if data[:4] == b"b3dm":
            return _unwrap_b3dm(data)
        if data[:4] in (b"i3dm", b"pnts", b"cmpt"):
            raise MapSourceError(f"content of type {data[:4].decode()} is not supported")
        if data.lstrip()[:1] == b"<":
            raise MapSourceError("content is a web page, not a tile; download the tileset again")
        if data[:4] != b"glTF" and data.lstrip()[:1] != b"{":
            raise MapSourceError(f"content starts with {data[:4]!r}: neither b3dm nor glTF")
        return data, np.zeros(3)

    def _beside(self, uri: str) -> bytes:
        return read_file(resolve_inside(self.folder, self.path.parent, uri), self.rules)


def read_tileset(
    path: Path, rules: ImportRules | None = None, up_axis: UpAxis | None = None
) -> SourceTree:
    """Read `tileset.json` (or the folder that holds it) and every tileset it refers to. up_axis: of
    its glTF; None: as the tileset says. `MapSourceError` if one cannot be read or is malformed.
    """
    try:
        return _read_tileset(path, rules or ImportRules(), up_axis)
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise MapSourceError(f"{path}: malformed tileset: {error!r}") from error


def _read_tileset(path: Path, rules: ImportRules, up_axis: UpAxis | None) -> SourceTree:
    path = (path / "tileset.json" if path.is_dir() else path).resolve()
    reader = _Reader(path.parent, rules, up_axis)
    document = reader.load(path)
    root_json = _object(document.get("root"), f"{path}: root")
    extras: dict[str, Any] = {}
    asset = _object(document.get("asset", {}), f"{path}: asset")
    for holder in (document, asset):
        if isinstance(holder.get("extras"), dict):
            extras |= holder["extras"]
    separation = extras.get("geoid_separation_m")
    if separation is not None and not isinstance(separation, int | float):
        raise MapSourceError(f"{path}: geoid_separation_m is {separation!r}, not a number")
    root = reader.tileset(path, np.eye(4), 0, replaces=True)
    return SourceTree(
        root,
        _centre_of_content(root, _stated_centre(root_json, str(path))),
        None if separation is None else float(separation),
        str(asset.get("copyright", extras.get("attribution", ""))),
        tuple(reader.files),
        "ellipsoidal",  # by the specification
        options="" if up_axis is None else f"up {up_axis}",
        up_axis="/".join(sorted(reader.up_axes)),
        warnings=tuple(dict.fromkeys(reader.warnings)),
    )


def read_file(path: Path, rules: ImportRules) -> bytes:
    """Bytes of a file, gzip unpacked. `MapSourceError`: missing, another archive, or too large."""
    require_plain_file(path)
    try:
        rules.require("file_bytes", path.stat().st_size, path)
        data = path.read_bytes()
    except OSError as error:
        raise MapSourceError(f"{path} cannot be read: {error.strerror or error}") from error
    for start, kind in _PACKED.items():
        if data.startswith(start):
            raise MapSourceError(f"{path}: is {kind}; unpack it first")
    return _gunzipped(data, path, rules) if data[:2] == _GZIP else data


def _gunzipped(data: bytes, path: Path, rules: ImportRules) -> bytes:
    """The decompressed content, if it is gzip, as some exporters write it."""
    unpacker = zlib.decompressobj(wbits=31)
    try:
        plain = unpacker.decompress(data, rules.file_bytes + 1)
    except zlib.error as error:
        raise MapSourceError(f"{path}: gzip data that cannot be unpacked: {error}") from error
    rules.require("file_bytes", len(plain), path)
    if not unpacker.eof:
        raise MapSourceError(f"{path}: gzip data that is cut off")
    return plain


def resolve_inside(folder: Path, base: Path, uri: str) -> Path:
    """The file of a `uri` relative to `base`; `MapSourceError` if it is outside `folder`."""
    parts = urlsplit(uri)
    if parts.scheme or parts.netloc:
        raise MapSourceError(f"{uri!r} is not a local file; download the tileset first")
    name = unquote(parts.path)
    if not name or "\0" in name:
        raise MapSourceError(f"{uri!r} is not a file name")
    path = file_of(base, name).resolve()
    if not path.is_relative_to(folder):
        raise MapSourceError(f"{uri!r} leaves the tileset's folder {folder}")
    return path


class _Reader:
    def __init__(self, folder: Path, rules: ImportRules, up_axis: UpAxis | None) -> None:
        self.folder = folder
        self.rules = rules
        self.up_axes: set[str] = set()  # of all its tilesets
        self._given_axis = up_axis
        self.warnings: list[str] = []
        self._uses: dict[Path, int] = {}
        self._open: list[Path] = []  # tilesets being read, to find cycles
        self._count = 0
        self.files: list[Path] = []

    def load(self, path: Path) -> dict[str, Any]:
        try:
            document = json.loads(read_file(path, self.rules))
        except (ValueError, RecursionError) as error:
            raise MapSourceError(f"{path}: cannot be read as JSON: {error}") from error
        return _object(document, f"{path}: the document")

    def tileset(self, path: Path, parent: Array, depth: int, *, replaces: bool) -> SourceNode:
        """The root node of a tileset file. parent: (4, 4) transform that ECEF has from the tileset.
        depth: number of nodes above. replaces: the node above is replaced by its children
        (REPLACE), not added to (ADD).
        """
        if path in self._open:
            raise MapSourceError(f"{path}: external tilesets refer to each other in a cycle")
        self._uses[path] = self._uses.get(path, 0) + 1
        if self._uses[path] > _MAX_USES:
            raise MapSourceError(
                f"{path}: referred to more than {_MAX_USES} times by other tilesets, whose number "
                "of tiles grows without bound that way"
            )
        document = self.load(path)
        asset = _object(document.get("asset", {}), f"{path}: asset")
        self._require_version(asset.get("version"), path)
        up_axis = str(self._given_axis or asset.get("gltfUpAxis", "Y")).upper()
        if up_axis not in _Z_UP:
            raise MapSourceError(f"{path}: gltfUpAxis {up_axis!r} is not X, Y or Z")
        self.up_axes.add(up_axis.lower())
        self._open.append(path)
        self.files.append(path)
        root = _object(document.get("root"), f"{path}: root")
        node = self._node(root, parent, replaces, up_axis, path, depth)
        self._open.pop()
        return node

    def _require_version(self, version: Any, path: Path) -> None:
        """Accept 1.0 and 1.1; several exporters write 0.0, 0, 1 or nothing for 1.0."""
        text = "" if version is None else str(version).strip()
        if text in ("1.0", "1.1"):
            return
        if text not in ("", "0", "1") and not text.startswith("0."):
            raise MapSourceError(f"{path}: 3D Tiles version {version!r}; 1.0 and 1.1 are read")
        said = f"version {version!r}" if text else "no version"
        self.warnings.append(f"{path.name}: {said}, read as 1.0")

    def _corners(self, volume: Any, T: Array, path: Path) -> Array | None:
        """As the function `_corners`; a region in degrees is converted, with a warning."""
        region: Any = volume.get("region") if isinstance(volume, dict) else None
        if _is_in_degrees(region):
            self.warnings.append(
                f"{path.name}: a region counts in degrees ({region[0]:g}, {region[1]:g} ...), 3D "
                "Tiles counts in radians; it is read as degrees"
            )
            volume = {"region": [*np.radians(region[:4]), *region[4:]]}
        return _corners(volume, T)

    def _node(
        self, data: dict[str, Any], parent: Array, replaces: bool, up: str, path: Path, depth: int
    ) -> SourceNode:
        self._count += 1
        self.rules.require("nodes", self._count, path)
        self.rules.require("depth", depth, path)
        if "implicitTiling" in data or "3DTILES_implicit_tiling" in data.get("extensions", {}):
            raise MapSourceError(f"{path}: implicit tiling is not supported, explicit tiles are")
        T = parent @ self._doubted(_transform(data, str(path)), path)
        refine = str(data.get("refine", "REPLACE" if replaces else "ADD")).upper()
        if refine not in ("REPLACE", "ADD"):
            raise MapSourceError(f"{path}: refine is {refine!r}, neither REPLACE nor ADD")
        tiles: list[ContentFile] = []
        children: list[SourceNode] = []
        for uri in _content_uris(data, path):
            file = resolve_inside(self.folder, path.parent, uri)
            if file.suffix.lower() == ".json":
                children.append(self.tileset(file, T, depth + 1, replaces=refine == "REPLACE"))
            else:
                tiles.append(ContentFile(file, self.folder, T, up, self.rules))
                self.files += [file, *files_beside(file)]
        for item in data.get("children", []):
            child = _object(item, f"{path}: a child")
            children.append(self._node(child, T, refine == "REPLACE", up, path, depth + 1))
        error = _number(data.get("geometricError", 0.0), f"{path}: geometricError")
        scale = float(np.linalg.norm(T[:3, :3], axis=0).max())
        corners = self._corners(data.get("boundingVolume"), T, path)
        return SourceNode(error * scale, refine == "REPLACE", tuple(tiles), children, corners)

    def _doubted(self, T: Array, path: Path) -> Array:
        """A tile's transform (4, 4), with a warning if it does more than move and rotate."""
        text = transform_warning(T)
        if text is not None:
            name = "mirrored" if np.linalg.det(T[:3, :3]) < 0 else "scaled"
            self.warnings.append(self.rules.accept(name, f"{path}: a tile's transform {text}"))
        return T


def transform_warning(T: Array) -> str | None:
    """Warning text if a transform (4, 4) mirrors, or scales by more than 1 %; None otherwise.
    `MapSourceError` if it is singular or a projection.
    """
    sizes = np.linalg.svd(T[:3, :3], compute_uv=False)
    if sizes[-1] <= 1e-12 * max(sizes[0], 1e-300) or not np.allclose(T[3], (0, 0, 0, 1)):
        raise MapSourceError("a transform flattens space or projects it")
    if np.linalg.det(T[:3, :3]) < 0:
        return "mirrors what it places: left becomes right"
    if np.abs(sizes - 1).max() > _SCALE_SLACK:
        return f"stretches what it places, by {sizes[-1]:.4g} to {sizes[0]:.4g}"
    return None


def _content_uris(data: dict[str, Any], path: Path) -> list[str]:
    contents = data.get("contents", [])
    if "content" in data:
        contents = [data["content"], *contents]
    uris = []
    for item in contents:
        content = _object(item, f"{path}: content")
        uri = content.get("uri", content.get("url"))  # `url` before 1.0 was final
        if not isinstance(uri, str):
            raise MapSourceError(f"{path}: a content has no uri")
        uris.append(uri)
    return uris


def _unwrap_b3dm(data: bytes) -> tuple[bytes, Array]:
    if len(data) < 28:
        raise MapSourceError("b3dm is cut off in its header")
    version, length, *tables = struct.unpack_from("<6I", data, 4)
    if version != 1:
        raise MapSourceError(f"b3dm version {version} is not supported, 1 is")
    start = 28 + sum(tables)
    if length > len(data) or start > length:
        raise MapSourceError(f"b3dm is cut off: {len(data)} of {max(length, start)} bytes")
    try:
        features = json.loads(data[28 : 28 + tables[0]] or b"{}")
        center = features.get("RTC_CENTER", [0.0, 0.0, 0.0])
        if isinstance(center, dict):  # in the binary body
            at = 28 + tables[0] + int(center["byteOffset"])
            center = struct.unpack_from("<3f", data[: 28 + tables[0] + tables[1]], at)
    except (ValueError, AttributeError, KeyError, TypeError, struct.error) as error:
        raise MapSourceError(f"b3dm feature table cannot be read: {error}") from error
    return data[start:length], vector(center, 3, "b3dm RTC_CENTER")


def _transform(data: dict[str, Any], where: str) -> Array:
    if data.get("transform") is None:
        return np.eye(4)
    columns: Array = vector(data["transform"], 16, f"{where}: a transform").reshape(4, 4).T.copy()
    return columns


def _is_in_degrees(region: Any) -> bool:
    """Whether a region's angles cannot be radians and can be degrees."""
    try:
        west, south, east, north = (abs(float(value)) for value in region[:4])
    except (TypeError, ValueError):
        return False
    beyond = max(south, north) > np.pi / 2 + 1e-6 or max(west, east) > 2 * np.pi
    return bool(beyond and max(south, north) <= 90.0 and max(west, east) <= 360.0)


def _centre_of_content(root: SourceNode, stated: Array) -> Array:
    """Position of the map, (3,) ECEF: the stated one if it is near the content, else the content's
    middle at its lowest height. A stated volume may span a country although the content is one
    village.
    """
    tiles = [t for node in root.walk() if not node.children for t in node.tiles]
    tiles = tiles or [t for node in root.walk() for t in node.tiles]
    found = []
    for tile in tiles[:: max(1, len(tiles) // _SAMPLED_TILES)]:
        try:
            found.append(tile.corners())  # type: ignore[attr-defined]
        except MapSourceError:
            continue  # told when it is imported
    corners = np.concatenate(found) if found else np.empty((0, 3))
    corners = corners[np.isfinite(corners).all(axis=1)]
    if not len(corners):
        return stated
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    if not 6.2e6 < np.linalg.norm(middle) < 6.5e6:
        return stated
    lat, lon, _ = geodetic_from_ecef(middle)
    lowest = float(geodetic_from_ecef(corners)[:, 2].min())
    if 6.2e6 < np.linalg.norm(stated) < 6.5e6:
        around = LocalFrame(Geodetic(float(lat), float(lon), lowest))
        inside = around.ecef_from_enu.inverse.apply(corners)
        reach = np.ptp(inside[:, :2], axis=0).max() / 2 + _BESIDE_M
        east, north, up = around.ecef_from_enu.inverse.apply(stated)
        if max(abs(east), abs(north)) <= reach and abs(up) <= _BESIDE_M:
            return stated
    return ecef_from_geodetic(lat, lon, lowest)


def _stated_centre(root: dict[str, Any], where: str) -> Array:
    """(3,) ECEF: the root transform's origin if near the Earth's surface, else its volume's."""
    T = _transform(root, where)
    if np.linalg.norm(T[:3, 3]) > 1e6:
        return np.asarray(T[:3, 3])
    bounds = f"{where}: the root's boundingVolume"
    volume = _object(root.get("boundingVolume"), bounds)
    if "region" in volume:
        west, south, east, north, low, _ = vector(volume["region"], 6, bounds)
        if _is_in_degrees(volume["region"]):
            west, south, east, north = np.radians((west, south, east, north))
        if east < west:  # across the 180th meridian (3D Tiles 1.1, 3.5.2)
            east += 2 * np.pi
        lat, lon = np.degrees(0.5 * (south + north)), np.degrees(0.5 * (west + east))
        return ecef_from_geodetic(lat, lon, low)
    key = "box" if "box" in volume else "sphere"
    centre = vector(volume.get(key), 12 if key == "box" else 4, bounds)[:3]
    return np.asarray(T[:3, :3] @ centre + T[:3, 3])


def _corners(volume: Any, T: Array) -> Array | None:
    """(8, 3) ECEF corners of a box that holds a bounding volume; None where that says nothing."""
    if not isinstance(volume, dict):
        return None
    signs = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)], np.float64)
    try:
        if "region" in volume:
            west, south, east, north, low, high = np.asarray(volume["region"], np.float64)
            middle = np.array([south + north, west + east, low + high]) / 2
            half = np.array([north - south, east - west, high - low]) / 2
            lat, lon, h = (middle + signs * half).T
            corners = ecef_from_geodetic(np.degrees(lat), np.degrees(lon), h)
        elif "box" in volume:
            box = np.asarray(volume["box"], np.float64).reshape(4, 3)
            corners = (box[0] + signs @ box[1:]) @ T[:3, :3].T + T[:3, 3]
        else:
            x, y, z, radius = np.asarray(volume.get("sphere"), np.float64)
            corners = (np.array([x, y, z]) + signs * radius) @ T[:3, :3].T + T[:3, 3]
    except (TypeError, ValueError):
        return None
    return corners if np.isfinite(corners).all() else None


def _number(value: Any, what: str) -> float:
    if not isinstance(value, int | float) or not np.isfinite(value) or value < 0:
        raise MapSourceError(f"{what} is {value!r}, not a number from 0 up")
    return float(value)


def _object(value: Any, what: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise MapSourceError(f"{what} is not an object")
    return value
