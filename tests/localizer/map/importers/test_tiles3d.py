"""Import of 3D Tiles: where things end up, and what is refused."""

from __future__ import annotations

import json

import cv2
import DracoPy
import numpy as np
import pytest

from localizer.errors import GeoreferenceError, MapCacheError, MapSourceError
from localizer.geometry.geo import geodetic_from_ecef
from localizer.geometry.pose import Pose
from localizer.map.building.build import build_cache
from localizer.map.building.options import BuildOptions
from localizer.map.importers.gltf import read_gltf
from localizer.map.importers.tiles3d import read_tileset
from tests.localizer.map.conftest import pack_glb, unpack_glb, write_tree


def world_vertices(cache):
    meshes = [cache.load_tile(i) for i in cache.tile_ids]
    return np.concatenate([m.world_from_tile.apply(m.positions) for m in meshes])


def no_files(uri):
    raise AssertionError(f"{uri} should not be read")


def single_tile(make, folder, content: bytes, name="tile.glb", **root):
    """A tileset of one tile about the test origin."""
    folder.mkdir(exist_ok=True)
    (folder / name).write_bytes(content)
    asset = {"version": "1.0", "extras": {"geoid_separation_m": make.separation}}
    return write_tree(folder, {"content": {"uri": name}} | root, asset=asset)


def flat_patch(make, **extra):
    positions, uvs, faces = make.patch(-50, -50, 100, 4)
    return positions, make.glb(make.y_up(positions), uvs, faces, make.picture(1), **extra)


def test_vertices_are_where_the_source_puts_them(cache, make):
    points = world_vertices(cache)
    assert np.abs(points[:, 2] - make.height(points[:, 0], points[:, 1])).max() < 1e-3
    assert points[:, :2].min() == pytest.approx(-200, abs=1e-3)
    assert points[:, :2].max() == pytest.approx(200, abs=1e-3)


def test_manifest_tells_origin_separation_and_size(cache, make):
    m = cache.manifest
    assert (m.geoid_separation_m, m.vertical_datum) == (make.separation, "ellipsoidal")
    assert (m.tiles, m.levels) == (21, 3)
    assert m.origin.latitude_deg == pytest.approx(make.origin.latitude_deg, abs=1e-8)
    assert m.origin.height_m == pytest.approx(make.origin.height_m, abs=1e-3)
    assert m.gsd_m == pytest.approx(100 / 64, rel=0.1)
    latitudes = [lat for lat, _ in m.extent]
    assert max(latitudes) - min(latitudes) == pytest.approx(400 / 111_194, rel=0.02)


def test_texture_keeps_its_orientation(tmp_path, make, build):
    positions, uvs, faces = make.patch(-50, -50, 100, 2)
    image = np.zeros((64, 64, 3), np.uint8)
    image[:8, :8] = (0, 0, 255)  # red (BGR) in the north-west corner
    png = cv2.imencode(".png", image)[1].tobytes()
    content = make.glb(make.y_up(positions), uvs, faces, png, "image/png")
    mesh = build(single_tile(make, tmp_path / "s", content)).load_tile(0)
    northwest = np.argmin(mesh.positions[:, 0] - mesh.positions[:, 1])
    u, v = mesh.uvs[northwest]
    assert (u, v) == pytest.approx((0, 0))
    assert mesh.mips[0][2, 2, 0] > 200
    assert mesh.mips[0][40, 40].max() < 20


@pytest.mark.parametrize("mime", [".png", ".webp", ".jpg"])
def test_image_formats(tmp_path, make, build, mime):
    positions, uvs, faces = make.patch(-50, -50, 100, 2)
    image = make.picture(3, extension=mime)
    extra = {}
    if mime == ".webp":
        textures = [{"extensions": {"EXT_texture_webp": {"source": 0}}}]
        extra = {"textures": textures, "extensionsRequired": ["EXT_texture_webp"]}
    content = make.glb(make.y_up(positions), uvs, faces, image, f"image/{mime[1:]}", **extra)
    mesh = build(single_tile(make, tmp_path / "s", content)).load_tile(0)
    decoded = cv2.cvtColor(cv2.imdecode(np.frombuffer(image, np.uint8), 1), cv2.COLOR_BGR2RGB)
    assert np.abs(mesh.mips[0].astype(int) - decoded).mean() < 3


def test_draco_and_b3dm_with_rtc_center(tmp_path, make, build):
    positions, uvs, faces = make.patch(-50, -50, 100, 4)
    shift = np.array([30.0, -20.0, 5.0])  # z-up, as RTC_CENTER is
    data = DracoPy.encode(make.y_up(positions - shift), faces, tex_coord=uvs, quantization_bits=16)
    primitive = {
        "attributes": {"POSITION": 0, "TEXCOORD_0": 1},
        "indices": 2,
        "material": 0,
        "extensions": {
            "KHR_draco_mesh_compression": {
                "bufferView": 4,
                "attributes": {"POSITION": 1, "TEXCOORD_0": 0},  # DracoPy's unique ids
            }
        },
    }
    document, binary = unpack_glb(make.glb(make.y_up(positions), uvs, faces, make.picture(1)))
    document["bufferViews"].append(
        {"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)}
    )
    document["meshes"] = [{"primitives": [primitive]}]
    document["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    content = pack_glb(document, binary + data)
    tileset = single_tile(make, tmp_path / "s", make.b3dm(content, shift.tolist()), "t.b3dm")
    points = world_vertices(build(tileset))
    assert np.abs(points[:, 2] - make.height(points[:, 0], points[:, 1])).max() < 0.02
    assert points[:, 0].min() == pytest.approx(-50, abs=0.01)


def test_node_and_tile_transforms_and_quantisation(tmp_path, make, build):
    positions, uvs, faces = make.patch(-50, -50, 100, 4)
    low, span = -60.0, 120.0
    q = np.rint((make.y_up(positions) - low) / span * 32767).astype(np.int16)
    padded = np.zeros((len(q), 4), np.int16)
    padded[:, :3] = q
    # Same bytes a vertex as two floats, so the short positions fit into the first view.
    document, binary = unpack_glb(make.glb(np.zeros((len(q), 2)), uvs, faces, make.picture(1)))
    document["bufferViews"][0]["byteStride"] = 8
    document["accessors"][0] |= {"componentType": 5122, "normalized": True}
    document["extensionsRequired"] = ["KHR_mesh_quantization"]
    document["nodes"] = [{"children": [1], "translation": [7, 0, 0]}, {"mesh": 0}]
    document["nodes"][1] |= {"scale": [span] * 3, "translation": [low - 7, low, low]}
    content = pack_glb(document, padded.tobytes() + binary[padded.nbytes :])
    points = world_vertices(build(single_tile(make, tmp_path / "s", content)))
    assert np.abs(points[:, 2] - make.height(points[:, 0], points[:, 1])).max() < 0.02


def test_external_tileset_and_transform_chain(tmp_path, make, build):
    positions, uvs, faces = make.patch(-50, -50, 100, 4)
    shift = np.array([100.0, 40.0, -3.0])
    inner = tmp_path / "s" / "inner"
    root = {"content": {"url": "a%20b.glb"}, "transform": None, "boundingVolume": None}
    write_tree(inner, root)
    content = make.glb(make.y_up(positions - shift), uvs, faces, make.picture(1))
    (inner / "a b.glb").write_bytes(content)
    move = Pose(np.eye(3), shift).matrix.T.ravel().tolist()
    children = [{"transform": move, "geometricError": 1, "content": {"uri": "inner/tileset.json"}}]
    asset = {"version": "1.0", "extras": {"geoid_separation_m": make.separation}}
    tileset = write_tree(tmp_path / "s", {"children": children}, asset=asset)
    points = world_vertices(build(tileset))
    assert np.abs(points[:, 2] - make.height(points[:, 0], points[:, 1])).max() < 1e-3


def test_missing_children_leave_the_parent_in_view(tmp_path, make, build):
    source = make.tileset(tmp_path / "s")
    leaf = next((tmp_path / "s").glob("2_*.glb"))
    leaf.unlink()
    with pytest.raises(MapSourceError, match=leaf.name):
        build(source)
    assert not (tmp_path / "cache").exists()
    cache = build(source, skip_bad_tiles=True)
    assert list(cache.manifest.skipped) == [leaf.name]
    # The leaf's parent keeps its own surface: its other three children are left out.
    assert cache.manifest.tiles == 17
    assert int((cache.index.child_count == 0).sum()) == 13


def test_the_geoid_separation_is_computed_and_compared(tmp_path, make):
    source = make.tileset(tmp_path / "s")
    document = json.loads(source.read_text())
    del document["asset"]["extras"]
    source.write_text(json.dumps(document))
    manifest = build_cache(source, tmp_path / "none given", BuildOptions(workers=1))
    assert manifest.geoid_separation_m == pytest.approx(47.75, abs=0.01)
    with pytest.raises(GeoreferenceError, match=r"given .* is 20.00 m, EGM96's .* is 47.75 m"):
        build_cache(source, tmp_path / "c", BuildOptions(geoid_separation_m=20, workers=1))
    with pytest.raises(GeoreferenceError, match="does not occur"):
        build_cache(source, tmp_path / "c", BuildOptions(geoid_separation_m=900, workers=1))


@pytest.mark.parametrize(("west", "east"), [(177.99, 178.01), (179.99, -179.99)])
def test_a_map_across_the_date_line_has_its_origin_there(tmp_path, make, west, east):
    region = [*np.radians([west, -16.81, east, -16.79]).tolist(), 50.0, 90.0]
    source = single_tile(
        make, tmp_path / "s", flat_patch(make)[1], boundingVolume={"region": region}, transform=None
    )
    latitude, longitude, height = geodetic_from_ecef(read_tileset(source).centre)
    assert (latitude, height) == pytest.approx((-16.8, 50.0), abs=1e-6)
    assert (longitude - west) % 360.0 == pytest.approx((east - west) % 360.0 / 2, abs=1e-6)


def test_a_tileset_that_is_not_on_earth_is_an_error(tmp_path, make, build):
    source = make.tileset(tmp_path / "s")
    document = json.loads(source.read_text())
    del document["root"]["transform"]
    source.write_text(json.dumps(document))
    with pytest.raises(GeoreferenceError, match="not placed on Earth"):
        build(source)


def test_existing_cache_is_kept_unless_told(source, cache_path):
    with pytest.raises(MapCacheError, match=r"exists already.*--overwrite"):
        build_cache(source, cache_path, BuildOptions(workers=1))


HOSTILE_TILESETS = {
    "no json": b"\xff\xfe not json",
    "deep json": b"[" * 200_000,
    "array": b"[]",
    "no root": b'{"asset": {"version": "1.0"}}',
    "version": b'{"asset": {"version": "9"}, "root": {}}',
    "cycle": b'{"asset": {"version": "1.0"}, "root": {"content": {"uri": "tileset.json"}}}',
    "escape": b'{"asset": {"version": "1.0"}, "root": {"content": {"uri": "../../secret.b3dm"}}}',
    "absolute": b'{"asset": {"version": "1.0"}, "root": {"content": {"uri": "/etc/passwd"}}}',
    "nul": b'{"asset": {"version": "1.0"}, "root": {"content": {"uri": "a\\u0000b.glb"}}}',
    "uri": b'{"asset": {"version": "1.0"}, "root": {"content": {"uri": 5}}}',
    "implicit": b'{"asset": {"version": "1.1"}, "root": {"implicitTiling": {}}}',
    "error": b'{"asset": {"version": "1.0"}, "root": {"geometricError": -1}}',
    "nan": b'{"asset": {"version": "1.0"}, "root": {"geometricError": NaN}}',
    "transform": b'{"asset": {"version": "1.0"}, "root": {"transform": [1, 2]}}',
    "children": b'{"asset": {"version": "1.0"}, "root": {"children": [5]}}',
    "volume": b'{"asset": {"version": "1.0"}, "root": {"boundingVolume": {"box": ["x"]}}}',
    "asset": b'{"asset": 5, "root": {}}',
}


@pytest.mark.parametrize("name", HOSTILE_TILESETS)
def test_hostile_tilesets_are_named_errors(tmp_path, name):
    path = tmp_path / "s" / "tileset.json"
    path.parent.mkdir()
    path.write_bytes(HOSTILE_TILESETS[name])
    with pytest.raises(MapSourceError, match=r"."):
        read_tileset(path)


def test_symbolic_link_out_of_the_folder_is_refused(tmp_path, make):
    outside = tmp_path / "outside.glb"
    outside.write_bytes(b"glTF")
    folder = tmp_path / "s"
    source = single_tile(make, folder, b"")
    (folder / "tile.glb").unlink()
    (folder / "tile.glb").symlink_to(outside)
    with pytest.raises(MapSourceError, match="leaves the tileset"):
        read_tileset(source)


def edited(content: bytes, change) -> bytes:
    """A GLB with its JSON changed."""
    document, binary = unpack_glb(content)
    change(document)
    return pack_glb(document, binary)


HOSTILE_EDITS = {
    "count beyond the buffer": lambda d: d["accessors"][0].update(count=10**6),
    "absurd count": lambda d: d["accessors"][0].update(count=10**18),
    "negative count": lambda d: d["accessors"][0].update(count=-1),
    "fractional offset": lambda d: d["bufferViews"][0].update(byteOffset=0.5),
    "view beyond the buffer": lambda d: d["bufferViews"][2].update(byteLength=10**12),
    "unknown type": lambda d: d["accessors"][0].update(type="VEC9"),
    "indices as floats": lambda d: d["accessors"][2].update(componentType=5126),
    "node cycle": lambda d: d["nodes"][0].update(children=[0]),
    "no such mesh": lambda d: d["nodes"][0].update(mesh=7),
    "bool as index": lambda d: d["nodes"][0].update(mesh="0"),
    "no position": lambda d: d["meshes"][0]["primitives"][0].update(attributes={}),
    "unknown extension": lambda d: d.update(extensionsRequired=["KHR_texture_basisu"]),
    "basisu only": lambda d: d.update(textures=[{"extensions": {"KHR_texture_basisu": {}}}]),
    "meshopt": lambda d: d["bufferViews"][0].update(extensions={"EXT_meshopt_compression": {}}),
    "image outside": lambda d: d.update(images=[{"uri": "../../x.png"}]),
    "bad base64": lambda d: d.update(images=[{"uri": "data:image/png;base64,@@@"}]),
    "scale": lambda d: d["nodes"][0].update(scale=["a", 1, 1]),
    "rotation": lambda d: d["nodes"][0].update(rotation=[0, 0, 0, 0]),
    "sparse": lambda d: d["accessors"][0].update(sparse={}),
    "nodes as a number": lambda d: d.update(nodes=5),
    "primitives as a string": lambda d: d["meshes"][0].update(primitives="x"),
    "attributes as a list": lambda d: d["meshes"][0]["primitives"][0].update(attributes=[1]),
    "scene without nodes": lambda d: d.update(scenes=[{"nodes": ["x"]}]),
}


@pytest.mark.parametrize("name", HOSTILE_EDITS)
def test_hostile_glb_is_a_named_error_and_leaves_no_cache(tmp_path, make, build, name):
    _, content = flat_patch(make)
    source = single_tile(make, tmp_path / "s", edited(content, HOSTILE_EDITS[name]))
    with pytest.raises(MapSourceError, match=r"tile\.glb"):
        build(source)
    assert not (tmp_path / "cache").exists()


def test_not_finite_positions_are_refused(make):
    positions, uvs, faces = make.patch(-50, -50, 100, 2)
    positions[3, 1] = np.nan
    with pytest.raises(MapSourceError, match="finite"):
        read_gltf(make.glb(positions, uvs, faces, make.picture(1)), no_files)


@pytest.mark.real
def test_malvern_names_its_missing_tiles(real_data, build):
    source = real_data("malvern") / "b3dmtileset.json"
    with pytest.raises(MapSourceError, match=r"356 tiles cannot be imported"):
        build(source, geoid_separation_m=-33.0)
    cache = build(source, geoid_separation_m=-33.0, skip_bad_tiles=True)
    assert len(cache.manifest.skipped) == 356
    assert cache.manifest.tiles <= 17
