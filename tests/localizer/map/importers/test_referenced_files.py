"""What a source refers to belongs to it: a change of it is a change of the source."""

from __future__ import annotations

import json
import os
import shlex
import struct

import cv2
import numpy as np
import pytest
import rasterio
from rasterio.enums import Resampling
from rasterio.transform import from_origin

from localizer.errors import MapSourceError
from localizer.geometry.geo import Geodetic
from localizer.map.building.build import build_cache, fingerprint
from localizer.map.building.options import BuildOptions
from localizer.map.building.staging import Staging
from localizer.map.importers.folder import FoundSource, source_in
from localizer.map.importers.georeference import Georeference
from localizer.map.importers.raster import read_rasters
from localizer.map.importers.referenced_files import files_beside
from localizer.map.importers.tiles3d import read_tileset

ORIGIN = Geodetic(47.0, 8.0, 400.0)
DATUM = {"geoid_separation_m": 48.0, "vertical_datum": "ellipsoidal"}


def names(path):
    return {p.name for p in files_beside(path)}


def packed(document, b3dm=False):
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    data = b"glTF" + struct.pack("<III4s", 2, 20 + len(text), len(text), b"JSON") + text
    if b3dm:
        data = b"b3dm" + struct.pack("<6I", 1, 36 + len(data), 4, 0, 4, 0) + b"{}  {}  " + data
    return data


DOCUMENT = {
    "buffers": [{"uri": "a%20b.bin"}, {"uri": "data:application/octet-stream;base64,AA=="}],
    "images": [{"uri": "roof.jpg?v=1"}, {"bufferView": 0}],
}


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("m.gltf", json.dumps(DOCUMENT).encode()),
        ("m.glb", packed(DOCUMENT)),
        ("m.b3dm", packed(DOCUMENT, b3dm=True)),
    ],
)
def test_buffers_and_pictures_of_a_gltf(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    assert names(tmp_path / name) == {"a b.bin", "roof.jpg"}


def test_libraries_and_pictures_of_an_obj(tmp_path):
    obj = tmp_path / "m.obj"
    obj.write_text("# a mesh\nmtllib two words.mtl\nv 0 0 0\n\tmtllib other.mtl\n")
    (tmp_path / "two words.mtl").write_text("newmtl a\nmap_Kd -s 1 1 1 roof.png\nbump b.png\n")
    (tmp_path / "other.mtl").write_bytes(b"newmtl \xff\n map_Kd my wall.jpg\r\n")
    found = names(obj)
    assert {"two words.mtl", "other.mtl", "roof.png", "b.png", "my wall.jpg"} <= found


@pytest.mark.parametrize("data", [b"", b"glTF", b"b3dm\1", b"{", b"[]", b'{"images": 3}',
                                  packed({"buffers": [7, {"uri": 5}]}), b"mtllib \n"])  # fmt: skip
@pytest.mark.parametrize("name", ["m.gltf", "m.glb", "m.obj", "m.b3dm"])
def test_nothing_raises(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    assert names(tmp_path / name) == set()
    assert files_beside(tmp_path / "none.obj") == ()


def write_obj(folder, grey):
    cv2.imwrite(str(folder / "t.png"), np.full((64, 64, 3), grey, np.uint8))
    (folder / "m.mtl").write_text("newmtl t\nmap_Kd t.png\n")
    n = 40
    lines = ["mtllib m.mtl", "usemtl t"]
    lines += [f"v {8 * i} {8 * j} 0" for j in range(n) for i in range(n)]
    lines += [f"vt {i / (n - 1)} {j / (n - 1)}" for j in range(n) for i in range(n)]
    for j in range(n - 1):
        for i in range(n - 1):
            a = j * n + i + 1
            for b, c in ((a + 1, a + n + 1), (a + n + 1, a + n)):
                lines.append(f"f {a}/{a} {b}/{b} {c}/{c}")
    (folder / "m.obj").write_text("\n".join(lines))
    return folder / "m.obj"


def test_a_texture_that_changes_while_a_build_rests_begins_it_anew(tmp_path, monkeypatch):
    obj = write_obj(tmp_path, 50)
    store, left = Staging.store, [2]

    def interrupted(self, key, meshes):
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        return store(self, key, meshes)

    options = {"georeference": Georeference(origin=ORIGIN), "workers": 1}
    options |= DATUM
    monkeypatch.setattr(Staging, "store", interrupted)
    monkeypatch.setattr("localizer.map.building.quadtree.LEAF_TRIANGLES", 400)
    with pytest.raises(KeyboardInterrupt):
        build_cache(obj, tmp_path / "out", BuildOptions(**options))
    cv2.imwrite(str(tmp_path / "t.png"), np.full((64, 64, 3), 200, np.uint8))
    stored = []
    monkeypatch.setattr(
        Staging, "store", lambda self, key, m: (stored.append(key), store(self, key, m))[1]
    )
    manifest = build_cache(obj, tmp_path / "out", BuildOptions(**options))
    assert 0 in stored
    assert len(stored) == manifest.tiles


def test_what_a_tiles_content_refers_to(tmp_path):
    (tmp_path / "tile.gltf").write_text(json.dumps({"images": [{"uri": "roof.jpg"}]}))
    (tmp_path / "roof.jpg").write_bytes(b"1")
    root = {"boundingVolume": {"sphere": [4.3e6, 6e5, 4.6e6, 100]}, "geometricError": 0,
            "content": {"uri": "tile.gltf"}}  # fmt: skip
    (tmp_path / "tileset.json").write_text(json.dumps({"asset": {"version": "1.0"}, "root": root}))
    before = fingerprint(read_tileset(tmp_path).files)
    os.utime(tmp_path / "roof.jpg", ns=(1, 1))
    assert fingerprint(read_tileset(tmp_path).files) != before


@pytest.mark.parametrize("change", ["overview", "statistics", "mask"])
def test_what_lies_beside_a_raster(tmp_path, change):
    paths = []
    for name, dtype, count in (("dsm", "float32", 1), ("ortho", "uint8", 3)):
        path = tmp_path / f"{name}.tif"
        with rasterio.open(
            path, "w", driver="GTiff", width=64, height=64, count=count, dtype=dtype,
            crs="EPSG:32632", transform=from_origin(5e5, 5.2e6, 1, 1),
        ) as out:  # fmt: skip
            out.write(np.ones((count, 64, 64), dtype))
        paths.append(path)
    before = read_rasters(paths).files
    assert set(before) == set(paths)
    if change == "overview":
        with rasterio.Env(TIFF_USE_OVR=True), rasterio.open(paths[1], "r+") as data:
            data.build_overviews([2], Resampling.average)
    elif change == "statistics":
        (tmp_path / "dsm.tif.aux.xml").write_text("<PAMDataset></PAMDataset>")
    else:
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=False), rasterio.open(paths[1], "r+") as data:
            data.write_mask(np.full((64, 64), 255, np.uint8))
    after = read_rasters(paths).files
    assert len(after) == 3
    assert fingerprint(after) != fingerprint(before)


# --- A folder as a source: taken for what it holds, or an error that says what to pass ----------


MESH, COORDS = "odm_texturing/odm_textured_model_geo.obj", "odm_georeferencing/coords.txt"
DSM, ORTHO = "odm_dem/dsm.tif", "odm_orthophoto/odm_orthophoto.tif"


def _folder(root, *names):
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    return root


@pytest.mark.parametrize(
    ("holds", "sources", "georeference"),
    [
        (("tileset.json", "dsm.tif", "ortho.tif"), ("",), None),
        ((MESH, COORDS, ORTHO), (MESH,), COORDS),
        ((DSM, ORTHO, "odm_dem/dtm.tif", COORDS), (DSM, ORTHO), None),
        (("3d_tiles/model/tileset.json", ORTHO), ("3d_tiles/model",), None),
        (("b3dmtileset.json", "0/1.b3dm"), ("b3dmtileset.json",), None),
        (("dsm.tif", "ortho.tif", "README.md"), ("dsm.tif", "ortho.tif"), None),
        (("m.glb", "georef.json"), ("m.glb",), "georef.json"),
    ],
)
def test_what_a_folder_holds_is_found(tmp_path, holds, sources, georeference):
    found = source_in(_folder(tmp_path, *holds), georeference_given=False)
    expected = tuple(tmp_path / s for s in sources)
    assert found == FoundSource(expected, tmp_path / georeference if georeference else None)


def test_a_given_georeference_goes_before_the_folder_s(tmp_path):
    found = source_in(_folder(tmp_path, MESH, COORDS), georeference_given=True)
    assert found == FoundSource((tmp_path / MESH,), None)


def test_several_ways_are_listed_as_commands(tmp_path):
    holds = _folder(tmp_path / "my map", MESH, COORDS, DSM, ORTHO)
    with pytest.raises(MapSourceError, match="several ways") as error:
        source_in(holds, georeference_given=False)
    mesh, elevation = (shlex.split(line) for line in str(error.value).splitlines()[1:])
    assert mesh[3:-2] == [str(holds / MESH), "--georeference", str(holds / COORDS)]
    assert elevation[3:-2] == [str(holds / DSM), str(holds / ORTHO)]


@pytest.mark.parametrize(
    ("holds", "told"),
    [
        ((), "nothing else that can be imported"),
        (("notes.txt",), "nothing else that can be imported"),
        ((MESH,), MESH),  # without its offset
        (("dsm.tif",), "dsm.tif"),
        (("a.tif", "b.tif", "c.tif"), "a.tif, b.tif, c.tif"),
        (("m.obj",), "m.obj"),
    ],
)
def test_what_is_not_one_source_is_told(tmp_path, holds, told):
    with pytest.raises(MapSourceError, match="--georeference FILE") as error:
        source_in(_folder(tmp_path, *holds), georeference_given=False)
    assert told in str(error.value)
