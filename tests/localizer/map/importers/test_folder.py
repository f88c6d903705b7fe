"""A folder as a source: taken for what it holds, or an error that says what to pass."""

from __future__ import annotations

import shlex

import pytest

from localizer.errors import MapSourceError
from localizer.map.importers.folder import FoundSource, source_in

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
