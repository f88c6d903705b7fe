"""The cache on disk: hashes, versions, atomic and resumable builds."""

from __future__ import annotations

import errno
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from localizer.errors import MapCacheError, MapSourceError
from localizer.geometry.pose import Pose
from localizer.map.building.build import build_cache
from localizer.map.building.options import BuildOptions
from localizer.map.building.staging import Staging, staging
from localizer.map.cache.cache import TileCache, decode_tile, encode_tile
from localizer.map.cache.stream import TileStreamer
from localizer.map.cache.tile import TileMesh, build_mips, texel_coverage


@pytest.fixture
def copy(cache_path: Path, tmp_path: Path) -> Path:
    """A cache that may be damaged."""
    return Path(shutil.copytree(cache_path, tmp_path / "copy"))


def test_missing_cache_says_how_to_make_one(tmp_path):
    with pytest.raises(MapCacheError, match="companion map build"):
        TileCache.open(tmp_path / "nothing")


@pytest.mark.parametrize("at", [0, 100, -1])
def test_a_flipped_bit_in_a_tile_is_found(copy, at):
    cache = TileCache.open(copy)
    path = cache.tile_path(5)
    data = bytearray(path.read_bytes())
    data[at] ^= 1
    path.write_bytes(data)
    with pytest.raises(MapCacheError, match=r"tile 5.*hash"):
        cache.load_tile(5)
    assert isinstance(cache.load_tile(4), TileMesh)


def test_missing_tile_is_named(copy):
    cache = TileCache.open(copy)
    cache.tile_path(3).unlink()
    with pytest.raises(MapCacheError, match=r"tile 3, .*copy the cache again, whole, or build"):
        cache.load_tile(3)
    with pytest.raises(MapCacheError, match="no tile 999"):
        cache.load_tile(999)


@pytest.mark.parametrize("what", ["tile", "index"])
def test_a_pipe_in_a_cache_does_not_hang_the_loader(copy, what):
    """A read of it would never return: neither at the start nor in flight."""
    cache = TileCache.open(copy)
    path = cache.tile_path(0) if what == "tile" else copy / "index.safetensors"
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(MapCacheError, match="is not a plain file"):
        cache.load_tile(0) if what == "tile" else TileCache.open(copy)


def test_a_damaged_or_missing_index_is_found(copy):
    path = copy / "index.safetensors"
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    with pytest.raises(MapCacheError, match="hash in the manifest"):
        TileCache.open(copy)
    path.unlink()
    with pytest.raises(MapCacheError, match="cannot be read"):
        TileCache.open(copy)


_KIND = {"heights": "flat", "unknown_height_sigma_m": 6.0, "effective_resolution_m": 0.2}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format_version": 99}, "format 99"),
        ({"geoid_separation_m": "high"}, "geoid_separation_m"),
        ({"geoid_separation_m": 1e5}, "geoid_separation_m"),
        ({"geoid_separation_m": float("nan")}, "geoid_separation_m"),
        ({"extent": [[float("inf"), 0.0]]}, "extent"),
        ({"extent": []}, "extent"),
        ({"bytes": 10**400}, "bytes"),
        ({"surprise": 1}, "surprise"),
        ({"kind": _KIND | {"unknown_height_sigma_m": 1001.0}}, "from 0 to 1000"),
        ({"kind": _KIND | {"unknown_height_sigma_m": True}}, "unknown_height_sigma_m"),
        ({"kind": _KIND | {"effective_resolution_m": 0}}, "to 100"),
        ({"kind": _KIND | {"effective_resolution_m": 101.0}}, "to 100"),
        ({"kind": _KIND | {"imagery_date": "2024-13-45"}}, "imagery_date"),
        ({"origin": {"latitude_deg": 200, "longitude_deg": 0, "height_m": 0}}, "out of range"),
    ],
)
def test_bad_manifest_is_named(copy, change, message):
    path = copy / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(MapCacheError, match=message):
        TileCache.open(copy)


def test_a_manifest_of_another_index_is_refused(copy):
    """Boxes about another origin would let the view lose its tiles in flight."""
    path = copy / "manifest.json"
    manifest = json.loads(path.read_text())
    for change in (
        {"origin": manifest["origin"] | {"latitude_deg": 47.21}},
        {"origin": manifest["origin"] | {"height_m": 1e12}},
        {"tiles": manifest["tiles"] + 1},
    ):
        path.write_text(json.dumps(manifest | change))
        with pytest.raises(MapCacheError, match="build it again"):
            TileCache.open(copy)


def test_tile_round_trip():
    rng = np.random.default_rng(0)
    positions = rng.normal(size=(30, 3)).astype(np.float32)
    uvs = rng.random((30, 2)).astype(np.float32)
    faces = rng.integers(0, 30, (20, 3), dtype=np.int32)
    image = np.full((100, 80, 3), (200, 100, 50), np.uint8)
    data = encode_tile(positions, uvs, faces, build_mips(image), repeat=True)
    mesh = decode_tile(data, Pose.identity())
    assert np.array_equal(mesh.positions, positions)
    assert np.array_equal(mesh.uvs, uvs)
    assert np.array_equal(mesh.faces, faces)
    assert mesh.repeat
    assert [m.shape[:2] for m in mesh.mips[:3]] == [(100, 80), (50, 40), (25, 20)]
    assert all(np.abs(m.astype(int) - (200, 100, 50)).max() <= 3 for m in mesh.mips)
    assert np.array_equal(mesh.texture.mip(1), mesh.mips[1])


@pytest.mark.parametrize(
    ("array", "value", "told"),
    [
        ("positions", np.nan, "position"),
        ("uvs", np.inf, "texture coordinate"),
        ("uvs", 1e30, "texture coordinate"),
        ("faces", 3, "vertex that is not there"),
    ],
)
def test_a_tile_that_would_lead_kernels_astray_is_refused(array, value, told):
    arrays = {
        "positions": np.eye(3, dtype=np.float32),
        "uvs": np.zeros((3, 2), np.float32),
        "faces": np.array([[0, 1, 2]], np.int32),
    }
    arrays[array][0, 1] = value
    data = encode_tile(**arrays, mips=build_mips(np.zeros((8, 8, 3), np.uint8)))
    for textured in (True, False):
        with pytest.raises(MapCacheError, match=told):
            decode_tile(data, Pose.identity(), textured=textured)


def test_unused_texels_do_not_bleed_into_mips():
    image = np.zeros((64, 64, 3), np.uint8)
    image[:, :24] = 200  # one chart on black
    uvs = np.array([[0, 0], [24 / 64, 0], [0, 1], [24 / 64, 1]], np.float32)
    faces = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
    mips = build_mips(image, texel_coverage(uvs, faces, 64, 64))
    for mip in mips[1:4]:
        used = mip[:, : max(1, mip.shape[1] * 24 // 64)]
        assert used.min() > 190
    assert build_mips(image)[4].min() < 150  # what the mask prevents


def test_same_input_gives_the_same_bytes(source, tmp_path):
    manifests = [
        build_cache(source, tmp_path / name, BuildOptions(workers=workers))
        for name, workers in (("a", 1), ("b", 2))
    ]
    assert manifests[0] == manifests[1]
    for path in (p for p in (tmp_path / "a").rglob("*") if p.is_file()):
        assert path.read_bytes() == (tmp_path / "b" / path.relative_to(tmp_path / "a")).read_bytes()


def test_an_ended_build_goes_on_and_a_changed_source_begins_it_anew(make, tmp_path, monkeypatch):
    source, out, other = make.tileset(tmp_path / "s"), tmp_path / "cache", tmp_path / "other"
    stored: list[int] = []
    store, ended = Staging.store, 9

    def store_some(self, key, meshes):
        if key >= ended:
            raise KeyboardInterrupt
        stored.append(key)
        return store(self, key, meshes)

    monkeypatch.setattr(Staging, "store", store_some)
    with pytest.raises(KeyboardInterrupt):
        build_cache(source, out, BuildOptions(workers=1))
    assert not out.exists()
    shutil.copytree(tmp_path / "cache.building", tmp_path / "other.building")
    ended = 99
    stored.clear()
    manifest = build_cache(source, out, BuildOptions(workers=1))
    assert sorted(stored) == list(range(9, 21))
    assert manifest.tiles == 21
    assert not out.with_name("cache.building").exists()
    stored.clear()
    os.utime(source.with_name("0_-200_-200.glb"), ns=(1, 1))
    build_cache(source, other, BuildOptions(workers=1))
    assert sorted(stored) == list(range(21))


def test_a_full_disk_is_named_and_the_build_goes_on_after_it(source, cache, tmp_path):
    out, limits = tmp_path / "cache", resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (5000, limits[1]))
    try:
        with pytest.raises(MapCacheError, match="cannot be written: File too large"):
            build_cache(source, out, BuildOptions(workers=1))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not out.exists()
    assert build_cache(source, out, BuildOptions(workers=1)) == cache.manifest


ORPHANS = """
import multiprocessing, os, signal
from localizer.map.building.workers import worker_pool
from localizer.map.importers.rules import DEFAULT_RULES
if __name__ == "__main__":
    pool = worker_pool(2, DEFAULT_RULES)
    answered = {pool.submit(os.getpid).result() for _ in range(8)}
    children = {child.pid for child in multiprocessing.active_children()}
    print(*(answered | children), flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_workers_end_with_a_build_that_was_killed(tmp_path):
    script = tmp_path / "orphans.py"
    script.write_text(ORPHANS)
    # To a file: what outlives its parent would hold a pipe open.
    with (tmp_path / "pids").open("w") as file:
        subprocess.run([sys.executable, str(script)], stdout=file, check=False)
    workers = {int(pid) for pid in (tmp_path / "pids").read_text().split()}
    assert workers
    deadline = time.monotonic() + 120  # one that is killed while it starts ends once it has
    while any(_runs(pid) for pid in workers):
        assert time.monotonic() < deadline, "workers stayed behind"
        time.sleep(0.05)


def test_two_builds_do_not_share_a_folder(source, tmp_path):
    with (
        staging(tmp_path / "c", {}, overwrite=False),
        pytest.raises(MapCacheError, match="another"),
    ):
        build_cache(source, tmp_path / "c", BuildOptions(workers=1))


def test_a_cache_that_a_flight_has_open_is_not_replaced(source, copy):
    """Its tiles are read for as long as it flies: another map's are not those of its index."""
    again = BuildOptions(workers=1, overwrite=True)
    with TileStreamer(TileCache.open(copy)) as flight, TileStreamer(TileCache.open(copy)):
        with pytest.raises(MapCacheError, match=r"flight.*another folder"):
            build_cache(source, copy, again)
        assert not copy.with_name(
            "copy.building"
        ).exists()  # known before the work and not after it
        assert flight.cache.load_tile(20).faces.size
    assert build_cache(source, copy, again).tiles == 21


def test_a_cache_that_is_opened_while_its_successor_is_built_stays(source, copy):
    """The build is kept: the same command puts it there after the flight."""
    built = []
    again = BuildOptions(workers=1, overwrite=True)
    with ExitStack() as flight:

        def opened(done, total):
            built.append(done)
            if done == total:
                flight.enter_context(TileStreamer(TileCache.open(copy)))

        with pytest.raises(MapCacheError, match="same command"):
            build_cache(source, copy, again, progress=opened)
        TileCache.open(copy).load_tile(20)
    built.clear()
    build_cache(source, copy, again, progress=lambda done, _: built.append(done))
    assert set(built) == {21}  # none was imported again


def test_a_cache_that_was_replaced_before_it_was_held_is_not_read(source, tmp_path):
    out = tmp_path / "c"
    build_cache(source, out, BuildOptions(workers=1))
    opened = TileCache.open(out)
    origin = replace(opened.manifest.origin, height_m=opened.manifest.origin.height_m + 1.0)
    build_cache(source, out, BuildOptions(workers=1, overwrite=True, origin=origin))
    with pytest.raises(MapCacheError, match="built again"):
        TileStreamer(opened)
    with TileStreamer(TileCache.open(out)):
        pass


def test_where_locks_are_not_known_maps_are_read_and_built(source, tmp_path, monkeypatch):
    """False alarm: a network's file system may know no locks, or none on folders."""

    def refuses(*_):
        raise OSError(errno.ENOLCK, "no locks")

    out = tmp_path / "c"
    build_cache(source, out, BuildOptions(workers=1))
    monkeypatch.setattr("localizer.map.cache.hold.flock", refuses)
    with TileStreamer(TileCache.open(out)):
        build_cache(source, out, BuildOptions(workers=1, overwrite=True))
    TileCache.open(out)


def test_overwrite_spares_what_is_no_cache(source, tmp_path):
    out = tmp_path / "c"
    out.mkdir()
    (out / "thesis.tex").touch()
    (tmp_path / "c.old").mkdir()
    (tmp_path / "c.old" / "draft.tex").touch()
    with pytest.raises(MapCacheError, match="no tile cache"):
        build_cache(source, out, BuildOptions(workers=1, overwrite=True))
    (out / "thesis.tex").unlink()
    build_cache(source, out, BuildOptions(workers=1, overwrite=True))
    assert (tmp_path / "c.old" / "draft.tex").exists()


def test_a_source_that_is_not_there(tmp_path):
    with pytest.raises(MapSourceError, match="no such file"):
        build_cache(tmp_path / "x", tmp_path / "c")
    (tmp_path / "x.las").write_bytes(b"LASF")
    with pytest.raises(MapSourceError, match="not a source"):
        build_cache(tmp_path / "x.las", tmp_path / "c")
