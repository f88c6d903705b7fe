"""Sources as other programs write them are read as the common viewers read them, or named."""

from __future__ import annotations

import gzip
import json
import struct

import cv2
import numpy as np
import pytest
from pyproj import CRS

from localizer.errors import GeoreferenceError, MapSourceError
from localizer.geometry.geo import LocalFrame, geodetic_from_ecef
from localizer.map.building.build import build_cache
from localizer.map.building.options import BuildOptions
from localizer.map.cache.cache import TileCache
from localizer.map.cache.tile import orientation_fault, vector_area
from localizer.map.importers.georeference import Georeference
from localizer.map.importers.gltf import read_gltf
from localizer.map.importers.height_crs import geo_keys, stated_heights
from localizer.map.importers.raster_file import offline, open_raster
from localizer.map.importers.rules import ImportRules
from localizer.map.importers.tiles3d import read_tileset
from tests.localizer.map.conftest import (
    ORIGIN,
    built,
    leaf_meshes,
    write_obj,
    write_raster,
    write_tree,
)

BOX = [0, 0, 5, 60, 0, 0, 0, 60, 0, 0, 0, 20]
COUNTRY = [*np.radians([5.9, 45.8, 10.5, 47.8]), 200.0, 4700.0]


@pytest.fixture
def content(make):
    """A GLB of a square of 120 m about the origin; `up` its axis, `shift` of its place."""

    def made(up="y", shift=(0, 0, 0)):
        positions, uvs, faces = make.patch(-60, -60, 120, 12)
        positions = positions + np.array(shift)
        turned = make.y_up(positions) if up == "y" else positions
        return make.glb(turned, uvs, faces, make.picture(3))

    return made


def tileset(folder, data, uri="t.b3dm", name=None, asset=None, **root):
    folder.mkdir(exist_ok=True)
    (folder / (name or uri)).parent.mkdir(exist_ok=True)
    (folder / (name or uri)).write_bytes(data)
    node = {"boundingVolume": {"box": BOX}, "content": {"uri": uri}} | root
    return write_tree(folder, node, asset=asset)


def colours_of(source):
    (mesh,) = source.root.tiles[0].load()
    return mesh.image


# --- tilesets -----------------------------------------------------------------------------------


def test_compressed_content_is_unpacked_and_what_is_not_is_named(tmp_path, make, content):
    plain = tileset(tmp_path / "plain", make.b3dm(content()))
    packed = tileset(tmp_path / "packed", gzip.compress(make.b3dm(content())))
    packed.write_bytes(gzip.compress(packed.read_bytes()))
    (a,), (b,) = (read_tileset(p).root.tiles[0].load() for p in (plain, packed))
    assert np.array_equal(a.positions, b.positions)
    (tmp_path / "packed" / "t.b3dm").write_bytes(gzip.compress(make.b3dm(content()))[:-200])
    with pytest.raises(MapSourceError, match=r"gzip data that (is cut off|cannot)"):
        read_tileset(packed).root.tiles[0].load()
    bomb = tileset(tmp_path / "bomb", gzip.compress(bytes(200_000)))
    with pytest.raises(MapSourceError, match="--limit file_bytes"):
        read_tileset(bomb, ImportRules(file_bytes=20_000)).root.tiles[0].load()
    for data, said in (
        (b"PK\3\4..", "ZIP"),
        (b"\x28\xb5\x2f\xfd", "zstd"),
        (b"<html>", "web page"),
    ):
        other = tileset(tmp_path / "other", data)
        with pytest.raises(MapSourceError, match=said):
            read_tileset(other).root.tiles[0].load()


@pytest.mark.parametrize(
    ("version", "told"),
    [
        ("0.0", "'0.0', read as 1.0"),
        (0, "0, read as 1.0"),
        (None, "no version"),
        (1.0, ""),
        ("1.1", ""),
    ],
)
def test_versions_that_mean_1_0_are_read(tmp_path, content, version, told):
    asset = {"gltfUpAxis": "Y"} | ({} if version is None else {"version": version})
    source = read_tileset(tileset(tmp_path / "s", content(), asset=asset))
    assert told in " ".join(source.warnings)
    assert bool(told) == bool(source.warnings)


def test_a_region_in_degrees_is_told_and_read(tmp_path, make, content):
    centre = LocalFrame(ORIGIN).ecef_from_enu
    spun = centre.matrix[:3, :3] @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    z_from_y = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    node = np.eye(4)
    node[:3, :3] = z_from_y.T @ spun  # as glTF's y up is turned to z up in ECEF
    positions, uvs, faces = make.patch(-60, -60, 120, 12)
    nodes = [{"mesh": 0, "matrix": node.T.ravel().tolist()}]
    glb = make.glb(make.y_up(positions), uvs, faces, make.picture(3), nodes=nodes)
    region = {"region": [8.198, 47.198, 8.202, 47.202, 400, 460]}
    source = tileset(
        tmp_path / "s", make.b3dm(glb, centre.translation.tolist()), boundingVolume=region,
        transform=None,
    )  # fmt: skip
    tree = read_tileset(source)
    assert "counts in degrees (8.198, 47.198 ...)" in tree.warnings[0]
    assert geodetic_from_ecef(tree.centre)[:2] == pytest.approx((47.2, 8.2), abs=2e-3)


@pytest.mark.parametrize("where", ["child", "root", "box"])
def test_the_origin_is_at_the_content_not_in_the_middle_of_a_country(tmp_path, content, where):
    """An extract keeps the volumes of the whole; its geoid is 1.6 m off there."""
    wide = {"region": [float(x) for x in COUNTRY]}
    if where == "box":
        wide = {"box": [9e4, -9e4, 0, 2e5, 0, 0, 0, 2e5, 0, 0, 0, 2e3]}
    source = tileset(tmp_path / "s", content(), boundingVolume=wide)
    if where != "root":
        document = json.loads(source.read_text())
        child = document["root"] | ({"boundingVolume": {"box": BOX}})
        above = child.pop("transform") if where == "box" else None
        document["root"] = {"boundingVolume": wide, "geometricError": 1e5, "children": [child]}
        if above is not None:
            far = np.array(above).reshape(4, 4).T @ np.block(
                [[np.eye(3), np.array([[9e4], [-9e4], [0.0]])], [np.zeros(3), 1.0]]
            )
            back = np.eye(4)
            back[:3, 3] = (-9e4, 9e4, 0)
            document["root"]["transform"] = far.T.ravel().tolist()
            child["transform"] = back.T.ravel().tolist()
        source.write_text(json.dumps(document))
    build_cache(source, tmp_path / "c", BuildOptions(workers=1))
    manifest = TileCache.open(tmp_path / "c").manifest
    origin = manifest.origin
    assert (origin.latitude_deg, origin.longitude_deg) == pytest.approx((47.2, 8.2), abs=1e-3)
    assert manifest.geoid_separation_m == pytest.approx(47.75, abs=0.05)
    outline = np.array(manifest.extent)
    assert np.abs(outline - (47.2, 8.2)).max() < 1e-3


# --- which way is up ----------------------------------------------------------------------------


def test_ground_on_its_edge_is_refused_with_the_option_that_turns_it(tmp_path, content):
    source = tileset(tmp_path / "s", content(up="z"))
    with pytest.raises(MapSourceError, match=r"stands on its edge: .* y up; try --up-axis z"):
        build_cache(source, tmp_path / "c", BuildOptions(workers=1))
    manifest = build_cache(source, tmp_path / "c", BuildOptions(workers=1, up_axis="z"))
    assert np.ptp(manifest.height_range_m) < 40
    assert not manifest.warnings
    rules = ImportRules(trusted=frozenset({"upright", "volume"}))
    manifest = build_cache(source, tmp_path / "t", BuildOptions(workers=1, rules=rules))
    assert "stands on its edge" in manifest.warnings[0]


def test_a_mesh_and_ground_that_faces_down_are_found_alike(tmp_path, make, content):
    (tmp_path / "m.glb").write_bytes(content(up="z"))
    with pytest.raises(MapSourceError, match="try --up-axis z"):
        built(tmp_path / "m.glb", tmp_path / "c", **PLACE)
    built(tmp_path / "m.glb", tmp_path / "c", up_axis="z", **PLACE)
    positions, uvs, faces = make.patch(-60, -60, 120, 12)
    down = make.glb(make.y_up(positions * (1, -1, -1)), uvs, faces, make.picture(3))
    source = tileset(tmp_path / "s", down)
    with pytest.raises(MapSourceError, match="faces down"):
        build_cache(source, tmp_path / "d", BuildOptions(workers=1))


def test_a_dense_town_of_towers_is_upright(make):
    """Walls are five times the ground there; they cancel each other."""
    positions, _, faces = make.patch(0, 0, 100, 4)
    walls, ids = [positions], [faces]
    for x in range(0, 100, 20):
        for y in range(0, 100, 20):
            corners = np.array([[x, y], [x + 10, y], [x + 10, y + 10], [x, y + 10]], float)
            ring = np.array([[*c, z] for z in (0, 80) for c in corners])
            start = sum(map(len, walls))
            sides = [(k, (k + 1) % 4, 4 + (k + 1) % 4, 4 + k) for k in range(4)] + [(4, 5, 6, 7)]
            walls.append(ring)
            ids.append(
                start + np.array([f for a, b, c, d in sides for f in ((a, b, c), (a, c, d))])
            )
    town, triangles = np.concatenate(walls), np.concatenate(ids)
    assert orientation_fault(vector_area(town, triangles)) is None
    assert orientation_fault(vector_area(town[:, [0, 2, 1]] * (1, -1, 1), triangles)) is not None


def test_content_beside_its_volume_is_refused_and_what_reaches_out_is_told(tmp_path, content):
    beside = tileset(tmp_path / "s", content(shift=(400, 0, 0)))
    with pytest.raises(
        MapSourceError, match=r"1 of 1 tiles reach up to 400 m out .*--trust volume"
    ):
        build_cache(beside, tmp_path / "c", BuildOptions(workers=1))
    partly = tileset(tmp_path / "p", content(shift=(50, 0, 0)))
    manifest = build_cache(partly, tmp_path / "c", BuildOptions(workers=1))
    assert "reach up to 50 m out of the bounding volumes" in manifest.warnings[0]


# --- names of files -----------------------------------------------------------------------------


@pytest.mark.parametrize("uri", ["data\\t.b3dm", "DATA/T.B3DM", "data/t.b3dm", ".\\Data\\t.b3dm"])
def test_names_of_windows_are_found(tmp_path, make, content, uri):
    source = tileset(tmp_path / "s", make.b3dm(content()), uri=uri, name="data/t.b3dm")
    assert read_tileset(source).root.tiles[0].load()


def test_names_of_windows_lead_out_of_the_folder_no_more_than_others(tmp_path, content):
    (tmp_path / "secret.glb").write_bytes(content())
    source = tileset(tmp_path / "s", content(), uri="..\\SECRET.glb", name="t.glb")
    with pytest.raises(MapSourceError, match="leaves the tileset's folder"):
        read_tileset(source)


def test_a_gltf_finds_its_picture_in_another_letter_case(tmp_path, make, content):
    (tmp_path / "s" / "tex").mkdir(parents=True)
    (tmp_path / "s" / "tex" / "roof.png").write_bytes(make.picture(1, extension=".png"))
    positions, uvs, faces = make.patch(-60, -60, 120, 12)
    images = [{"uri": "Tex\\Roof.PNG"}]
    data = make.glb(make.y_up(positions), uvs, faces, make.picture(3), images=images)
    source = read_tileset(tileset(tmp_path / "s", data))
    assert colours_of(source).std() > 20
    assert (tmp_path / "s" / "tex" / "roof.png").resolve() in source.files


# --- glTF materials -----------------------------------------------------------------------------

GLOSS = "KHR_materials_pbrSpecularGlossiness"
TEXTURE = {"index": 0}
GREEN = [0.2, 0.5, 0.1, 1.0]


def shown(make, material, picture=None):
    """What a glTF of one material gives: its mesh, or None."""
    positions, uvs, faces = make.patch(-60, -60, 120, 12)
    picture = make.picture(3) if picture is None else picture
    mime = "image/png" if picture[:4] == b"\x89PNG" else "image/jpeg"
    data = make.glb(make.y_up(positions), uvs, faces, picture, mime, materials=[material])
    meshes, _ = read_gltf(data, lambda uri: b"")
    return meshes[0] if meshes else None


@pytest.mark.parametrize(
    ("material", "factor"),
    [
        ({"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]}, "emissiveTexture": TEXTURE,
          "emissiveFactor": [1, 1, 1]}, (1, 1, 1)),
        ({"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1], "baseColorTexture": TEXTURE},
          "emissiveTexture": TEXTURE, "emissiveFactor": [1, 1, 1]}, (1, 1, 1)),
        ({"emissiveTexture": TEXTURE, "emissiveFactor": [0.5, 0.5, 0.5]}, (0.5, 0.5, 0.5)),
        ({"emissiveTexture": TEXTURE, "emissiveFactor": [0.5, 0.5, 0.5], "extensions":
          {"KHR_materials_emissive_strength": {"emissiveStrength": 4}}}, (1, 1, 1)),
        ({"extensions": {GLOSS: {"diffuseTexture": TEXTURE, "diffuseFactor": GREEN}}}, GREEN[:3]),
        ({"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]},
          "extensions": {GLOSS: {"diffuseTexture": TEXTURE}}}, (1, 1, 1)),
        ({"pbrMetallicRoughness": {"baseColorTexture": TEXTURE},
          "extensions": {GLOSS: {"diffuseFactor": GREEN}}}, (1, 1, 1)),
    ],
)  # fmt: skip
def test_a_picture_is_shown_wherever_the_material_has_it(make, material, factor):
    plain = shown(make, {"pbrMetallicRoughness": {"baseColorTexture": TEXTURE,
                                                  "baseColorFactor": [*factor, 1]}})  # fmt: skip
    assert np.array_equal(shown(make, material).image, plain.image)
    assert plain.image.std() > 5


@pytest.mark.parametrize(
    ("material", "linear"),
    [
        ({"extensions": {GLOSS: {"diffuseFactor": GREEN}}}, GREEN[:3]),
        ({"pbrMetallicRoughness": {"baseColorFactor": GREEN}}, GREEN[:3]),
        ({"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]},
          "emissiveFactor": GREEN[:3]}, GREEN[:3]),
    ],
)  # fmt: skip
def test_a_colour_without_a_picture_is_that_colour(make, material, linear):
    mesh = shown(make, material)
    encoded = 255 * (1.055 * np.array(linear) ** (1 / 2.4) - 0.055)
    assert mesh.palette
    assert mesh.image.reshape(-1, 3) == pytest.approx(np.tile(encoded, (16, 1)), abs=1)


def test_a_strip_faces_up_as_its_triangles_do(make):
    """Of a strip every second triangle has its corners in reverse (glTF 2.0, 3.7.2.1)."""
    ground = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0], [1, 2, 0]])
    strip = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "mode": 5}
    data = make.glb(
        ground, ground[:, :2], np.arange(6), make.picture(3), meshes=[{"primitives": [strip]}]
    )
    (mesh,), _ = read_gltf(data, lambda uri: b"")
    assert vector_area(mesh.positions, mesh.faces) == pytest.approx([0, 0, 2])


def holed(alpha):
    image = np.full((128, 128, 4), 255, np.uint8)
    image[..., :3] = np.random.default_rng(1).integers(0, 255, (128, 128, 3))
    image[..., 3] = alpha
    return cv2.imencode(".png", image)[1].tobytes()


def area_of(mesh):
    a, b, c = (mesh.positions[mesh.faces[:, k]][:, [0, 2]] for k in range(3))
    (x, y), (u, v) = (b - a).T, (c - a).T
    return 0.5 * np.abs(x * v - y * u).sum()


@pytest.mark.parametrize(
    ("mode", "alpha", "factor", "share"),
    [
        ("MASK", 0, 1.0, 0.5), ("MASK", 120, 1.0, 0.5), ("MASK", 140, 1.0, 1.0),
        ("MASK", 255, 0.4, 0.0), ("BLEND", 0, 1.0, 0.5), ("OPAQUE", 0, 1.0, 1.0),
        ("MASK", 140, 0.8, 0.5),
    ],
)  # fmt: skip
def test_what_is_transparent_is_not_there(make, mode, alpha, factor, share):
    """Half of the picture has the alpha, the rest 255: cut along a line between the vertices."""
    mask = np.full((128, 128), 255)
    mask[:, :64] = alpha
    base = {"baseColorTexture": TEXTURE, "baseColorFactor": [1, 1, 1, factor]}
    mesh = shown(make, {"pbrMetallicRoughness": base, "alphaMode": mode}, holed(mask))
    assert (0.0 if mesh is None else area_of(mesh) / 120**2) == pytest.approx(share, abs=0.02)


def test_a_hole_smaller_than_a_triangle_is_cut_out(make):
    mask = np.full((128, 128), 255)
    mask[60:64, 60:64] = 0  # of a cell of 10 x 10 texels
    base = {"pbrMetallicRoughness": {"baseColorTexture": TEXTURE}, "alphaMode": "MASK"}
    mesh = shown(make, base, holed(mask))
    assert pytest.approx(area_of(mesh), rel=3e-4) == 120**2 * (1 - 16 / 128**2)
    assert len(mesh.faces) < 600


# --- OBJ ----------------------------------------------------------------------------------------


def obj(folder, make, library, lines=("mtllib m.mtl", "usemtl a"), image="tex.jpg"):
    """A textured square, its material library and its picture."""
    positions, uvs, faces = make.patch(-30, -30, 60, 6)
    (folder / image).parent.mkdir(exist_ok=True)
    (folder / image).write_bytes(make.picture(2))
    (folder / "m.mtl").write_text(library)
    return write_obj(folder, positions, uvs, faces, lines)


PLACE = {"georeference": Georeference(origin=ORIGIN), "vertical_datum": "ellipsoidal"}


def built_tile(path, out):
    cache = built(path, out, **PLACE)
    return cache.manifest, leaf_meshes(cache)[0]


@pytest.mark.parametrize(
    ("statement", "image"),
    [
        ("map_Kd tex.jpg", "tex.jpg"),
        ("map_Kd -o 0.0 0.0 0.0 -s 1.0 1.0 1.0 -clamp on tex.jpg", "tex.jpg"),
        ("map_Kd -bm 1 -blendu on -mm 0 1 my tex.jpg", "my tex.jpg"),
        ("map_Kd Tex.JPG", "tex.jpg"),
        ("map_Kd textures\\Tex.jpg", "textures/tex.jpg"),
        ("map_Kd C:\\Users\\me\\out\\tex.jpg", "tex.jpg"),
        ('map_kd "tex.jpg"', "tex.jpg"),
        ("map_Kd\ttex.jpg", "tex.jpg"),
        ("map_Ka tex.jpg", "tex.jpg"),
        ("map_Ka none.jpg\nmap_Kd tex.jpg\nmap_Ke none.jpg", "tex.jpg"),
    ],
)
def test_the_picture_of_a_material_is_found(tmp_path, make, statement, image):
    source = obj(tmp_path, make, f"newmtl a\nKd 1 1 1\n{statement}\n", image=image)
    manifest, tile = built_tile(source, tmp_path / "c")
    assert not manifest.warnings
    assert tile.mips[0].std() > 20


def test_a_scale_and_an_offset_of_a_picture_are_applied(tmp_path, make):
    source = obj(tmp_path, make, "newmtl a\nmap_Kd -s 0.5 0.5 -o 0.25 0.25 tex.jpg\n")
    _, tile = built_tile(source, tmp_path / "c")
    plain = cv2.cvtColor(cv2.imread(str(tmp_path / "tex.jpg")), cv2.COLOR_BGR2RGB)
    corner = np.argmin(tile.positions[:, 0] - tile.positions[:, 1])  # north-west
    h, w = tile.mips[0].shape[:2]
    x, y = (tile.uvs[corner] * (w, h)).clip(0, (w - 1, h - 1)).astype(int)
    assert tile.mips[0][y, x] == pytest.approx(plain[16, 16], abs=25)


@pytest.mark.parametrize(
    ("library", "lines", "colour", "told"),
    [
        ("newmtl a\nKd 0.5 0.6 0.4\n", ("mtllib m.mtl", "usemtl a"), (128, 153, 102),
         "no picture, only colours"),
        ("newmtl a\nmap_Kd gone.jpg\nKd 0.5 0.6 0.4", ("mtllib m.mtl", "usemtl a"),
         (128, 153, 102), "'gone.jpg' is not there"),
        ("newmtl a\nmap_Kd tex.jpg\nnewmtl b\nKd 1 0 0", ("mtllib m.mtl",), None,
         "faces name no material (usemtl) and its library has 2"),
        ("", ("mtllib other.mtl", "usemtl a"), None, "its material library is not there"),
        ("newmtl A\nmap_Kd tex.jpg", ("mtllib m.mtl", "usemtl a"), None,
         "1 of its materials are in no library (newmtl), first 'a'"),
        ("newmtl a\nmap_Kd tex.jpg", ("usemtl a",), None, "are in no library"),
    ],
)  # fmt: skip
def test_an_obj_without_a_picture_is_told(tmp_path, make, library, lines, colour, told):
    manifest, tile = built_tile(obj(tmp_path, make, library, lines), tmp_path / "c")
    assert told in " ".join(manifest.warnings)
    if colour is not None:
        assert np.unique(tile.mips[0].reshape(-1, 3), axis=0).tolist() == [list(colour)]


def test_faces_that_name_no_material_have_the_only_one(tmp_path, make):
    source = obj(tmp_path, make, "newmtl a\nmap_Kd tex.jpg\n", ("mtllib M.MTL",))
    library = tmp_path / "m.mtl"
    library.write_bytes(library.read_text().encode("utf-16"))  # as PowerShell writes it
    manifest, tile = built_tile(source, tmp_path / "c")
    assert not manifest.warnings
    assert tile.mips[0].std() > 20


def test_a_mask_of_opacity_cuts_its_holes(tmp_path, make):
    mask = np.full((64, 64), 255, np.uint8)
    mask[:32] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    source = obj(tmp_path, make, "newmtl a\nmap_Kd tex.jpg\nmap_d mask.png\n")
    _, tile = built_tile(source, tmp_path / "c")
    assert np.ptp(tile.positions[:, 1]) == pytest.approx(30, abs=1.5)


# --- GeoTIFF ------------------------------------------------------------------------------------


def dsm(path, crs, version="1.0", **options):
    data = np.full((8, 8), 400, np.float32)
    return write_raster(path, data, crs, place=(5e5, 5.2e6), GEOTIFF_VERSION=version, **options)


def stated(path):
    with offline(), open_raster(path) as data:
        return stated_heights(CRS(data.crs), data.units[0], path)


@pytest.mark.parametrize("version", ["1.0", "1.1"])
@pytest.mark.parametrize(
    ("vertical", "unit", "datum"), [(6360, 1200 / 3937, "amsl"), (5703, 1.0, "amsl"),
                                    (8228, 0.3048, "amsl"), (5773, 1.0, "amsl")],
)  # fmt: skip
def test_vertical_keys_are_read_in_either_version(tmp_path, version, vertical, unit, datum):
    found = stated(dsm(tmp_path / "d.tif", f"EPSG:26910+{vertical}", version))
    assert (found.unit_m, found.datum) == (pytest.approx(unit), datum)


@pytest.mark.parametrize("options", [{}, {"BIGTIFF": "YES"}, {"ENDIANNESS": "BIG"}])
@pytest.mark.parametrize(
    ("kind", "unit", "datum", "name"),
    [
        (5103, 9002, "amsl", "NAVD88"),
        (5030, 9001, "ellipsoidal", "5030"),
        (5102, 9003, "amsl", "29"),
    ],
)
def test_geotiff_1_0s_own_numbers_are_read(tmp_path, options, kind, unit, datum, name):
    """GDAL drops them, and with them the feet."""
    path = dsm(tmp_path / "d.tif", "EPSG:26910+5703", **options)
    data, order = path.read_bytes(), ">" if "ENDIANNESS" in options else "<"
    for key, old, new in ((4096, 5703, kind), (4099, 9001, unit), (4098, 5103, 0)):
        data = data.replace(
            struct.pack(f"{order}4H", key, 0, 1, old), struct.pack(f"{order}4H", key, 0, 1, new)
        )
    path.write_bytes(data)
    assert geo_keys(path)[4096] == kind
    found = stated(path)
    feet = {9001: 1.0, 9002: 0.3048, 9003: 1200 / 3937}[unit]
    assert (found.unit_m, found.datum) == (pytest.approx(feet), datum)
    assert name in found.crs


@pytest.mark.parametrize("data", [b"", b"II*\0", b"II*\0\xff\xff\xff\xff", b"MM\0+" + bytes(60)])
def test_a_file_without_keys_has_none(tmp_path, data):
    (tmp_path / "d.tif").write_bytes(data)
    assert geo_keys(tmp_path / "d.tif") == {}


def test_units_that_contradict_each_other_are_refused(tmp_path):
    path = dsm(tmp_path / "d.tif", "EPSG:26910+5703")
    metre, foot = (struct.pack("<4H", 4099, 0, 1, unit) for unit in (9001, 9003))
    path.write_bytes(path.read_bytes().replace(metre, foot))
    with pytest.raises(GeoreferenceError, match=r"NAVD88 height has units of 1 m, .* 0\.304801 m"):
        stated(path)
