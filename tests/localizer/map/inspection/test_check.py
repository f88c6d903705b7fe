"""A map is examined before it is flown over: each fault is found, and a sound map has none."""

import math
import re
import shutil

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from companion.cli.commands import app
from localizer.errors import MapSourceError
from localizer.map.building import build
from localizer.map.building.options import BuildOptions
from localizer.map.cache.cache import TileCache
from localizer.map.importers.rules import ImportRules
from localizer.map.inspection.alignment import Mosaic, measure_alignment, render_mosaic, usable_part
from localizer.map.inspection.check import Grade, MapUse, check_map, find_seams
from tests.localizer.map.conftest import write_tileset, write_tree

FINE = MapUse(120.0, 0.004)
COLOURS = ((170, 60, 40), (120, 120, 130), (60, 110, 50), (190, 170, 120))


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    folder = tmp_path_factory.mktemp("map")
    options = BuildOptions(workers=1, imagery_date="2024-06")
    build.build_cache(write_tileset(folder), folder / "cache", options)
    return TileCache.open(folder / "cache")


def village(east_m=0.0, north_m=0.0, shadow_m=(4.0, 5.0), grey=False) -> Mosaic:
    """160 houses on a meadow, their picture moved, with shadows to one side; 0.5 m a pixel."""
    rng = np.random.default_rng(7)
    rgb = np.full((500, 500, 3), (70, 110, 55), np.float32)
    rgb += rng.normal(0, 6, rgb.shape).astype(np.float32)
    height = np.zeros((500, 500), np.float32)
    houses = [(*rng.integers(30, 460, 2), *rng.integers(12, 26, 2)) for _ in range(160)]
    dx, dy = round(east_m / 0.5), round(-north_m / 0.5)
    for x, y, w, h in houses:
        height[y : y + h, x : x + w] = 7.0
        sx, sy = (round(v / 0.5) for v in shadow_m)
        rgb[y + dy + sy : y + dy + sy + h, x + dx + sx : x + dx + sx + w] *= 0.35
    for k, (x, y, w, h) in enumerate(houses):
        rgb[y + dy : y + dy + h, x + dx : x + dx + w] = COLOURS[k % 4]
    if grey:
        rgb = np.repeat(rgb.mean(axis=2, keepdims=True), 3, axis=2)
    return Mosaic(np.clip(rgb, 0, 255).astype(np.uint8), height, 0.0, 0.0, 0.5)


@pytest.mark.parametrize(("east", "north"), [(0.0, 0.0), (4.0, -3.0), (-6.0, 2.0)])
def test_a_moved_picture_is_measured_and_shadows_are_no_shift(east, north):
    found = measure_alignment(village(east, north))
    assert found.known
    assert (found.east_m, found.north_m) == pytest.approx((east, north), abs=0.5)


def test_without_houses_or_without_colour_nothing_is_said():
    flat = village()
    flat.height[:] = 0.0
    assert not measure_alignment(flat).known
    assert not measure_alignment(village(4.0, 0.0, grey=True)).known


def test_a_sound_map_is_good(cache):
    made = {f.name: f for f in check_map(cache, FINE).findings}
    assert [n for n, f in made.items() if f.grade is Grade.BAD] == []
    assert made["coverage"].found.startswith("0.159 km², 99 %")
    assert (made["imagery of"].found, made["imagery of"].grade) == ("2024-06", Grade.GOOD)


def test_a_damaged_tile_is_told_though_its_pictures_do_without_it(cache, tmp_path):
    shutil.copytree(cache.path, tmp_path / "map")
    hurt = TileCache.open(tmp_path / "map")
    path = hurt.tile_path(0)  # of the root: no view from above needs it
    path.write_bytes(path.read_bytes()[:-1])
    made = check_map(hurt, FINE)
    damaged = made.findings[0]
    assert not made.ok
    assert (damaged.name, damaged.grade) == ("damaged", Grade.BAD)
    assert path.name in damaged.words


def test_a_date_that_is_none_is_refused_before_the_build(tmp_path):
    options = BuildOptions(workers=1, imagery_date="June 2024")
    with pytest.raises(MapSourceError, match="'June 2024': give a year"):
        build.build_cache(write_tileset(tmp_path), tmp_path / "cache", options)


def test_texels_are_judged_by_the_height_that_is_flown(cache):
    def grade(height_m):
        found = check_map(cache, MapUse(height_m, 0.004)).findings
        return next(f.grade for f in found if f.name == "texel size")

    gsd = float(np.median(cache.index.gsd[cache.index.child_count == 0]))
    assert grade(gsd / 0.004) is Grade.GOOD
    assert grade(gsd / 0.004 / 3) is Grade.ADVICE
    assert grade(gsd / 0.004 / 8) is Grade.BAD


def test_seams_show_where_tiles_do_not_meet(cache):
    mosaic = render_mosaic(cache, 200_000)
    assert max(s.height_m for s in find_seams(cache, mosaic)) < 0.2
    column = round(mosaic.pixel(0.0, 0.0)[1])
    mosaic.height[:, column:] += 2.0
    seen = [s for s in find_seams(cache, mosaic) if s.height_m > 0.5]
    assert all(s.seen for s in seen)
    assert seen
    assert {s.ends[0][1] for s in seen} == {column}
    assert max(s.height_m for s in seen) == pytest.approx(2.0, abs=0.2)


def test_the_command_says_it_in_words_pictures_and_its_exit_code(cache, tmp_path):
    good = CliRunner().invoke(app, ["map", "check", str(cache.path), "--out", str(tmp_path / "a")])
    assert good.exit_code == 0, good.output
    assert re.search(r"will do where it is: \d+ x \d+ m, \d+ s of flight", good.output)
    names = {p.name for p in (tmp_path / "a").iterdir()}
    assert names == {"coverage.png", "texels.png", "seams.png", "alignment.png"}
    assert cv2.imread(str(tmp_path / "a" / "coverage.png")) is not None
    low = ["map", "check", str(cache.path), "--out", str(tmp_path / "b"), "--height", "5"]
    bad = CliRunner().invoke(app, low)
    assert bad.exit_code == 1
    assert "will not do: texel size" in bad.output
    assert "No part of it is usable." in bad.output


def test_of_a_map_with_bad_edges_the_usable_middle_is_named(cache):
    """Until then a map that failed by its edges was only told to fail."""
    mosaic = render_mosaic(cache, 200_000)
    faulty = np.isnan(mosaic.height)
    rows, columns = faulty.shape
    assert usable_part(mosaic, faulty, 120.0, cache.frame).is_whole
    faulty[: rows // 4] = True
    faulty[:, : columns // 2] = True
    faulty[-1, -1] = True  # a hole that does no harm
    found = usable_part(mosaic, faulty, 120.0, cache.frame)
    assert not found.is_whole
    assert found.size_m == pytest.approx((200.0, 300.0), abs=16.0)
    for north, east, inside in ((0.0, 100.0, True), (0.0, -20.0, False), (150.0, 100.0, False)):
        at = cache.frame.position(np.array([east, north, 0.0]))
        lies = found.box.south < at.latitude_deg < found.box.north
        assert (lies and found.box.west < at.longitude_deg < found.box.east) is inside
    assert usable_part(mosaic, np.ones_like(faulty), 120.0, cache.frame) is None


def built_from(folder, make, *, up="y", trusted=(), image=None, materials=None):
    """A map of one tile, which may stand on its edge, of one colour or without a picture."""
    positions, uvs, faces = make.patch(-100, -100, 200, 16)
    turned = make.y_up(positions) if up == "y" else positions
    extra = {} if materials is None else {"materials": materials}
    folder.mkdir()
    (folder / "t.glb").write_bytes(make.glb(turned, uvs, faces, image or make.picture(3), **extra))
    root = {"boundingVolume": {"sphere": [0, 0, 0, 200]}, "content": {"uri": "t.glb"}}
    source = write_tree(folder, root)
    rules = ImportRules(trusted=frozenset(trusted))
    build.build_cache(source, folder / "c", BuildOptions(workers=1, rules=rules))
    found = check_map(TileCache.open(folder / "c"), FINE)
    return {f.name: f for f in found.findings} | {"usable": found.usable}


def test_a_map_on_its_edge_will_not_do(tmp_path, make):
    """One that was built before builds looked, or in spite of them."""
    made = built_from(tmp_path / "a", make, up="z", trusted=["upright", "volume"])
    assert (made["ground"].grade, made["ground"].found) == (Grade.BAD, "stands on its edge")
    assert "stands on its edge" in made["build warnings"].words
    assert made["usable"] is None
    assert built_from(tmp_path / "b", make)["ground"].grade is Grade.GOOD


def test_a_map_of_colours_has_no_picture(tmp_path, make):
    green = [{"pbrMetallicRoughness": {"baseColorFactor": [0.2, 0.5, 0.1, 1]}}]
    made = built_from(tmp_path / "a", make, materials=green)
    del made["usable"]
    assert {n for n, f in made.items() if f.grade is Grade.BAD} == {"without imagery", "texel size"}
    assert "imagery detail" not in made
    assert made["without imagery"].found.startswith("100.00 %")
    plain = cv2.imencode(".png", np.full((64, 64, 3), (40, 120, 60), np.uint8))[1].tobytes()
    made = built_from(tmp_path / "b", make, image=plain)
    assert made["without imagery"].grade is Grade.BAD
    assert built_from(tmp_path / "c", make)["without imagery"].grade is Grade.GOOD


def test_a_working_pixel_finer_than_the_detail_is_named_with_the_width_that_is_not(cache):
    """What benchmarks.real shows of fengyuan at 640 px and NEON at 320: frames are refused."""
    resolved = cache.manifest.kind.effective_resolution_m
    half_deg, width = 32.5, 320

    def detail(pixels):
        pixel_rad = 2 * math.tan(math.radians(half_deg)) / width
        use = MapUse(resolved / pixels / pixel_rad, pixel_rad, half_deg)
        return next(f for f in check_map(cache, use).findings if f.name == "imagery detail")

    assert detail(0.9).grade is Grade.GOOD
    assert detail(1.5).grade is Grade.ADVICE
    assert "localizer.width to 208," in detail(1.5).words
