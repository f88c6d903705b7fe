"""The file of sources is checked, chosen from, and easy to add to."""

from __future__ import annotations

from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
import yaml
from pyproj import CRS

pytest.importorskip("urllib3")
from localizer.errors import MapFetchError
from localizer.map.fetch.area import Area, area_around
from localizer.map.fetch.catalogue import CatalogueSource, choose, load_sources
from localizer.map.fetch.cloud import degree_files
from localizer.map.fetch.raster import FetchGrid
from localizer.map.fetch.tiles import wms_url
from localizer.map.importers.height_crs import utm_zone

BERN = area_around(np.array([[46.948, 7.447]]), 300.0)
SAHARA = area_around(np.array([[23.0, 5.0]]), 300.0)
MINE = {
    "name": "mine", "title": "my town", "kind": "wms", "role": "imagery",
    "url": "https://example.org/wms", "layer": "photo", "licence": "CC0", "attribution": "me",
    "country": "here", "bounds": [7.0, 46.0, 8.0, 47.5], "resolution_m": 0.05,
}  # fmt: skip


def test_the_shipped_file_holds_and_names_licence_and_attribution_of_each():
    sources = load_sources()
    assert len({s.country for s in sources}) >= 6
    assert len({s.name for s in sources}) == len(sources)
    for source in sources:
        assert source.licence
        assert source.attribution
        assert "\n" not in source.url
        assert " " not in source.url


def test_the_finest_there_is_chosen_and_the_world_comes_last():
    sources = load_sources()
    assert choose(sources, BERN, "imagery").name == "ch-swissimage"
    assert choose(sources, BERN, "heights").name == "ch-swisssurface3d"
    assert choose(sources, SAHARA, "heights").name == "copernicus-glo30"
    with pytest.raises(MapFetchError, match="no source of imagery covers"):
        choose(sources, SAHARA, "imagery")
    with pytest.raises(MapFetchError, match="nothing at"):
        choose(sources, SAHARA, "imagery", "ch-swissimage")
    with pytest.raises(MapFetchError, match="there are: "):
        choose(sources, BERN, "imagery", "copernicus-glo30")  # of heights


def test_a_file_of_ones_own_adds_and_replaces(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump({"sources": [MINE]}))
    sources = load_sources((path,))
    assert choose(sources, BERN, "imagery").name == "mine"
    path.write_text(yaml.safe_dump({"sources": [MINE | {"name": "ch-swissimage"}]}))
    (replaced,) = [s for s in load_sources((path,)) if s.name == "ch-swissimage"]
    assert replaced.title == "my town"


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"url": "https://mt1.google.com/vt?x={x}"}, "refused"),
        ({"kind": "xyz", "url": "https://t2.tiles.virtualearth.net/{z}/{x}/{y}"}, "refused"),
        ({"licence": ""}, "licence"),
        ({"layer": ""}, "layer"),
        ({"role": "surface"}, "vertical_datum"),
        ({"vertical_datum": "amsl"}, "vertical_datum"),
        ({"crs": "EPSG:999999"}, "crs"),
        ({"bounds": [8, 46, 7, 47]}, "bounds"),
        ({"colour": "red"}, "colour"),
        ({"rate_per_s": 1000}, "rate_per_s"),
        ({"kind": "xyz", "url": "https://example.org/{z}/{x}"}, "url"),
        *((text, r"mine\.yaml") for text in ("", "[]", "sources: 3", "a: [", "\0", "sources: [3]")),
    ],
)
def test_what_does_not_hold_is_named(tmp_path, change, why):
    path = tmp_path / "mine.yaml"
    path.write_text(
        change if isinstance(change, str) else yaml.safe_dump({"sources": [MINE | change]})
    )
    with pytest.raises(MapFetchError, match=why):
        load_sources((path,))


def test_the_worlds_model_is_asked_by_whole_degrees():
    (glo30,) = [s for s in load_sources() if s.name == "copernicus-glo30"]
    urls = [f.url for f in degree_files(glo30, Area(-0.1, -0.1, 0.1, 0.1))]
    assert sorted(u.split("COG_10_")[1][:15] for u in urls) == [
        "N00_00_E000_00_", "N00_00_W001_00_", "S01_00_E000_00_", "S01_00_W001_00_",
    ]  # fmt: skip


def test_areas():
    width, height = BERN.size_m
    assert width == pytest.approx(600, rel=0.01)
    assert height == pytest.approx(600, rel=0.01)
    assert utm_zone(*BERN.centre).to_epsg() == 32632
    for corners in ((8, 46, 7, 47), (7, 46, 7, 47), (0, 0, 90, 10), (float("nan"), 0, 1, 1)):
        with pytest.raises(MapFetchError):
            Area(*corners)


@pytest.mark.parametrize("version", ["1.1.1", "1.3.0"])
def test_a_wms_in_degrees_is_asked_to_a_millimetre_east_of_100_degrees_too(version):
    """Nine digits were 6 cm off there, and its picture says no place of its own."""
    source = CatalogueSource(**{**MINE, "crs": "EPSG:4326", "version": version})
    window = FetchGrid(
        CRS.from_epsg(4326), 151.2093123456, -33.8688197531, (2e-6, 2e-6), 1000, 1000
    )
    asked = parse_qs(urlsplit(wms_url(source, window)).query)["BBOX"][0]
    numbers = [float(v) for v in asked.split(",")]
    left, bottom, right, top = window.bounds
    wanted = (bottom, left, top, right) if version == "1.3.0" else (left, bottom, right, top)
    np.testing.assert_allclose(numbers, wanted, rtol=0, atol=5e-9)
