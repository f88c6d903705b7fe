"""What kind of map it is: heights with or without buildings, and how fine its imagery is."""

from __future__ import annotations

import json
from datetime import date

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from localizer.map.cache.cache import MANIFEST_NAME, TileCache
from localizer.map.inspection.kind import map_kind
from localizer.map.kind import MapKind
from tests.localizer.map.conftest import built, cut_out, write_raster

STEP_M, TEXEL_M, SIDE_M = 1.0, 0.25, 200.0


def natural(blur_px: float) -> np.ndarray:
    """Imagery whose power falls as that of natural ground, blurred, with a little noise."""
    n = round(SIDE_M / TEXEL_M)
    rng = np.random.default_rng(3)
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(n), np.fft.fftfreq(n)))
    frequency[0, 0] = 1.0
    field = np.fft.ifft2(np.fft.fft2(rng.normal(size=(n, n))) * frequency**-1.25).real
    grey = (
        gaussian_filter(127 + 40 * field / field.std(), blur_px)
        if blur_px
        else 127 + (40 * field / field.std())
    )
    return np.clip(grey + rng.normal(0, 0.3, grey.shape), 0, 255).astype(np.uint8)


def hills() -> np.ndarray:
    """Slopes of up to 30 degrees, without anything on them."""
    s = np.arange(round(SIDE_M / STEP_M)) * STEP_M
    return 400 + 18 * np.sin(s / 35)[None] + 8 * np.cos(s / 25)[:, None]


def houses(heights: np.ndarray) -> np.ndarray:
    """Four houses of 8 m: half a percent of the ground."""
    built = heights.copy()
    for row, column in ((30, 40), (90, 150), (140, 60), (160, 120)):
        part = (slice(row, row + 8), slice(column, column + 10))
        built[part] = heights[part].min() + 8.0
    return built


def map_of(folder, surface, blur_px=0.0, tags=(), **options) -> TileCache:
    sources = (
        write_raster(folder / "dsm.tif", surface.astype(np.float32)),
        write_raster(folder / "ortho.tif", natural(blur_px), step=TEXEL_M, tags=dict(tags)),
    )
    return built(sources, folder / "cache", vertical_datum="ellipsoidal", **options)


@pytest.mark.parametrize(
    ("heights", "expected"),
    [(houses(hills()), "surface"), (hills(), "terrain"), (np.full((200, 200), 400.0), "flat")],
    ids=["houses", "hills", "plane"],
)
def test_buildings_are_told_from_slopes_and_slopes_from_a_plane(tmp_path, heights, expected):
    kind = map_of(tmp_path, heights).manifest.kind
    assert kind.heights == expected
    assert kind.has_buildings == (expected == "surface")
    assert (kind.unknown_height_sigma_m < 1.0) == (expected == "surface")


def test_blurred_imagery_resolves_what_its_blur_leaves(tmp_path):
    """A Gaussian of s pixels keeps a tenth of the contrast at 0.342 / s cycles a pixel."""
    for name, blur_px, expected_m in (("sharp", 0.0, 0.25), ("soft", 2.0, 0.25 * 2.0 / 0.684)):
        folder = tmp_path / name
        folder.mkdir()
        kind = map_of(folder, hills(), blur_px).manifest.kind
        assert kind.effective_resolution_m == pytest.approx(expected_m, rel=0.15)


def test_the_source_and_its_owner_say_what_cannot_be_measured(tmp_path):
    tags = {"ACQUISITIONDATETIME": "2023-07-14T09:12:55", "SATELLITEID": "PHR1B"}
    kind = map_of(tmp_path, hills(), tags=tags.items(), heights="surface").manifest.kind
    assert (kind.imagery_date, kind.sensor, kind.heights) == ("2023-07-14", "PHR1B", "surface")


def test_a_cache_of_an_older_build_is_read_and_measured_when_asked(tmp_path):
    cache = map_of(tmp_path, houses(hills()))
    path = cache.path / MANIFEST_NAME
    manifest = json.loads(path.read_text())
    del manifest["kind"]
    manifest["build"]["imagery_date"] = "2019-05"
    path.write_text(json.dumps(manifest))
    old = TileCache.open(cache.path)
    assert old.manifest.kind is None
    found = map_kind(old)
    assert (found.heights, found.imagery_date) == ("surface", "2019-05")
    assert found.effective_resolution_m == cache.manifest.kind.effective_resolution_m


@pytest.mark.parametrize(
    ("stated", "words", "recent"),
    [
        ("2024-06-30", "2024-06-30 (100 days ago)", True),
        ("2024-06", "2024-06 (129 days ago)", True),  # by the first of the month
        ("2024", "2024 (281 days ago)", False),
        ("2024-02-31", "2024-02-31 is no date", False),
        (None, "date not known", False),
    ],
)
def test_the_imagerys_age(stated, words, recent):
    kind = MapKind("surface", 0.3, 0.1, stated)
    assert kind.imagery_age(date(2024, 10, 8), 200) == (words, recent)


def test_a_sensors_name_cannot_steer_the_terminal():
    assert "\x1b" not in MapKind("surface", 0.3, 0.1, None, "PHR\x1b[2J1B").line()


@pytest.mark.real
@pytest.mark.parametrize(
    ("name", "share", "files", "heights", "least_m", "most_m"),
    [
        ("fengyuan", 0.25, ("ground.tif", "ortho.tif"), "flat", 0.35, 0.55),
        ("caliterra", 1.0, ("dsm.tif", "ortho.tif"), "surface", 0.0625, 0.1),
    ],
)
def test_real_maps_are_what_their_makers_say(
    tmp_path, real_data, name, share, files, heights, least_m, most_m
):
    sources = [cut_out(real_data(name) / file, tmp_path / file, share) for file in files]
    kind = built(sources, tmp_path / "map", vertical_datum="ellipsoidal").manifest.kind
    assert kind.heights == heights
    assert least_m <= kind.effective_resolution_m <= most_m
