"""Meshes with a georeference: where they stand, how they are cut, the levels made for them."""

# ruff: noqa: RUF005 (sums of arrays are meant, not lists)

from __future__ import annotations

import cv2
import numpy as np
import pytest

from localizer.errors import GeoreferenceError, MapSourceError
from localizer.geometry.camera import Camera
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Pose
from localizer.map.cache.stream import TileStreamer
from localizer.map.importers.georeference import Georeference, ecef_from_crs, read_georeference
from localizer.map.importers.heightmesh import height_mesh
from localizer.render.numba_raster import NumbaRenderer
from tests.localizer.map.conftest import built, leaf_meshes, write_obj

DATUM = {"geoid_separation_m": 48.0, "vertical_datum": "ellipsoidal"}
DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])


def picture(size=1500):
    """Red grows to the east, green to the south."""
    ramp = np.linspace(0, 255, size)
    image = np.full((size, size, 3), 90, np.uint8)
    image[..., 2], image[..., 1] = ramp[None], ramp[:, None]
    return image


@pytest.fixture(scope="module")
def glb(make, tmp_path_factory):
    positions, uvs, faces = make.patch(-100, -100, 200, 60)
    path = tmp_path_factory.mktemp("mesh") / "model.glb"
    png = cv2.imencode(".png", picture())[1].tobytes()
    path.write_bytes(make.glb(make.y_up(positions), uvs, faces, png, "image/png"))
    return path


@pytest.fixture(scope="module")
def cache(glb, make):
    """Of the model; read only."""
    return built(
        glb, glb.with_name("cache"), georeference=Georeference(origin=make.origin), **DATUM
    )


def test_vertices_stand_about_the_origin(cache, make):
    points = np.concatenate([m.world_from_tile.apply(m.positions) for m in leaf_meshes(cache)])
    assert np.abs(points[:, 2] - make.height(points[:, 0], points[:, 1])).max() < 1e-3
    assert cache.manifest.origin.height_m == pytest.approx(make.origin.height_m, abs=1e-3)
    assert sum(len(m.faces) for m in leaf_meshes(cache)) == 2 * 60 * 60


def test_heading_turns_clockwise():
    origin = Geodetic(47.0, 8.0, 100.0)
    east = Georeference(origin=origin, heading_deg=90.0).ecef(np.array([[0.0, 10.0, 1.0]]))
    enu = LocalFrame(origin).ecef_from_enu.inverse.apply(east)
    assert enu[0] == pytest.approx([10, 0, 1], abs=1e-6)


def test_tiles_show_their_part_of_the_texture(cache, make):
    assert cache.manifest.levels >= 2
    for mesh in leaf_meshes(cache):
        assert mesh.mips[0].size < picture().size / 3
        points = mesh.world_from_tile.apply(mesh.positions)
        h, w = mesh.mips[0].shape[:2]
        x = np.clip((mesh.uvs[:, 0] * w).astype(int), 0, w - 1)
        y = np.clip((mesh.uvs[:, 1] * h).astype(int), 0, h - 1)
        red, green = mesh.mips[0][y, x, 0], mesh.mips[0][y, x, 1]
        assert np.abs(red / 255.0 * 200 - 100 - points[:, 0]).max() < 4
        assert np.abs(100 - green / 255.0 * 200 - points[:, 1]).max() < 4


def test_obj_with_odm_offsets(tmp_path, make, build):
    positions, uvs, faces = make.patch(0, 0, 60, 6)
    cv2.imwrite(str(tmp_path / "m.png"), picture(128))
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd m.png\n")
    write_obj(tmp_path, positions, uvs, faces)
    offset = tmp_path / "coords.txt"
    offset.write_text("WGS84 UTM 32N\n500100 5228300\n")
    cache = build(tmp_path / "m.obj", georeference=offset, **DATUM)
    (mesh,) = leaf_meshes(cache)
    points = mesh.world_from_tile.apply(mesh.positions)
    expected = ecef_from_crs("EPSG:32632", positions + [500100, 5228300, 0])
    expected = cache.frame.ecef_from_enu.inverse.apply(expected)
    for point in expected[::7]:
        assert np.linalg.norm(points - point, axis=1).min() < 2e-3
    corner = np.argmin(points[:, 0] - points[:, 1])  # north-west
    assert mesh.uvs[corner] == pytest.approx((0, 0), abs=0.1)


def test_georeference_files(tmp_path):
    path = tmp_path / "g.json"
    path.write_text('{"origin": {"lat": 30.1, "lon": -98.0, "height": 373.8}, "note": "x"}')
    assert read_georeference(path).origin == Geodetic(30.1, -98.0, 373.8)
    path.write_text('{"epsg": 32614, "offset": [1, 2, 3]}')
    assert read_georeference(path).offset == (1.0, 2.0, 3.0)
    degrees, feet = (f'{{"epsg": {epsg}, "offset": [985000, 210000, 0]}}' for epsg in (4326, 2263))
    for bad in ("", "{}", degrees, feet, "WGS84 UTM 99N\n1 2", "{", "\0"):
        path.write_text(bad)
        with pytest.raises(GeoreferenceError, match="not a georeference"):
            read_georeference(path)
    with pytest.raises(GeoreferenceError, match="cannot be read"):
        read_georeference(tmp_path / "none.json")


def test_a_mesh_needs_a_georeference(glb, build):
    with pytest.raises(GeoreferenceError, match="where on Earth"):
        build(glb, **DATUM)


def test_broken_meshes_are_named(tmp_path, make, build):
    reference = Georeference(origin=make.origin)
    for name, data in (("a.glb", b"glTF"), ("b.obj", b"v 1 2\nf 1 2 9\n"), ("c.obj", b"")):
        path = tmp_path / name
        path.write_bytes(data)
        with pytest.raises(MapSourceError):
            build(path, georeference=reference, **DATUM)


@pytest.mark.parametrize(
    ("vertex", "texture", "told"),
    [
        ("v nan 0 0", "vt 0 0", "m.obj: a position is not finite"),
        ("v 0 0 0", "vt nan 0", "m.obj: a texture coordinate"),
        ("v 0 0 0", "vt 1e30 0", "m.obj: a texture coordinate"),
    ],
)
def test_numbers_that_would_lead_kernels_astray_are_named(
    tmp_path, make, build, vertex, texture, told
):
    cv2.imwrite(str(tmp_path / "m.png"), picture(16))
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd m.png\n")
    lines = ["mtllib m.mtl", "usemtl a", vertex, "v 10 0 0", "v 0 10 0", texture]
    lines += ["vt 1 0", "vt 0 1", "f 1/1 2/2 3/3"]
    (tmp_path / "m.obj").write_text("\n".join(lines))
    with pytest.raises(MapSourceError, match=told):
        build(tmp_path / "m.obj", georeference=Georeference(origin=make.origin), **DATUM)


@pytest.mark.real
def test_caliterra_stands_where_its_photos_were_taken(real_data, build):
    folder = real_data("caliterra")
    cache = build(
        folder / "mesh.glb",
        georeference=folder / "georef.json",
        up_axis="z",
        vertical_datum="ellipsoidal",
    )
    import json

    poses = json.loads((folder / "queries/poses.json").read_text())
    data = json.loads((folder / "queries/camera.json").read_text())
    camera = Camera.from_dict(data).resized(512, 384)
    name = sorted(poses)[4]
    photo = cv2.imread(str(folder / "queries/images" / name), cv2.IMREAD_GRAYSCALE)
    photo = cv2.resize(photo, (512, 384), interpolation=cv2.INTER_AREA).astype(float)
    with TileStreamer(cache) as streamer:
        renderer = NumbaRenderer(streamer, threads=1)
        view = renderer.render(Pose.from_matrix(poses[name]["T_enu_from_cam"]), camera, wait=True)
    shown = view.depth > 0
    drawn = cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY).astype(float)
    assert shown.mean() > 0.8
    assert np.corrcoef(photo[shown], drawn[shown])[0, 1] > 0.9


# --- Height fields to meshes: what simplification may take away, and what not -------------------


_CELLS, _STEP = 32, 0.5


def _made(seed: int, unknown: tuple[int, int] | None = None) -> tuple[np.ndarray, np.ndarray]:
    rough = np.random.default_rng(seed).normal(size=(_CELLS + 1, _CELLS + 1))
    mask = np.zeros(rough.shape, bool)
    if unknown is not None:
        mask[unknown] = True
    heights = np.ma.masked_array(0.02 * rough.cumsum(0).cumsum(1), mask)
    made = height_mesh(heights, np.ones((64, 64), bool), (_STEP, _STEP), lossless=False)
    assert made is not None
    return made


def _area(points: np.ndarray, faces: np.ndarray) -> float:
    (x1, y1), (x2, y2) = ((points[faces[:, k], :2] - points[faces[:, 0], :2]).T for k in (1, 2))
    return float((x1 * y2 - x2 * y1).sum() / 2)


@pytest.mark.parametrize("seed", range(8))
def test_a_tile_keeps_its_corners(seed):
    # Else the ground had a hole of about a metre wherever four such tiles meet.
    points, faces = _made(seed)
    side = _CELLS * _STEP
    for corner in ((0, 0), (side, 0), (0, -side), (side, -side)):
        assert np.abs(points[:, :2] - corner).max(axis=1).min() < 1e-6
    assert _area(points, faces) == pytest.approx(side * side, rel=1e-6)


def test_a_corner_that_nobody_knows_is_not_made_up():
    points, _ = _made(0, unknown=(0, 0))
    assert np.abs(points[:, :2]).max(axis=1).min() > 0.1 * _STEP
