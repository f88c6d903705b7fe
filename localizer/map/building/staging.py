"""A build in progress: a folder beside the cache that survives a crash and replaces it."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from localizer.errors import MapCacheError
from localizer.geometry.pose import Array
from localizer.map.cache.cache import (
    INDEX_NAME,
    MANIFEST_NAME,
    Manifest,
    TileCache,
    TileIndex,
    encode_tile,
)
from localizer.map.cache.hold import replacing
from localizer.map.cache.tile import build_mips, texel_coverage, vector_area
from localizer.map.source import SourceMesh
from localizer.types import Image


@dataclass(frozen=True)
class StoredTile:
    """A tile file that was written. box: ENU metres; center: the tile frame's origin in ENU; area:
    see `vector_area`.
    """

    sha256: str
    size: int
    file_bytes: int
    triangles: int
    gsd: float
    center: tuple[float, float, float]
    box_min: tuple[float, float, float]
    box_max: tuple[float, float, float]
    area: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class TileRecord:
    """Result of one source tile: the files made of it, or why there are none."""

    tiles: tuple[StoredTile, ...]
    error: str | None = None


class Staging:
    """The folder `<out>.building`: tile files and one record per finished source tile. key: number
    of a source tile in the tree's order.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def record(self, key: int) -> TileRecord | None:
        """The record of a finished source tile; None if it or a file of it is missing."""
        try:
            data = json.loads(self._record_path(key).read_bytes())
            tiles = tuple(_stored_from_json(t) for t in data["tiles"])
            record = TileRecord(tiles, data["error"])
        except (OSError, ValueError, TypeError, KeyError):
            return None
        for part, tile in enumerate(record.tiles):
            path = self.tile_path(key, part)
            if not path.is_file() or path.stat().st_size != tile.file_bytes:
                return None
        return record

    def tile_path(self, key: int, part: int) -> Path:
        """Path of a source tile's part during the build."""
        return self.folder / "parts" / f"{key // 1000:04d}" / f"{key:07d}-{part}.safetensors"

    def store(self, key: int, meshes: list[SourceMesh]) -> TileRecord:
        """Write a source tile's meshes (positions: ENU metres) and then its record. `MapCacheError`
        if that fails.
        """
        self.tile_path(key, 0).parent.mkdir(parents=True, exist_ok=True)
        tiles = []
        for part, mesh in enumerate(meshes):
            data, stored = stored_tile(mesh)
            _write(self.tile_path(key, part), data)
            tiles.append(stored)
        return self._finish(key, TileRecord(tuple(tiles)))

    def reject(self, key: int, reason: str) -> TileRecord:
        """Record that a source tile could not be imported."""
        return self._finish(key, TileRecord((), reason))

    def _finish(self, key: int, record: TileRecord) -> TileRecord:
        path = self._record_path(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        _write(path, json.dumps(asdict(record)).encode())
        return record

    def _record_path(self, key: int) -> Path:
        return self.folder / "records" / f"{key // 1000:04d}" / f"{key:07d}.json"


def _stored_from_json(data: dict[str, Any]) -> StoredTile:
    fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in data.items()}
    return StoredTile(**fields)


@contextmanager
def staging(out: Path, parameters: dict[str, Any], *, overwrite: bool) -> Iterator[Staging]:
    """Context manager: the locked staging folder of a build; the work of an interrupted build with
    the same `parameters` is kept. After an exception the folder stays and `out` is unchanged.
    `MapCacheError` if the cache exists and may not be replaced (overwrite), the folder cannot be
    made, or another build uses it.
    """
    if out.exists() and not overwrite:
        raise MapCacheError(
            f"{out} exists already; choose another folder, or replace it (--overwrite)"
        )
    if out.exists() and not (out / MANIFEST_NAME).is_file() and not _is_empty(out):
        raise MapCacheError(f"{out} is no tile cache and is not overwritten; choose another folder")
    with replacing(out):
        pass  # known before the work; whoever opens it meanwhile is found by `publish`
    folder = out.with_name(out.name + ".building")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise MapCacheError(f"{folder}: cannot be made: {error.strerror}") from error
    with (folder / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise MapCacheError(f"{folder}: another build is writing there") from error
        wanted = json.dumps(parameters, sort_keys=True).encode()
        journal = folder / "build.json"
        if not journal.is_file() or journal.read_bytes() != wanted:
            for name in ("parts", "records"):
                shutil.rmtree(folder / name, ignore_errors=True)
            _write(journal, wanted)
        shutil.rmtree(folder / "tiles", ignore_errors=True)
        yield Staging(folder)


def write_index(staged: Staging, index: TileIndex, manifest: Manifest) -> TileCache:
    """Write index and manifest, and open the staging folder as a cache, before publishing."""
    digest = index.save(staged.folder / INDEX_NAME)
    final = manifest.model_copy(update={"index_sha256": digest})
    _write(staged.folder / MANIFEST_NAME, final.model_dump_json(indent=1).encode())
    return TileCache(staged.folder, final, index)


def publish(staged: Staging, out: Path, manifest: Manifest) -> Manifest:
    """Publish a `write_index` cache atomically by a rename to `out`. `MapCacheError` while a reader
    uses the old cache.
    """
    folder = staged.folder
    _write(folder / MANIFEST_NAME, manifest.model_dump_json(indent=1).encode())
    # Renamed now and deleted after that, so that nobody who opens the cache finds it locked.
    with TemporaryDirectory(prefix=f"{out.name}.old-", dir=out.parent) as old, replacing(out):
        for name in ("records", "parts", "build.json", "lock"):
            (folder / name).rename(Path(old) / name)
        if out.exists():
            out.rename(Path(old) / "replaced")
        folder.rename(out)
    return manifest


def _is_empty(path: Path) -> bool:
    return path.is_dir() and not any(path.iterdir())


def stored_tile(mesh: SourceMesh) -> tuple[bytes, StoredTile]:
    """Encode a mesh in ENU metres as tile file and record."""
    used = np.unique(mesh.faces)  # also drops vertices that no face uses
    lookup = np.zeros(len(mesh.positions), np.int32)
    lookup[used] = np.arange(len(used), dtype=np.int32)
    faces, uvs, world = lookup[mesh.faces], mesh.uvs[used], mesh.positions[used]
    low, high = world.min(axis=0), world.max(axis=0)
    center = np.round(0.5 * (low + high), 3)
    local = (world - center).astype(np.float32)
    h, w = mesh.image.shape[:2]
    if mesh.palette:
        mips: tuple[Image, ...] = (mesh.image,)  # flat colours: coarser levels would mix them
    elif mesh.repeat:
        mips = build_mips(mesh.image)
    else:
        mips = build_mips(mesh.image, texel_coverage(uvs, faces, w, h))
    gsd = 0.0 if mesh.palette else texel_size(world, uvs, faces, (w, h))
    data = encode_tile(local, uvs, faces, mips, repeat=mesh.repeat, finest_jpeg=mesh.jpeg)
    texels = sum(m.nbytes for m in mips)
    return data, StoredTile(
        hashlib.sha256(data).hexdigest(),
        local.nbytes + uvs.nbytes + faces.nbytes + texels,
        len(data),
        len(faces),
        gsd,
        _triple(center),
        _triple(low),
        _triple(high),
        _triple(vector_area(world, faces)),
    )


def texel_size(
    positions: Array,
    uvs: NDArray[np.float32],
    faces: NDArray[np.int32],
    size: tuple[int, int],
) -> float:
    """Metres per texel over a mesh's surface; 0 if its texture has no area. size: (width, height)
    of the texture.
    """
    p, t = positions[faces], uvs[faces].astype(np.float64) * size
    area = 0.5 * np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=-1).sum()
    a, b = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    texels = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()
    return float(np.sqrt(area / texels)) if texels > 0 else 0.0


def _triple(v: Array) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])


def _write(path: Path, data: bytes) -> None:
    temporary = path.with_name(path.name + ".tmp")
    try:
        temporary.write_bytes(data)
        os.replace(temporary, path)
    except OSError as error:
        raise MapCacheError(
            f"{path}: cannot be written: {error.strerror}; once that is mended, the same command "
            "goes on where this one stopped"
        ) from error
