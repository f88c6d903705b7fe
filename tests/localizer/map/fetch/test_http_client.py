"""A guest's manners: a rate, patience, limits, and whose doors it does not knock at."""

from __future__ import annotations

import pytest

pytest.importorskip("urllib3")
from localizer.errors import MapFetchError
from localizer.map.fetch.catalogue import require_allowed
from localizer.map.fetch.http_client import HttpClient
from tests.localizer.map.fetch.loopback import serving


class Time:
    """A clock that only waiting moves."""

    def __init__(self) -> None:
        self.now = 100.0
        self.waits: list[float] = []

    def sleep(self, seconds: float) -> None:
        self.waits.append(seconds)
        self.now += seconds

    def client(self, **manners: float) -> HttpClient:
        return HttpClient(**manners, sleep=self.sleep, clock=lambda: self.now)


@pytest.fixture
def server(tmp_path):
    (tmp_path / "file").write_bytes(b"x" * 1000)
    with serving(tmp_path) as served:
        yield served


def test_no_faster_than_the_rate(server):
    time = Time()
    client = time.client(rate_per_s=2.0)
    for _ in range(7):
        client.get(f"{server.url}/file")
    assert time.now - 100.0 == pytest.approx(3.0)


def test_a_busy_server_is_waited_for_as_long_as_it_says(server):
    time = Time()
    server.broken = [(503, {"Retry-After": "17"}), (429, {}), (500, {"Retry-After": "nonsense"})]
    assert time.client(rate_per_s=50.0).get(f"{server.url}/file").data == b"x" * 1000
    waits = [w for w in time.waits if w >= 1.0]
    assert waits[0] == 17.0
    assert waits == sorted(waits)
    assert len(waits) == 3


@pytest.mark.parametrize("told", ["1e9", "-5", "nan", "Wed, 21 Oct 2065 07:28:00 GMT"])
def test_what_it_says_is_bounded(server, told):
    time = Time()
    server.broken = [(503, {"Retry-After": told})]
    time.client(rate_per_s=50.0).get(f"{server.url}/file")
    assert 1.0 <= max(time.waits) <= 60.0


def test_it_gives_up_and_a_refusal_is_not_repeated(server):
    time = Time()
    server.broken = [(503, {})] * 5
    with pytest.raises(MapFetchError, match="given up after 5 tries: status 503"):
        time.client().get(f"{server.url}/file")
    server.asked.clear()
    with pytest.raises(MapFetchError, match="status 404"):
        time.client().get(f"{server.url}/nothing?key=secret")
    assert len(server.asked) == 1


def test_an_error_shows_no_key(server):
    with pytest.raises(MapFetchError) as caught:
        Time().client().get(f"{server.url}/nothing?apikey=secret")
    assert "secret" not in str(caught.value)


def test_all_together_is_bounded(server):
    client = Time().client(most_bytes=2500, rate_per_s=50.0)
    for _ in range(2):
        client.get(f"{server.url}/file")
    with pytest.raises(MapFetchError, match="--most-mb"):
        client.get(f"{server.url}/file")


@pytest.mark.parametrize(
    "url",
    [
        "https://mt1.google.com/vt/lyrs=s&x=1&y=2&z=3", "https://khms0.googleapis.com/kh?v=1",
        "https://maps.google.co.uk/x", "http://ecn.t3.tiles.virtualearth.net/tiles/a1.jpeg",
        "https://www.bing.com/maps", "https://MT0.GOOGLE.COM./x", "https://api.mapbox.com/v4/x",
        "https://server.arcgisonline.com/ArcGIS/x", "https://tile.openstreetmap.org/1/1/1.png",
    ],
)  # fmt: skip
def test_whose_terms_forbid_it_is_refused_by_name(url):
    with pytest.raises(MapFetchError, match=r"refused: .*(terms|may be kept|do not serve)"):
        require_allowed(url)


@pytest.mark.parametrize(
    "url",
    [
        "https://www.wms.nrw.de/x", "https://notgoogle.org/x", "http://127.0.0.1:8000/google.com",
        "https://storage.googleapis.com/open-data/x.tif", "https://bing.example.org/x",
    ],
)  # fmt: skip
def test_others_are_not(url):
    require_allowed(url)


def test_a_redirection_to_a_forbidden_place_is_refused_too(server):
    server.broken = [(302, {"Location": "https://mt1.google.com/vt"})]
    with pytest.raises(MapFetchError, match=r"google\.com: refused"):
        Time().client().get(f"{server.url}/file")
    server.broken = [(302, {"Location": "/file"})]
    assert Time().client().get(f"{server.url}/other").status == 200
    server.broken = [(302, {"Location": "/file"})] * 9
    with pytest.raises(MapFetchError, match="redirected more than"):
        Time().client().get(f"{server.url}/other")


@pytest.mark.parametrize("url", ["file:///etc/passwd", "ftp://x/y", "/etc/passwd", "http://"])
def test_only_web_addresses(url):
    with pytest.raises(MapFetchError, match="no address of http"):
        require_allowed(url)
