"""Damaged input must end in a named error or a mesh, never in another exception."""

from __future__ import annotations

import contextlib
import json

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from localizer.errors import MapCacheError, MapSourceError
from localizer.geometry.pose import Pose
from localizer.map.cache.cache import decode_tile, encode_tile
from localizer.map.importers.gltf import read_gltf
from localizer.map.importers.tiles3d import ContentFile, read_tileset

FUZZ = settings(max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture])
FLIPS = st.lists(st.tuples(st.integers(0, 10**6), st.integers(1, 255)), max_size=8)
KEPT = st.none() | st.integers(0, 60) | st.integers(0, 2000)  # bytes of the file
NAMES = """root asset children content uri transform geometricError boundingVolume box refine
version meshes primitives attributes POSITION indices accessors bufferViews nodes mesh scenes"""
KEYS = st.sampled_from(sorted(set(NAMES.split())))
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=4),
    max_leaves=12,
)


def no_files(uri):
    raise MapSourceError(f"{uri} is not there")


def damaged(data: bytes, flips, kept) -> bytes:
    out = bytearray(data)
    for at, mask in flips:
        out[at % len(out)] ^= mask
    return bytes(out[:kept])


def content(make) -> bytes:
    positions, uvs, faces = make.patch(-50, -50, 100, 3)
    return make.glb(make.y_up(positions), uvs, faces, make.picture(1, 16))


@FUZZ
@given(flips=FLIPS, kept=KEPT)
def test_glb(make, flips, kept):
    with contextlib.suppress(MapSourceError):
        meshes, _ = read_gltf(damaged(content(make), flips, kept), no_files)
        for mesh in meshes:
            assert mesh.faces.max() < len(mesh.positions)


@FUZZ
@given(flips=FLIPS, header=st.integers(0, 60), kept=KEPT)
def test_b3dm(make, tmp_path, flips, header, kept):
    data = make.b3dm(content(make), [1.0, 2.0, 3.0])
    path = tmp_path / "t.b3dm"
    path.write_bytes((damaged(data[: 28 + header], flips, None) + data[28 + header :])[:kept])
    with contextlib.suppress(MapSourceError):
        ContentFile(path, tmp_path, np.eye(4), "Y").load()


@FUZZ
@given(document=JSON)
def test_tileset(tmp_path, document):
    path = tmp_path / "tileset.json"
    path.write_text(json.dumps(document))
    with contextlib.suppress(MapSourceError):
        read_tileset(path)


@FUZZ
@given(document=st.dictionaries(KEYS, JSON, max_size=6))
def test_gltf_json(document):
    with contextlib.suppress(MapSourceError):
        read_gltf(json.dumps(document).encode(), no_files)


@FUZZ
@given(flips=FLIPS, kept=KEPT)
def test_tile_file(flips, kept):
    data = encode_tile(
        np.zeros((4, 3), np.float32),
        np.zeros((4, 2), np.float32),
        np.array([[0, 1, 2]], np.int32),
        (np.zeros((16, 16, 3), np.uint8),),
    )
    with contextlib.suppress(MapCacheError):
        decode_tile(damaged(data, flips, kept), Pose.identity())
