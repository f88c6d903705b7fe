"""The tile cache on disk: manifest, index and one file per tile (see cache-format.md)."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import safetensors
import safetensors.numpy
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from localizer.errors import GeoreferenceError, MapCacheError
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Array, Pose
from localizer.map.cache.tile import PackedTexture, TileMesh, mesh_fault
from localizer.map.kind import IMAGERY_DATE, MapKind
from localizer.plain_files import plain_bytes
from localizer.types import Float32, Image

FORMAT_VERSION = 1
MANIFEST_NAME = "manifest.json"
INDEX_NAME = "index.safetensors"
_WHOLE = "copy the cache again, whole, or build it again"
# The geoid lies -107 to 86 m above the WGS84 ellipsoid (EGM2008).
LOWEST_GEOID_M, HIGHEST_GEOID_M = -120.0, 100.0
_PLACE_M = 1.0  # by which a tile's middle may lie outside its node's box: rounding is less
_JPEG_QUALITY = 92
_LOSSLESS_BELOW = 64  # texels; small palettes are stored as PNG, JPEG would smear them

REPLACE, ADD = 0, 1


class Manifest(BaseModel):
    """Description of a cache.

    gsd_m: texel size of the finest tiles; levels: depth of the tile tree; extent: outline of the
    map as (latitude_deg, longitude_deg) corners; skipped: source tiles that could not be imported,
    with the reason; warnings: doubts about the source that did not stop the import; index_sha256:
    hash of the index, which holds the tiles' hashes; kind: None in a cache of an older build, which
    `localizer.map.inspection.kind.map_kind` measures.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    format_version: int = FORMAT_VERSION
    origin: Geodetic
    vertical_datum: Literal["ellipsoidal", "amsl"]
    geoid_separation_m: float = Field(ge=LOWEST_GEOID_M, le=HIGHEST_GEOID_M)
    source: str
    attribution: str
    gsd_m: float
    levels: int
    tiles: int
    triangles: int
    bytes: int = Field(lt=1 << 63)
    extent: tuple[tuple[float, float], ...] = Field(min_length=1)
    height_range_m: tuple[float, float]
    build: dict[str, Any]
    skipped: dict[str, str]
    warnings: tuple[str, ...] = ()
    index_sha256: str
    kind: MapKind | None = None

    @property
    def imagery_date(self) -> str | None:
        """Date of the imagery, None if unknown; older builds kept it among other options."""
        stated = self.build.get("imagery_date") if self.kind is None else self.kind.imagery_date
        return str(stated) if re.fullmatch(IMAGERY_DATE, str(stated)) else None


@dataclass(frozen=True, eq=False)
class TileIndex:
    """The tile tree as arrays over N nodes (root is 0, parents before children) and C tiles.

    box_min, box_max: (N, 3) float64 ENU metres, of the node's own tiles and everything below it;
    geometric_error: (N,) float64 m; gsd: (N,) float64 m per texel; refine: (N,) uint8, `REPLACE`
    or `ADD`; children of node i are nodes child_start[i] to child_start[i] + child_count[i], its
    tiles are tile_start[i] to tile_start[i] + tile_count[i]. Per tile: ecef_from_tile (C, 4, 4)
    float64, size (C,) int64 bytes in memory, digest (C, 32) uint8 SHA-256 of the file.
    """

    box_min: Array
    box_max: Array
    geometric_error: Array
    gsd: Array
    refine: NDArray[np.uint8]
    child_start: NDArray[np.int32]
    child_count: NDArray[np.int32]
    tile_start: NDArray[np.int32]
    tile_count: NDArray[np.int32]
    ecef_from_tile: Array
    size: NDArray[np.int64]
    digest: NDArray[np.uint8]

    def __post_init__(self) -> None:
        n, c = len(self.box_min), len(self.size)
        starts = np.arange(n)
        ok = (
            n > 0
            and all(len(getattr(self, k)) == n for k in _NODE_ARRAYS)
            and self.ecef_from_tile.shape == (c, 4, 4)
            and self.digest.shape == (c, 32)
            and bool(((self.child_count == 0) | (self.child_start > starts)).all())
            and bool((self.child_count >= 0).all() and (self.tile_count >= 0).all())
            and bool((self.child_start + self.child_count <= n).all())
            and bool((self.tile_start >= 0).all())
            and bool((self.tile_start + self.tile_count <= c).all())
        )
        if not ok:
            raise MapCacheError("the tile index contradicts itself; build the cache again")

    def tiles_of(self, node: int) -> range:
        """A node's tiles."""
        start = int(self.tile_start[node])
        return range(start, start + int(self.tile_count[node]))

    @property
    def leaves(self) -> NDArray[np.intp]:
        """The finest nodes with tiles."""
        return np.flatnonzero((self.child_count == 0) & (self.tile_count > 0))

    def save(self, path: Path) -> str:
        """Write to `path`; returns the SHA-256 of the file."""
        arrays = {k: np.ascontiguousarray(v) for k, v in vars(self).items()}
        data = safetensors.numpy.save(arrays)
        path.write_bytes(data)
        return hashlib.sha256(data).hexdigest()


_NODE_ARRAYS = (
    "box_max",
    "geometric_error",
    "gsd",
    "refine",
    "child_start",
    "child_count",
    "tile_start",
    "tile_count",
)


class TileCache:
    """A built map, read-only. Safe to use from several threads."""

    def __init__(self, path: Path, manifest: Manifest, index: TileIndex) -> None:
        self.path = path
        self.manifest = manifest
        self.index = index

    @classmethod
    def open(cls, path: Path) -> TileCache:
        """Open a cache folder. `MapCacheError` if it is missing, corrupt, or of another format
        version. A tile is checked only when it is loaded.
        """
        path = Path(path)
        manifest = read_manifest(path)
        try:
            data = plain_bytes(path / INDEX_NAME, None)
        except OSError as error:
            raise MapCacheError(
                f"{path / INDEX_NAME}: cannot be read: {error}; {_WHOLE}"
            ) from error
        if hashlib.sha256(data).hexdigest() != manifest.index_sha256:
            raise MapCacheError(
                f"{path / INDEX_NAME}: does not match the hash in the manifest; {_WHOLE}"
            )
        try:
            index = TileIndex(**safetensors.numpy.load(data))
        except (safetensors.SafetensorError, TypeError, ValueError) as error:
            raise MapCacheError(f"{path / INDEX_NAME}: not a tile index: {error}") from error
        _require_matching_index(path / MANIFEST_NAME, manifest, index)
        return cls(path, manifest, index)

    @cached_property
    def frame(self) -> LocalFrame:
        """The world frame: ENU about the manifest's origin."""
        return LocalFrame(self.manifest.origin)

    @cached_property
    def world_from_tile(self) -> tuple[Pose, ...]:
        """Each tile's pose in the world."""
        enu_from_ecef = self.frame.ecef_from_enu.inverse
        return tuple(enu_from_ecef @ Pose.from_matrix(T) for T in self.index.ecef_from_tile)

    @property
    def tile_ids(self) -> range:
        """Every id that `load_tile` takes."""
        return range(len(self.index.size))

    def tile_path(self, tile_id: int) -> Path:
        """The file of a tile."""
        return self.path / tile_name(tile_id)

    def load_tile(self, tile_id: int) -> TileMesh:
        """Read, verify and decode one tile; raises `MapCacheError` that names it."""
        return self._load(tile_id, textured=True)

    def load_geometry(self, tile_id: int) -> TileMesh:
        """As `load_tile`, without the texture and much faster: for casting rays."""
        return self._load(tile_id, textured=False)

    def _load(self, tile_id: int, *, textured: bool) -> TileMesh:
        if not 0 <= tile_id < len(self.index.size):
            raise MapCacheError(f"{self.path}: no tile {tile_id}; the index has {self.tile_ids}")
        path = self.tile_path(tile_id)
        try:
            data = plain_bytes(path, None)
        except OSError as error:
            text = f"tile {tile_id}, {path}: cannot be read: {error}; {_WHOLE}"
            raise MapCacheError(text) from error
        if hashlib.sha256(data).digest() != self.index.digest[tile_id].tobytes():
            raise MapCacheError(
                f"tile {tile_id}, {path}: content does not match its hash; {_WHOLE}"
            )
        try:
            return decode_tile(data, self.world_from_tile[tile_id], textured=textured)
        except MapCacheError as error:
            raise MapCacheError(f"tile {tile_id}, {path}: {error}") from error


def tile_name(tile_id: int) -> str:
    """Path of a tile's file inside the cache; a folder holds at most 1000."""
    return f"tiles/{tile_id // 1000:04d}/{tile_id:07d}.safetensors"


def encode_tile(
    positions: Float32,
    uvs: Float32,
    faces: NDArray[np.int32],
    mips: tuple[Image, ...],
    *,
    repeat: bool = False,
    finest_jpeg: bytes | None = None,
) -> bytes:
    """Encode a tile file. positions, uvs, faces, mips, repeat: as in `TileMesh`. finest_jpeg: the
    source's JPEG of mips[0], stored unchanged; None: mips[0] is encoded.
    """
    arrays: dict[str, NDArray[Any]] = {
        "positions": np.ascontiguousarray(positions, np.float32),
        "uvs": np.ascontiguousarray(uvs, np.float32),
        "faces": np.ascontiguousarray(faces, np.uint32),
        "repeat": np.array([repeat], np.uint8),
    }
    for level, mip in enumerate(mips):
        data = finest_jpeg if level == 0 and finest_jpeg else _encode_image(mip)
        arrays[f"mip{level:02d}"] = np.frombuffer(data, np.uint8)
    return bytes(safetensors.numpy.save(arrays))


def decode_tile(data: bytes, world_from_tile: Pose, *, textured: bool = True) -> TileMesh:
    """Inverse of `encode_tile`. textured: False leaves the mips out. `MapCacheError` if the bytes
    are not a tile.
    """
    try:
        arrays = safetensors.numpy.load(data)
        positions, uvs, faces = (arrays[k] for k in ("positions", "uvs", "faces"))
        mips = [k for k in sorted(arrays) if k.startswith("mip")]
        images = [_decode_image(arrays[k]) for k in mips] if textured else []
    except (safetensors.SafetensorError, KeyError) as error:
        raise MapCacheError(f"not a tile file: {error}") from error
    fault = mesh_fault(positions, uvs, faces)
    if fault is not None:
        raise MapCacheError(f"not a tile file: {fault}")
    faces = faces.view(np.int32)
    if not textured:
        return TileMesh(positions, uvs, faces, (), world_from_tile)
    texture = PackedTexture.empty([(i.shape[1], i.shape[0]) for i in images])
    for level, image in enumerate(images):
        cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=texture.mip(level))
    repeat = bool(arrays["repeat"][0]) if "repeat" in arrays else False
    return TileMesh.from_packed(positions, uvs, faces, texture, world_from_tile, repeat=repeat)


def _encode_image(image: Image) -> bytes:
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    if max(image.shape[:2]) < _LOSSLESS_BELOW:
        return bytes(cv2.imencode(".png", bgr)[1])
    return bytes(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1])


def _decode_image(data: NDArray[np.uint8]) -> Image:
    image = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise MapCacheError("a texture level cannot be decoded")
    decoded: Image = image.astype(np.uint8, copy=False)
    return decoded


def read_manifest(path: Path) -> Manifest:
    """The manifest of the cache folder `path`; `MapCacheError` as `TileCache.open`."""
    where = path / MANIFEST_NAME
    if path.is_file():
        raise MapCacheError(
            f"{path}: is a file and no tile cache; build one from it with `companion map build "
            f"{path} --out FOLDER`"
        )
    if not where.is_file():
        raise MapCacheError(
            f"{path}: no tile cache here ({MANIFEST_NAME} is missing); make one with "
            f"`companion map build SOURCE --out {path}`"
        )
    try:
        data = json.loads(plain_bytes(where))
    except (OSError, ValueError, RecursionError) as error:
        raise MapCacheError(f"{where}: cannot be read as JSON: {error}; {_WHOLE}") from error
    version = data.get("format_version") if isinstance(data, dict) else None
    if version != FORMAT_VERSION:
        raise MapCacheError(
            f"{where}: cache format {version!r}, this program reads {FORMAT_VERSION}; "
            "build it again"
        )
    try:
        return Manifest.model_validate(data)
    except ValidationError as error:
        faults = [f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors()]
        raise MapCacheError(f"{where}: not a manifest: {'; '.join(faults)}") from error
    except GeoreferenceError as error:
        raise MapCacheError(f"{where}: not a manifest: {error}") from error


def _require_matching_index(where: Path, manifest: Manifest, index: TileIndex) -> None:
    """`MapCacheError` if the manifest does not fit the index: no hash protects it from an edit, and
    boxes about another origin would make the view lose its tiles.
    """
    if manifest.tiles != len(index.size):
        raise MapCacheError(
            f"{where}: {manifest.tiles} tiles, the index has {len(index.size)}; build it again"
        )
    node = np.repeat(np.arange(len(index.tile_count)), index.tile_count)
    first = np.cumsum(index.tile_count) - index.tile_count
    tile = index.tile_start[node] + np.arange(len(node)) - first[node]
    frame = LocalFrame(manifest.origin)
    middle = frame.ecef_from_enu.inverse.apply(index.ecef_from_tile[tile, :3, 3])
    low, high = index.box_min[node] - _PLACE_M, index.box_max[node] + _PLACE_M
    if not ((low <= middle) & (middle <= high)).all():
        raise MapCacheError(
            f"{where}: its origin is not the one that the index was made about; build it again"
        )
