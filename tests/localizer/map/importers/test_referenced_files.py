"""What a source refers to belongs to it: a change of it is a change of the source."""

from __future__ import annotations

import gzip
import json
import os
import shlex

import numpy as np
import pytest
import rasterio
from rasterio.enums import Resampling

from localizer.errors import MapSourceError
from localizer.geometry.geo import Geodetic
from localizer.map.building.build import fingerprint
from localizer.map.building.sources import read_source
from localizer.map.importers.folder import FoundSource, source_in
from localizer.map.importers.georeference import Georeference
from localizer.map.importers.raster import read_rasters
from localizer.map.importers.referenced_files import files_beside
from localizer.map.importers.tiles3d import read_tileset
from tests.localizer.map.conftest import b3dm, pack_glb, write_raster

ORIGIN = Geodetic(47.0, 8.0, 400.0)


def names(path):
    return {p.name for p in files_beside(path)}


DOCUMENT = {
    "buffers": [{"uri": "a%20b.bin"}, {"uri": "data:application/octet-stream;base64,AA=="}],
    "images": [{"uri": "roof.jpg?v=1"}, {"bufferView": 0}],
}


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("m.gltf", json.dumps(DOCUMENT).encode()),
        ("m.gltf", gzip.compress(json.dumps(DOCUMENT).encode())),
        ("m.glb", pack_glb(DOCUMENT, b"")),
        ("m.b3dm", b3dm(pack_glb(DOCUMENT, b""), [1.0, 2.0, 3.0])),
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


ODD = pack_glb({"buffers": [7, {"uri": 5}]}, b"")


@pytest.mark.parametrize(
    "data", [b"", b"glTF", b"b3dm\1", b"{", b"[]", b'{"images": 3}', ODD, b"mtllib \n"]
)
@pytest.mark.parametrize("name", ["m.gltf", "m.glb", "m.obj", "m.b3dm"])
def test_nothing_raises(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    assert names(tmp_path / name) == set()
    assert files_beside(tmp_path / "none.obj") == ()


def test_the_library_and_the_picture_of_a_mesh_belong_to_its_source(tmp_path):
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd t.png\n")
    (tmp_path / "m.obj").write_text("mtllib m.mtl\nv 0 0 0\nv 9 0 0\nv 0 9 0\nusemtl a\nf 1 2 3\n")
    tree = read_source([tmp_path / "m.obj"], Georeference(origin=ORIGIN))
    assert {path.name for path in tree.files} == {"m.obj", "m.mtl", "t.png"}


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
    paths = [
        write_raster(tmp_path / "dsm.tif", np.ones((64, 64), np.float32)),
        write_raster(tmp_path / "ortho.tif", np.ones((3, 64, 64), np.uint8)),
    ]
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
