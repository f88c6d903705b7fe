"""Odd sources: each is a named error, a warning, or handled right; none is silently wrong."""

from __future__ import annotations

import base64
import json
import os
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from pyproj import CRS, Transformer
from rasterio.enums import ColorInterp
from rasterio.transform import Affine, from_origin

from localizer.errors import GeoreferenceError, LocalizerError, MapSourceError
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.geoid import geoid_separation
from localizer.map.building.build import build_cache
from localizer.map.building.options import BuildOptions
from localizer.map.building.workers import call_in_process
from localizer.map.importers.georeference import Georeference, read_georeference
from localizer.map.importers.raster_checks import check_heights
from localizer.map.importers.raster_file import METRES, offline, open_raster, require_sane
from localizer.map.importers.rules import ImportRules, require_plain_file
from localizer.map.importers.tiles3d import read_tileset
from tests.localizer.map.conftest import ORIGIN as TILESET_ORIGIN
from tests.localizer.map.conftest import PLACE, leaf_meshes, write_raster, write_tree
from tests.localizer.map.fetch.loopback import serving

UTM = "EPSG:32632"
(LEFT, TOP), STEP, CELLS = PLACE, 1.0, 48
ORIGIN = Geodetic(47.2, 9.0, 400.0)
ELLIPSOIDAL = {"vertical_datum": "ellipsoidal"}


def ground(n=CELLS, m=None):
    y, x = np.mgrid[0 : m or n, 0:n]
    return (400 + 3 * np.sin(x / 9) + 2 * np.cos(y / 7)).astype(np.float32)


def picture(n=CELLS, seed=0):
    return np.random.default_rng(seed).integers(30, 220, (3, n, n), dtype=np.uint8)


def dsm_of(folder, data=None, **options):
    return write_raster(folder / "dsm.tif", ground() if data is None else data, **options)


def rasters(folder, data=None, ortho=None, **options):
    """A DSM as told, and an honest orthophoto."""
    ortho = dict(ortho or {})
    colours = ortho.pop("data", picture())
    return [dsm_of(folder, data, **options), write_raster(folder / "ortho.tif", colours, **ortho)]


def with_hole(value, dtype=np.float32):
    data = ground().astype(dtype)
    data[:16, :16] = value
    return data


# --- rasters ------------------------------------------------------------------------------------


def sparse(folder, make):
    side = 400_000
    path = folder / "dsm.tif"
    with rasterio.open(
        path, "w", driver="GTiff", width=side, height=side, count=1, dtype="float32", crs=UTM,
        transform=from_origin(LEFT, TOP, 0.1, 0.1), tiled=True, blockxsize=4096, blockysize=4096,
        SPARSE_OK=True, BIGTIFF=True,
    ):  # fmt: skip
        pass
    return [path, write_raster(folder / "ortho.tif", picture())]


def cut_in_half(folder, make):
    paths = rasters(folder)
    data = paths[0].read_bytes()
    paths[0].write_bytes(data[: len(data) // 2])
    return paths


def palette(folder, make):
    one = picture()[:1]
    paths = rasters(folder, ortho={"data": one, "photometric": "palette"})
    with rasterio.open(paths[1], "r+") as data:
        data.write_colormap(1, {i: (i, 255 - i, 0, 255) for i in range(256)})
    return paths


def text_named_tif(folder, make):
    paths = rasters(folder)
    paths[0].write_text("these are the heights")
    return paths


def a_vrt(folder, make):
    paths = rasters(folder)
    paths[0].write_text('<VRTDataset rasterXSize="4" rasterYSize="4"></VRTDataset>')
    return paths


def statistics_elsewhere(folder, make):
    paths = rasters(folder)
    mdi = '<MDI key="OVERVIEW_FILE">http://127.0.0.1/x.tif</MDI>'
    Path(f"{paths[0]}.aux.xml").write_text(
        f'<PAMDataset><Metadata domain="OVERVIEWS">{mdi}</Metadata></PAMDataset>'
    )
    return paths


def pipe(folder, make):
    paths = rasters(folder)
    paths[1].unlink()
    os.mkfifo(paths[1])
    return paths


# --- tilesets and meshes --------------------------------------------------------------------------


def tileset(folder, transform=None, name="tileset.json", **root):
    placed = {} if transform is None else {"transform": np.asarray(transform).T.ravel().tolist()}
    return write_tree(folder, placed | root, name)


def content(folder, make, scale=1.0, lift=0.0, **extra):
    positions, uvs, faces = make.patch(-50, -50, 100, 4)
    positions = scale * positions + [0, 0, lift]
    glb = make.glb(make.y_up(positions), uvs, faces, make.picture(1), **extra)
    (folder / "t.glb").write_bytes(glb)
    return {"content": {"uri": "t.glb"}}


def tileset_dag(folder, make):
    for i in range(8):
        child = {
            "boundingVolume": {"sphere": [0, 0, 0, 100]}, "geometricError": 0,
            "content": {"uri": f"t{i + 1}.json" if i < 7 else "t.glb"},
        }  # fmt: skip
        name = "tileset.json" if i == 0 else f"t{i}.json"
        tileset(folder, None if i == 0 else np.eye(4), name, children=[child] * 10)
    content(folder, make)
    return folder / "tileset.json"


def tileset_cycle(folder, make):
    tileset(folder, np.eye(4), "a.json", content={"uri": "tileset.json"})
    return tileset(folder, content={"uri": "a.json"})


def deep_tileset(folder, make):
    node = content(folder, make) | {"boundingVolume": {"sphere": [0, 0, 0, 9]}, "geometricError": 0}
    for _ in range(250):
        node = {"boundingVolume": {"sphere": [0, 0, 0, 9]}, "geometricError": 1, "children": [node]}
    return tileset(folder, children=[node])


def content_is_a_pipe(folder, make):
    os.mkfifo(folder / "t.glb")
    return tileset(folder, content={"uri": "t.glb"})


def texture_bomb(folder, make):
    import struct
    import zlib

    def chunk(kind, data):
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">2I5B", 60_000, 60_000, 8, 2, 0, 0, 0)
    png = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", b"") + chunk(b"IEND", b"")
    uri = "data:image/png;base64," + base64.b64encode(png).decode()
    return tileset(folder, **content(folder, make, images=[{"uri": uri}]))


def wrong_geoid_stated(folder, make):
    path = tileset(folder, **content(folder, make))
    document = json.loads(path.read_text())
    document["asset"]["extras"] = {"geoid_separation_m": 5.0}
    path.write_text(json.dumps(document))
    return path


def obj(folder, material="map_Kd t.png\n"):
    path = folder / "m.obj"
    path.write_text(
        "mtllib m.mtl\nv 0 0 0\nv 20 0 0\nv 0 20 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl a\n"
        "f 1/1 2/2 3/3\n"
    )
    (folder / "m.mtl").write_text(f"newmtl a\n{material}")
    return path


def obj_bad_texture(folder, make):
    (folder / "t.png").write_bytes(b"not a picture")
    return obj(folder)


def obj_of(folder, text):
    path = folder / "m.obj"
    path.write_text(text)
    return path


def obj_with_one_vertex_far_aside(folder, make):
    obj(folder)
    cv2.imwrite(str(folder / "t.png"), np.zeros((64, 64, 3), np.uint8))
    text = (folder / "m.obj").read_text() + "v 500000 0 0\nf 1/1 2/2 4/3\n"
    return obj_of(folder, text)


MESH = {"georeference": Georeference(origin=ORIGIN), "vertical_datum": "ellipsoidal"}


@dataclass(frozen=True)
class Refused:
    """A source, what the error says, and the doubt that may be trusted."""

    make: Callable[[Path, Any], object]
    says: str
    trust: str | None = None
    options: dict = field(default_factory=lambda: dict(ELLIPSOIDAL))
    name: str = ""

    def __str__(self):
        return self.name or self.make.__name__


def raster(name, says, trust=None, both=None, **how):
    """A DSM that is made so; `both`: so is its orthophoto."""
    how |= {"ortho": both, **both} if both else {}
    return Refused(lambda folder, _: rasters(folder, **how), says, trust, name=name)


def tiles(make, says, trust=None, name=""):
    return Refused(make, says, trust, {}, name)


def turned(scale):
    """A tileset whose axes are scaled so."""
    T = LocalFrame(TILESET_ORIGIN).ecef_from_enu.matrix.copy()
    T[:3, :3] = T[:3, :3] @ np.diag(scale)
    return lambda folder, make: tileset(folder, T, **content(folder, make))


def of_nodes(nodes):
    return lambda folder, make: tileset(folder, **content(folder, make, nodes=nodes))


def object_of(name, says, text, trust=None, **options):
    return Refused(lambda folder, _: obj_of(folder, text), says, trust, MESH | options, name)


NEW_YORK = {"crs": "EPSG:2263", "place": (985_000.0, 210_000.0)}  # US survey feet
DEGREES = {"crs": "EPSG:4326", "step": 1e-5}
SITE_GRID = 'LOCAL_CS["site grid",UNIT["metre",1]]'
MOON = (
    'GEOGCS["Moon",DATUM["D_Moon",SPHEROID["Moon",1737400,0]],PRIMEM["m",0],'
    'UNIT["degree",0.0174532925199433]]'
)
NOISE = (400 + 200 * np.random.default_rng(1).random((CELLS, CELLS))).astype("f4")
CORNERS = "v 0 0 0\nv 10 0 0\nv 0 10 0\n"
UNTOLD = "occur nowhere on Earth, most often -9999.*--nodata=-9999"

CASES = [
    raster("all_nan", "holds no height at all", data=np.full((CELLS, CELLS), np.nan, np.float32)),
    raster("beside", "shows 0.0 % of the ground .* it lies beside it",
           ortho={"place": (LEFT + 5000, TOP)}),
    raster("strip_in_common", "shows 2.1 % of the ground", "overlap",
           ortho={"place": (LEFT + 47, TOP)}),
    raster("in_feet_untold", "CRS is in feet .* --height-unit", both=NEW_YORK),
    raster("unit_against_crs", "the band's unit is 'ft'", crs=f"{UTM}+5773", units=["ft"]),
    raster("depths", "counts depths", crs=f"{UTM}+5715"),
    raster("untagged_minus_9999", UNTOLD, data=with_hole(-9999)),
    raster("untagged_zero", r"11 % of its heights are 0, .*--nodata=0", "nodata",
           data=with_hole(0)),
    raster("noise", "rise by more than 80 degrees", "slope", data=NOISE),
    Refused(sparse, r"more than 20,000,000,000 pixels .*--limit pixels=160000000000"),
    raster("no_place", "no geotransform", transform=Affine.identity()),
    raster("singular", "singular", transform=Affine(1, 0, LEFT, 1, 0, TOP)),
    # Latitude where longitude belongs: rows beyond the pole.
    raster("degrees_swapped", "dsm.tif: its corners .* lie outside .* swapped",
           both=DEGREES | {"place": (47.2, 189.0)}),
    raster("date_line", "dsm.tif: reaches from longitude 179.9998 to 180.0002, beyond",
           both=DEGREES | {"place": (180.0 - 24e-5, 10.0)}),
    raster("site_grid", "dsm.tif: its CRS, site grid, is neither geographic nor projected",
           both={"crs": SITE_GRID}),
    raster("on_the_moon", "dsm.tif: its CRS.* celestial body",
           both={"crs": MOON, "step": 1e-5, "place": (9.0, 47.2)}),
    raster("depths_of_heights", "dsm.tif: its band's scale -1", scales=(-1.0,)),
    raster("complex_numbers", "1 bands of complex64: neither a DSM",
           data=ground().astype(np.complex64)),
    Refused(cut_in_half, "dsm.tif.*: cannot be read: .*IReadBlock failed"),
    raster("metres_swapped", "dsm.tif: lies at .* outside the area of its CRS", "area",
           both={"place": (TOP, LEFT)}),
    Refused(palette, "indices into a palette"),
    Refused(text_named_tif, "no GeoTIFF"),
    Refused(a_vrt, "no GeoTIFF"),
    Refused(statistics_elsewhere, "names other files"),
    Refused(pipe, "not a plain file"),
    tiles(turned((-1, 1, 1)), "mirrors what it places", "mirrored", "mirrored"),
    tiles(turned((2, 2, 2)), "stretches what it places, by 2 to 2", "scaled", "doubled"),
    tiles(turned((1, 1, 0)), "flattens space", name="flattened"),
    tiles(of_nodes([{"mesh": 0, "scale": [-1, 1, 1]}]), "node 0 mirrors its mesh", "mirrored",
          "mirrored_node"),
    tiles(of_nodes([{"children": [i + 1] * 4} for i in range(40)] + [{"mesh": 0}]),
          "several parents, or is in a cycle", name="node_fan_out"),
    tiles(tileset_dag, "referred to more than 64 times"),
    tiles(tileset_cycle, "in a cycle"),
    tiles(deep_tileset, "more than 200 levels .*--limit depth"),
    tiles(content_is_a_pipe, "not a plain file"),
    tiles(lambda folder, _: tileset(folder, content={"uri": "http://127.0.0.1:9/t.glb"}),
          "not a local file", name="content_elsewhere"),
    tiles(texture_bomb, "decompression bomb"),
    tiles(lambda folder, make: tileset(folder, **content(folder, make, lift=20_000.0)),
          "occur nowhere on Earth", "heights", "in_space"),
    tiles(wrong_geoid_stated, "stated geoid separation is 5.00 m, EGM96's", "geoid"),
    Refused(obj_bad_texture, "t.png: a texture that cannot be read", options=MESH),
    Refused(lambda folder, _: obj(folder, "map_Kd /dev/zero\n"), "/dev/zero is not a plain file",
            options=MESH, name="obj_device_texture"),
    object_of("obj_without_area", "m.obj: its triangles have no area",
              "v 0 0 0\nv 10 0 0\nv 20 0 0\nf 1 2 3\n"),
    object_of("obj_with_a_face_without_end", "m.obj: a line is longer than 65536 bytes",
              CORNERS + "f " + "1 2 3 " * 30_000 + "\n"),
    object_of("obj_swapped", "m.obj: lies at .* outside the area of its CRS",
              CORNERS + "f 1 2 3\n", "area", georeference=Georeference(UTM, (TOP, LEFT, 400.0))),
    Refused(obj_with_one_vertex_far_aside, "m.obj, 5000.. m wide .* nodes", options=MESH),
]  # fmt: skip


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")  # as it should be
@pytest.mark.parametrize("case", CASES, ids=str)
def test_an_odd_source_is_refused_by_name_or_trusted(case, tmp_path, make):
    source = case.make(tmp_path, make)
    options = {"workers": 1} | case.options
    with pytest.raises(LocalizerError, match=case.says) as refusal:
        build_cache(source, tmp_path / "c", BuildOptions(**options))
    assert not (tmp_path / "c").exists()
    if case.trust is not None:
        assert f"--trust {case.trust}" in str(refusal.value)
        trusting = ImportRules(trusted=frozenset({case.trust}))
        build_cache(source, tmp_path / "c", BuildOptions(rules=trusting, **options))


# --- odd, and handled right -----------------------------------------------------------------------


def heights_of(cache):
    """(lowest, highest) height of the finest surface without its skirts: above the ellipsoid."""
    found = []
    for mesh in leaf_meshes(cache):
        up = np.unique(mesh.faces[mesh.faces[:, 0] < len(mesh.positions)])
        points = mesh.world_from_tile.apply(mesh.positions[up])
        found.append(cache.frame.geodetic_from_enu(points)[:, 2])
    return np.concatenate(found).min(), np.concatenate(found).max()


def test_outside_a_dsm_without_a_nodata_tag_is_no_ground(tmp_path, build):
    narrow = ground(90, 40)  # 40 rows of 90: most of the square about it is outside
    cache = build(rasters(tmp_path, narrow, ortho={"data": picture(96)}), **ELLIPSOIDAL)
    low, high = heights_of(cache)
    assert 385 < low < high < 406  # with the coarse levels' skirts; it was -2
    box = cache.index.box_max[0] - cache.index.box_min[0]
    assert box[:2] == pytest.approx([89, 39], abs=1.5)


def test_beside_a_turned_dsm_without_a_nodata_tag_is_no_ground(tmp_path, build):
    """Three vertices at its corners were 400 m below the ground."""
    turned = Affine.translation(LEFT, TOP) @ Affine.rotation(10) @ Affine.scale(1, -1)
    source = [
        write_raster(tmp_path / "dsm.tif", ground(80), transform=turned),
        write_raster(tmp_path / "ortho.tif", picture(80), transform=turned),
    ]
    low, high = heights_of(build(source, **ELLIPSOIDAL))
    assert 394 < low < high < 406


def test_ground_that_is_flat_to_the_last_digit_keeps_its_rim(tmp_path, build):
    """A lake, or flat test ground: 29 x 40 of 47 x 47 m were left."""
    cache = build(rasters(tmp_path, np.full((CELLS, CELLS), 400, np.float32)), **ELLIPSOIDAL)
    box = cache.index.box_max[0] - cache.index.box_min[0]
    assert box[:2] == pytest.approx([47, 47], abs=0.1)


@pytest.mark.parametrize(
    ("crs", "place", "says"),
    [
        ("EPSG:27700", (530_000, 180_000), "OSGB36 / British National Grid is known against WGS84"),
        ("EPSG:26710", (550_000, 4_180_000), "needs a grid that is not installed"),
        ("EPSG:26910", (550_000, 4_180_000), "NAD83 / UTM zone 10N .* to 4 m only"),
        ("EPSG:25832", (LEFT, TOP), None),
        ("EPSG:3857", (1e6, 6e6), None),
    ],
)
def test_a_datum_that_is_known_to_metres_only_is_told(tmp_path, crs, place, says):
    """Silently a map of Britain lay up to 21 m off: its grid is not installed with PROJ."""
    with offline(), open_raster(dsm_of(tmp_path, crs=crs, place=place)) as dsm:
        told = require_sane(Path("dsm.tif"), dsm, ImportRules())
    assert (told == []) if says is None else re.search(says, told[0])


def test_a_georeference_says_each_thing_once_and_what_is_not_read_is_told(tmp_path):
    path = tmp_path / "geo.json"
    origin = '"origin": {"lat": 47.2, "lon": 9.0, "height": 400.0}'
    path.write_text("{" + origin + ', "origin": {"lat": 48.2, "lon": 9.0, "height": 400.0}}')
    with pytest.raises(GeoreferenceError, match="a key stands twice"):
        read_georeference(path)
    path.write_text("{" + origin + ', "scale": 2.0}')
    assert read_georeference(path).unread == ("scale",)


def test_outside_the_orthophoto_is_no_map(tmp_path, build):
    cache = build(rasters(tmp_path, ortho={"data": picture(30)}), **ELLIPSOIDAL)
    box = cache.index.box_max[0] - cache.index.box_min[0]
    assert box[:2] == pytest.approx([30, 30], abs=1.5)
    cache.manifest.model_dump_json()
    assert any("shows 39" in text for text in cache.manifest.warnings)


SPIKES = {
    "one cell": ([(20, 20)], 120.0), "two": ([(20, 20), (20, 21)], 100.0),
    "three": ([(20, 20), (21, 21), (22, 21)], 400.0), "a corner": ([(0, 0)], 250.0),
    "nine": ([(r, c) for r in (20, 21, 22) for c in (20, 21, 22)], 300.0),
    "a pit": ([(20, 20), (20, 21)], -300.0), "over a strip's edge": ([(44, 7), (45, 7)], 150.0),
}  # fmt: skip


@pytest.mark.parametrize("name", SPIKES)
def test_a_few_cells_far_above_or_below_all_about_them_are_told(tmp_path, monkeypatch, name):
    monkeypatch.setattr("localizer.map.importers.raster_checks._STRIP_CELLS", 45 * CELLS)
    cells, by = SPIKES[name]
    data = ground()
    for cell in cells:
        data[cell] += by
    with offline(), open_raster(dsm_of(tmp_path, data)) as dsm:
        (told,) = check_heights(Path("dsm.tif"), dsm, METRES, ImportRules())
    side = "above" if by > 0 else "below"
    assert f"m {side} all that is about it" in told
    assert "other places" not in told


def test_a_tower_a_tree_and_a_gorge_are_no_spikes(tmp_path):
    data = ground()
    data[:, 40:] += 2000.0  # a wall
    data[5, 5] += 60.0  # a tree, or an aerial
    data[20:28, 20:28] += 180.0  # a chimney
    data[24, 24] += 70.0  # and what stands on it
    data[44, 8:30] += 150.0  # nobody builds so, but it is no spike
    data[32:36, 30:34] += 300.0
    data[10:13, 10:13] = np.nan
    data[11, 11] = 3500.0  # nobody knows what is about it
    with offline(), open_raster(dsm_of(tmp_path, data, nodata=-9999)) as dsm:
        assert check_heights(Path("dsm.tif"), dsm, METRES, ImportRules()) == []


@pytest.mark.parametrize("level", [0, 200])
def test_an_orthophoto_of_one_colour_is_told(tmp_path, build, level):
    blank = np.full((3, CELLS, CELLS), level, np.uint8)
    blank[:, 3, 3] += 1  # a lossy file's noise
    cache = build(rasters(tmp_path, ortho={"data": blank}), **ELLIPSOIDAL)
    (told,) = cache.manifest.warnings
    assert f"ortho.tif: shows one colour ({level}, {level}, {level}) all over" in told


def test_a_dark_orthophoto_that_shows_something_is_not_doubted(tmp_path, build):
    dark = picture() // 40
    assert build(rasters(tmp_path, ortho={"data": dark}), **ELLIPSOIDAL).manifest.warnings == ()


@pytest.mark.parametrize("given", [float("nan"), float("inf"), -4000.0])
def test_a_geoid_separation_that_is_none_is_refused(tmp_path, given):
    options = BuildOptions(geoid_separation_m=given, vertical_datum="amsl", workers=1)
    with pytest.raises(GeoreferenceError, match=r"geoid separation of .* does not occur on Earth"):
        build_cache(rasters(tmp_path), tmp_path / "c", options)
    assert not (tmp_path / "c").exists()


def test_what_a_mask_hides_is_no_map(tmp_path, build):
    paths = rasters(tmp_path)
    shown = np.full((CELLS, CELLS), 255, np.uint8)
    shown[:, 20:] = 0
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(paths[1], "r+") as data:
        data.write_mask(shown)
    box = np.ptp([*zip(*build(paths, **ELLIPSOIDAL).manifest.extent, strict=True)], axis=1)
    assert box[1] * 75_600 == pytest.approx(20, abs=1.5)  # metres of longitude there


@pytest.mark.parametrize(
    ("value", "dtype"), [(-9999, np.float32), (-32768, np.int16), (0, np.float32)]
)
def test_nodata_that_is_told_is_left_out(tmp_path, build, value, dtype):
    cache = build(rasters(tmp_path, with_hole(value, dtype)), nodata=value, **ELLIPSOIDAL)
    low, high = heights_of(cache)
    assert 385 < low < high < 406


@pytest.mark.parametrize("where", ["crs", "tag", "option", "scale"])
def test_feet_become_metres(tmp_path, build, where):
    feet = ground() / 0.3048
    if where == "crs":
        paths = rasters(tmp_path, feet, crs=f"{UTM}+8228")  # NAVD88 height (ft)
        low, high = heights_of(build(paths))
        lift = geoid_separation(47.2, 9.0)
    else:
        tags = {"tag": {"units": ["ft"]}, "option": {}, "scale": {"scales": [0.3048]}}[where]
        options = ELLIPSOIDAL | ({"height_unit": "ft"} if where == "option" else {})
        low, high = heights_of(build(rasters(tmp_path, feet, **tags), **options))
        lift = 0.0
    assert 390 < low - lift < high - lift < 406


def test_a_dsm_in_feet_stands_where_it_says(tmp_path, build):
    """Horizontal and vertical US survey feet: New York, 400 ft high, 48 ft wide."""
    crs = "EPSG:2263+6360"
    place = (985_000.0, 210_000.0)
    paths = rasters(
        tmp_path, crs=crs, place=place, ortho={"crs": "EPSG:2263", "place": place}
    )  # fmt: skip
    cache = build(paths)
    lon, lat = Transformer.from_crs("EPSG:2263", "EPSG:4326", always_xy=True).transform(
        place[0] + 24, place[1] - 24
    )
    assert cache.manifest.origin.latitude_deg == pytest.approx(lat, abs=1e-5)
    assert cache.manifest.origin.longitude_deg == pytest.approx(lon, abs=1e-5)
    box = cache.index.box_max[0] - cache.index.box_min[0]
    assert box[:2] == pytest.approx(48 * 1200 / 3937, abs=1.0)
    lift = geoid_separation(lat, lon)
    _, high = heights_of(cache)
    assert high == pytest.approx(405 * 1200 / 3937 + lift, abs=0.6)
    assert any("NAVD88" in text for text in cache.manifest.warnings)


def test_a_compound_crs_says_what_heights_are_above(tmp_path, build):
    paths = rasters(tmp_path, crs=f"{UTM}+3855")  # EGM2008
    with pytest.raises(GeoreferenceError, match=r"amsl by its CRS \(EGM2008 height\).*datum"):
        build(paths, **ELLIPSOIDAL)
    cache = build(paths)
    assert cache.manifest.vertical_datum == "amsl"
    assert any("lifted by EGM96" in text for text in cache.manifest.warnings)
    assert heights_of(cache)[1] == pytest.approx(405 + geoid_separation(47.2, 9.0), abs=0.1)


def test_a_three_dimensional_crs_is_ellipsoidal(tmp_path, build):
    paths = rasters(tmp_path, crs=CRS(UTM).to_3d().to_wkt())
    with pytest.raises(GeoreferenceError, match="ellipsoidal by its CRS"):
        build(paths, vertical_datum="amsl")
    assert build(paths).manifest.vertical_datum == "ellipsoidal"


@pytest.mark.parametrize("flip", ["rows", "columns"])
def test_rasters_that_run_the_other_way_lie_the_same(tmp_path, build, flip):
    honest = build(rasters(tmp_path), **ELLIPSOIDAL)
    seen = honest.load_tile(0).mips[0]
    if flip == "rows":
        options = {"transform": Affine(STEP, 0, LEFT, 0, STEP, TOP - CELLS * STEP)}
        turn: tuple[Any, ...] = (..., slice(None, None, -1), slice(None))
    else:
        options = {"transform": Affine(-STEP, 0, LEFT + CELLS * STEP, 0, -STEP, TOP)}
        turn = (..., slice(None, None, -1))
    paths = rasters(tmp_path, ground()[turn], ortho={"data": picture()[turn]} | options, **options)
    other = build(paths, overwrite=True, **ELLIPSOIDAL)
    assert np.allclose(other.index.box_min[0], honest.index.box_min[0], atol=0.01)
    assert np.allclose(other.index.box_max[0], honest.index.box_max[0], atol=0.01)
    difference = np.abs(other.load_tile(0).mips[0].astype(int) - seen)
    assert difference.mean() < 2  # a mirrored picture's is 40


def test_colours_in_another_order_are_put_right(tmp_path, build):
    honest = build(rasters(tmp_path), **ELLIPSOIDAL).load_tile(0).mips[0]
    order = [ColorInterp.blue, ColorInterp.green, ColorInterp.red]
    swapped = {"data": picture()[::-1], "colorinterp": order, "photometric": "minisblack"}
    other = build(rasters(tmp_path, ortho=swapped), overwrite=True, **ELLIPSOIDAL)
    assert np.array_equal(other.load_tile(0).mips[0], honest)


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")  # as it should be
def test_only_control_points_are_no_place(tmp_path):
    paths = rasters(tmp_path)
    with rasterio.open(paths[0], "r+") as data:
        corner = rasterio.control.GroundControlPoint
        points = [corner(0, 0, LEFT, TOP), corner(0, 9, LEFT + 9, TOP), corner(9, 0, LEFT, TOP - 9)]
        data.transform = Affine.identity()
        data.gcps = points, CRS(UTM).to_wkt()
    with pytest.raises(LocalizerError, match=r"no CRS|only control points"):
        build_cache(paths, tmp_path / "c", BuildOptions(workers=1, **ELLIPSOIDAL))


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")  # as it should be
def test_no_name_makes_gdal_fetch_anything(tmp_path):
    with serving(tmp_path) as server:
        address = f"/vsicurl/{server.url}/x.tif"
        vrt = (
            '<VRTDataset rasterXSize="48" rasterYSize="48"><VRTRasterBand dataType="Float32" '
            f'band="1"><SimpleSource><SourceFilename>{address}</SourceFilename><SourceBand>1'
            "</SourceBand></SimpleSource></VRTRasterBand></VRTDataset>"
        )
        (tmp_path / "v.vrt").write_text(vrt)
        with pytest.raises(rasterio.errors.RasterioError), rasterio.open(tmp_path / "v.vrt") as v:
            v.read(1)
        assert server.asked  # what GDAL does when it is let
        server.asked.clear()
        for name in ("dsm.tif", "dsm.tif.ovr", "dsm.tif.msk"):
            paths = rasters(tmp_path)
            (tmp_path / name).write_text(vrt)
            with pytest.raises(MapSourceError, match="no GeoTIFF"):
                build_cache(paths, tmp_path / "c", BuildOptions(workers=1, **ELLIPSOIDAL))
            (tmp_path / name).unlink()
        with offline(), pytest.raises(rasterio.errors.RasterioError):
            rasterio.open(address)
        assert not server.asked


# --- processes with limits ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("what", "limits", "says"),
    [
        ((bytearray, 2**31), {"memory_mb": 300}, "does not fit into memory"),
        ((os.abort,), {}, "its part crashed .SIGABRT"),
        ((time.sleep, 600.0), {"seconds": 1}, "longer than 1 s"),
        ((require_plain_file, Path("none")), {}, "^none cannot be read"),
    ],
)
def test_what_a_process_does_is_a_named_error_here(what, limits, says):
    with pytest.raises(MapSourceError, match=says):
        call_in_process(*what, rules=ImportRules(**limits), what="its part")


def test_a_deep_tree_comes_back_from_its_process(tmp_path, make):
    rules = ImportRules(depth=300)
    source = deep_tileset(tmp_path, make)
    tree = call_in_process(read_tileset, source, rules, rules=rules, what="its part")
    assert sum(1 for _ in tree.root.walk()) == 252


def test_limits_and_doubts_are_named():
    rules = ImportRules.of(["pixels=1e6", "nodes=7"], ["geoid"])
    assert (rules.pixels, rules.nodes, rules.trusted) == (1_000_000, 7, frozenset({"geoid"}))
    for text in ("pixels", "pixels=many", "stars=3", "nodes=0", "depth=1e6"):
        with pytest.raises(MapSourceError, match="--limit"):
            ImportRules.of([text])
    with pytest.raises(MapSourceError, match="no such doubt; there are area, datum"):
        ImportRules.of(trusted=["everything"])
