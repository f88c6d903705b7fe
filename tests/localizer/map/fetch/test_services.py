"""Each kind of service gives the world that it serves, where it is and as high as it is."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import rasterio
from PIL import Image
from pyproj import Transformer

pytest.importorskip("owslib")
pytest.importorskip("pystac")
from localizer.errors import MapFetchError
from localizer.map.fetch.area import Area
from localizer.map.fetch.catalogue import CatalogueSource
from localizer.map.fetch.cloud import CloudFile, plan_files
from localizer.map.fetch.fetch import check_piece, fetch, make_plan
from localizer.map.fetch.http_client import HttpClient
from localizer.map.fetch.raster import Piece
from tests.localizer.map.fetch.loopback import (
    CRS,
    MAPSERV,
    colour,
    geographic,
    height_m,
    rectangle,
    serving,
    wmts_capabilities,
    write_map_file,
    write_stac,
    write_world,
)

AREA = Area(*rectangle())
mapserver = pytest.mark.skipif(
    not Path(MAPSERV).exists(), reason="no MapServer here: apt install cgi-mapserver"
)


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    folder = write_world(tmp_path_factory.mktemp("world"))
    with serving(folder) as served:
        write_map_file(folder, served.url)
        served.catalogue.items = write_stac(folder, served.url)
        (folder / "wmts.xml").write_text(wmts_capabilities(served.url))
        yield served


def source(kind: str, url: str, **more: object) -> CatalogueSource:
    role = more.pop("role", "imagery")
    given = {
        "name": "here", "title": "the world", "kind": kind, "role": role, "url": url,
        "licence": "none: loopback", "attribution": "the tests", "country": "nowhere",
        "bounds": rectangle(0.0), "resolution_m": 0.5 if role == "imagery" else 1.0,
        "rate_per_s": 50.0, "vertical_datum": None if role == "imagery" else "amsl",
    }  # fmt: skip
    return CatalogueSource.model_validate(given | more)


def fetched(wanted: CatalogueSource, tmp_path: Path, client: HttpClient | None = None) -> Path:
    client = client or HttpClient(50.0)
    plan = make_plan(wanted, AREA, wanted.resolution_m, client)
    fetch(wanted, plan, tmp_path / "pieces", tmp_path / "out.tif", client)
    return tmp_path / "out.tif"


def compare(path: Path, expected, limit: float, share: float = 1.0) -> None:
    """The raster's numbers against the world's at its own pixels' places, inside the area."""
    with rasterio.open(path) as data:
        rows, columns = np.mgrid[2 : data.height - 2 : 7, 2 : data.width - 2 : 7]
        x, y = rasterio.transform.xy(data.transform, rows.ravel(), columns.ravel())
        values = data.read().astype(np.float64)[:, rows.ravel(), columns.ravel()]
        known = data.dataset_mask()[rows.ravel(), columns.ravel()] > 0
        crs = data.crs
    east, north = Transformer.from_crs(crs, CRS, always_xy=True).transform(x, y)
    lat, lon = geographic(east, north)
    inside = (AREA.south < lat) & (lat < AREA.north) & (AREA.west < lon) & (lon < AREA.east)
    assert inside.sum() > 400
    assert known[inside].all(), "the area has holes"
    truth = np.asarray(expected(east, north), np.float64).reshape(len(east), -1).T
    wrong = np.abs(values - truth).max(axis=0)[inside]
    assert np.quantile(wrong, share) <= limit, f"{np.quantile(wrong, [0.5, 0.9, 0.99, 1.0])}"


# A pixel on the border of two squares is neither's.
PICTURE = {"expected": colour, "limit": 16.0, "share": 0.88}
HEIGHTS = {"expected": height_m, "limit": 0.1}


def test_a_cloud_optimised_file_gives_what_is_asked_and_not_the_whole(server, tmp_path):
    small = source("cog", f"{server.url}/surface.tif", role="surface")
    before = server.bytes
    compare(fetched(small, tmp_path), **HEIGHTS)
    assert all(r.startswith("bytes=") for r in server.ranges)
    assert server.bytes - before < 2 * (server.folder / "surface.tif").stat().st_size


def test_a_server_without_ranges_is_told_and_its_file_not_taken(server, tmp_path):
    server.ranged = False
    try:
        with pytest.raises(MapFetchError, match="whole files only"):
            fetched(source("cog", f"{server.url}/surface.tif", role="surface"), tmp_path)
    finally:
        server.ranged = True


def test_a_catalogue_leads_to_the_newest_file_there_and_asks_nothing_elsewhere(server, tmp_path):
    server.asked.clear()
    compare(fetched(source("stac", f"{server.url}/stac/catalog.json"), tmp_path), **PICTURE)
    assert not any("elsewhere-" in path for path in server.asked)
    assert any("ortho.tif" in path for path in server.asked)


@pytest.mark.parametrize(
    ("methods", "layer"), [(("GET", "POST"), ""), (("POST",), ""), (("POST",), "photos"), ((), "")]
)
def test_a_searched_catalogue_is_read_to_its_last_page(
    server, tmp_path, monkeypatch, methods, layer
):
    """Items one a page, the newest last; by GET, by POST with a merged body, or told of neither."""
    server.asked.clear()
    monkeypatch.setattr(server.catalogue, "methods", methods or ("GET",))
    if not methods:
        answer = server.catalogue.answer
        monkeypatch.setattr(
            server.catalogue, "answer",
            lambda url, path, *rest: {} if path == "/api" else answer(url, path, *rest),
        )  # fmt: skip
    compare(fetched(source("stac", f"{server.url}/api", layer=layer), tmp_path), **PICTURE)
    assert sum(path.startswith("/api/search") for path in server.asked) == 2
    assert any("ortho.tif" in path for path in server.asked)


def test_a_search_that_never_ends_is_given_up(server, tmp_path, monkeypatch):
    monkeypatch.setattr(server.catalogue, "endless", True)
    wanted = source("stac", f"{server.url}/api")
    with pytest.raises(MapFetchError, match="over 50 pages"):
        fetched(wanted, tmp_path, HttpClient(1000.0))


@pytest.mark.parametrize("kind", ["xyz", "tms", "wmts"])
def test_tiles(server, tmp_path, kind):
    urls = {
        "xyz": f"{server.url}/tiles/{{z}}/{{x}}/{{y}}.png",
        "tms": f"{server.url}/tms/{{z}}/{{x}}/{{y}}.png",
        "wmts": f"{server.url}/wmts.xml",
    }
    wanted = source(kind, urls[kind], layer="ortho")
    compare(fetched(wanted, tmp_path), **PICTURE)


@mapserver
@pytest.mark.parametrize(
    ("version", "crs"),
    [("1.3.0", CRS), ("1.3.0", "EPSG:4326"), ("1.1.1", "EPSG:4326"), ("1.3.0", "EPSG:3857")],
)
def test_wms_of_mapserver_in_every_order_of_axes(server, tmp_path, version, crs):
    wanted = source(
        "wms", f"{server.url}/mapserv", layer="ortho", crs=crs, version=version, piece_px=300
    )
    compare(fetched(wanted, tmp_path), **PICTURE)


@mapserver
@pytest.mark.parametrize("version", ["1.0.0", "2.0.1"])
def test_wcs_of_mapserver(server, tmp_path, version):
    wanted = source(
        "wcs", f"{server.url}/mapserv", role="surface", layer="surface", crs=CRS,
        version=version, piece_px=120, format="GTIFF32" if version == "1.0.0" else "image/tiff",
    )  # fmt: skip
    compare(fetched(wanted, tmp_path), **HEIGHTS)


@mapserver
def test_what_a_service_refuses_is_told_in_its_own_words(server, tmp_path):
    wanted = source("wms", f"{server.url}/mapserv", layer="nothing", crs=CRS)
    with pytest.raises(MapFetchError, match=r"refused: .*Invalid layer"):
        fetched(wanted, tmp_path)


def test_what_came_is_not_asked_for_again_and_another_plan_begins_anew(server, tmp_path):
    wanted = source("xyz", f"{server.url}/tiles/{{z}}/{{x}}/{{y}}.png")
    fetched(wanted, tmp_path)
    pieces = sorted((tmp_path / "pieces").glob("[0-9]*"))
    pieces[0].unlink()
    (tmp_path / "out.tif").unlink()
    server.asked.clear()
    compare(fetched(wanted, tmp_path), **PICTURE)
    assert len(server.asked) == 1
    other = wanted.model_copy(update={"most_zoom": 16})
    server.asked.clear()
    fetched(other, tmp_path)
    assert len(server.asked) > 0


def test_a_cut_off_run_leaves_whole_pieces_only(server, tmp_path):
    wanted = source("xyz", f"{server.url}/tiles/{{z}}/{{x}}/{{y}}.png", parallel=1)
    client = HttpClient(50.0)
    plan = make_plan(wanted, AREA, 0.5, client)

    def interrupt(done: int, _: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fetch(wanted, plan, tmp_path / "pieces", tmp_path / "out.tif", client, interrupt)
    assert not (tmp_path / "out.tif").exists()
    server.asked.clear()
    fetch(wanted, plan, tmp_path / "pieces", tmp_path / "out.tif", client)
    assert len(server.asked) <= len(plan.pieces) - 3
    compare(tmp_path / "out.tif", **PICTURE)


def test_a_server_that_fails_in_the_middle_of_a_file_is_told_and_not_taken_for_a_hole(
    server, tmp_path
):
    wanted = source("cog", f"{server.url}/surface.tif", role="surface")
    client = HttpClient(50.0, sleep=lambda _: None)
    plan = make_plan(wanted, AREA, 1.0, client)
    server.broken = [(404, {})]
    with pytest.raises(MapFetchError, match="status 404"):
        fetch(wanted, plan, tmp_path / "pieces", tmp_path / "out.tif", client)
    assert not (tmp_path / "out.tif").exists()


def _with_sea_beside(server, wanted: CatalogueSource, lacks: int) -> list[CloudFile]:
    """The world's file, and one that is not there: GLO-30 has none of a degree that is all sea."""
    files = [CloudFile(f"{server.url}/{name}", wanted.bounds, may_lack=True)
             for name in ("surface.tif", "surface.tif")]  # fmt: skip
    files[lacks] = CloudFile(f"{server.url}/sea.tif", wanted.bounds, may_lack=True)
    return files


@pytest.mark.parametrize("lacks", [0, 1])
def test_a_degree_of_the_worlds_model_that_is_sea_does_not_cost_the_coast(server, tmp_path, lacks):
    """Its 404 ended the fetch of every coast whose area reached a degree further."""
    wanted = source("cog", f"{server.url}/surface.tif", role="surface")
    client = HttpClient(50.0)
    plan = plan_files(wanted, AREA, 1.0, _with_sea_beside(server, wanted, lacks), client)
    fetch(wanted, plan, tmp_path / "pieces", tmp_path / "out.tif", client)
    compare(tmp_path / "out.tif", **HEIGHTS)
    assert plan.lacking == ("sea.tif",)


def test_a_degree_without_a_file_is_unknown_and_named_and_never_a_height_of_zero(server, tmp_path):
    """GLO-30 Public lacks some land, too, and a 404 does not say which of both it is."""
    wanted = source("cog", f"{server.url}/surface.tif", role="surface")
    client = HttpClient(50.0)
    west, south, east, north = wanted.bounds
    middle = 0.5 * (west + east)
    files = [
        CloudFile(f"{server.url}/surface.tif", (west, south, middle, north), may_lack=True),
        CloudFile(f"{server.url}/N47_E008.tif?key=secret", (middle, south, east, north), True),
    ]
    area = Area(west, AREA.south, east, AREA.north)
    plan = plan_files(wanted.model_copy(update={"piece_px": 64}), area, 1.0, files, client)
    assert plan.lacking == ("N47_E008.tif",)
    known = fetch(wanted, plan, tmp_path / "pieces", tmp_path / "out.tif", client)
    assert 0.5 < known < 0.9
    with rasterio.open(tmp_path / "out.tif") as file:
        heights, mask = file.read(1), file.dataset_mask() > 0
    assert not mask[:, -64:].any()
    assert (heights[~mask] == file.nodata).all()
    assert make_plan(wanted, AREA, 1.0, client).lacking == ()


def test_where_every_degree_is_sea_it_is_told_by_name_and_a_named_file_must_be_there(server):
    wanted = source("cog", f"{server.url}/sea.tif", role="surface")
    client = HttpClient(50.0)
    sea = CloudFile(wanted.url, wanted.bounds, may_lack=True)
    with pytest.raises(MapFetchError, match=r"sea\.tif.*no such file.*all sea"):
        plan_files(wanted, AREA, 1.0, [sea, sea], client)
    with pytest.raises(MapFetchError, match=r"sea\.tif: status 404"):
        make_plan(wanted, AREA, 1.0, client)


def test_a_picture_that_ends_too_early_is_told_and_not_kept(server):
    """Its head was whole, so it was kept; the mosaic then failed, and so did every further run."""
    noise = np.random.default_rng(1).integers(0, 255, (64, 64, 3), np.uint8)
    kept = io.BytesIO()
    Image.fromarray(noise).save(kept, "JPEG")
    wanted = source("xyz", f"{server.url}/tiles/{{z}}/{{x}}/{{y}}.png")
    piece = Piece("0-0", 0, 0, 64, 64, lambda _: None)
    check_piece(wanted, piece, kept.getvalue())
    with pytest.raises(MapFetchError, match="no image"):
        check_piece(wanted, piece, kept.getvalue()[:-1000])


@pytest.mark.parametrize("kind", ["wms", "cog"])
def test_a_picture_of_more_than_8_bits_is_refused(server, tmp_path, kind):
    """Its counts were cut to their lowest 8 bits: a map of noise, and nobody was told."""
    path = server.folder / f"deep-{kind}.tif"
    with rasterio.open(server.folder / "ortho.tif") as data:
        profile = data.profile | {"dtype": "uint16"}
        with rasterio.open(path, "w", **profile) as deep:
            deep.write(data.read().astype(np.uint16) * 200)
    wanted = source(kind, f"{server.url}/{path.name}", layer="deep")
    piece = Piece("0-0", 0, 0, profile["width"], profile["height"], lambda _: None)
    with pytest.raises(MapFetchError, match="uint16"):
        fetched(wanted, tmp_path) if kind == "cog" else check_piece(
            wanted, piece, path.read_bytes()
        )


@pytest.mark.parametrize("kind", ["wms", "wcs"])
def test_a_picture_is_not_unpacked_before_its_size_is_known_to_be_right(server, tmp_path, kind):
    """Of some kilobytes a server could make the 30 GB that no computer has."""
    path = tmp_path / "bomb.tif"
    with rasterio.open(
        path, "w", driver="GTiff", width=100_000, height=100_000, count=1, dtype="float32",
        crs=CRS, transform=rasterio.transform.from_origin(0, 9, 1, 1), tiled=True, SPARSE_OK=True,
    ):  # fmt: skip
        pass
    wanted = source(kind, server.url, layer="x", role="surface" if kind == "wcs" else "imagery")
    piece = Piece("0-0", 0, 0, 1024, 1024, lambda _: None, placed=kind == "wcs")
    with pytest.raises(MapFetchError, match="is 100000 x 100000 pixels"):
        check_piece(wanted, piece, path.read_bytes())
    kept = io.BytesIO()
    Image.new("1", (20_000, 20_000)).save(kept, "PNG")
    with pytest.raises(MapFetchError, match=r"20000 x 20000 pixels|exceeds limit"):
        check_piece(wanted, piece, kept.getvalue())


def _other_numbers(server, name, values, **says):
    """The surface as a service may give it: in feet, in decimetres, above something else."""
    with rasterio.open(server.folder / "surface.tif") as data:
        profile = data.profile | {
            "dtype": "int16",
            "nodata": None,
            "crs": says.get("crs", data.crs),
        }
        metres = data.read(1).astype(np.float64)
    with rasterio.open(server.folder / name, "w", **profile) as file:
        file.write(np.rint(values(metres)).astype(np.int16), 1)
        file.scales, file.offsets = (says.get("scale", 1.0),), (says.get("offset", 0.0),)
        if "unit" in says:
            file.units = (says["unit"],)
    return source("cog", f"{server.url}/{name}", role="surface")


@pytest.mark.parametrize(
    ("values", "says"),
    [
        (lambda z: z / 0.3048, {"unit": "ft"}),
        (lambda z: (z - 400.0) / 0.1, {"scale": 0.1, "offset": 400.0}),
    ],
)
def test_heights_are_metres_whatever_unit_scale_and_offset_a_file_has(
    server, tmp_path, values, says
):
    """They were taken as they stand: a map 500 m too low, and nobody was told."""
    path = fetched(_other_numbers(server, "counted.tif", values, **says), tmp_path)
    compare(path, height_m, 0.3)
    with rasterio.open(path) as data:
        assert data.units == ("m",)


def test_heights_above_another_datum_than_the_source_says_are_refused(server, tmp_path):
    wanted = _other_numbers(server, "high.tif", lambda z: z, crs=f"{CRS}+5773")
    compare(fetched(wanted, tmp_path), height_m, 0.7)
    wanted = wanted.model_copy(update={"vertical_datum": "ellipsoidal"})
    with pytest.raises(MapFetchError, match=r"are amsl by its CRS .*EGM96.*says ellipsoidal"):
        fetched(wanted, tmp_path / "again")
