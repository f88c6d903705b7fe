"""Attacks on the page: another site's page, a made-up name, the network, floods, odd paths."""

import asyncio
import http.client
import io
import json
import os
import shutil
import socket
import ssl
import subprocess
import sys
import tarfile
from types import SimpleNamespace
from unittest.mock import Mock
from xml.etree import ElementTree

import pytest
import yaml
from pydantic import ValidationError

pytest.importorskip("starlette")
pytest.importorskip("httpx2")
import uvicorn
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect
from uvicorn.server import ServerState

from companion.console.pictures import TileName
from companion.console.records import Records
from companion.console.security import MOST_BODY, RequestGuard, read_token
from companion.console.server import ConsoleSite, make_application
from companion.console.serving import RequestTimeoutProtocol, Server
from companion.console.source import Newest
from companion.errors import ConfigError
from companion.live.config import ConsoleConfig

HOST = "127.0.0.1:8080"
SAME = {"host": HOST, "origin": f"http://{HOST}", "x-console": "1"}
TOKEN = "0123456789abcdef0123"
MODEL = {"width": 64, "height": 48, "fx": 60, "fy": 60, "cx": 32, "cy": 24}


class Still:
    """A flight that shows one state and notes what it was asked."""

    def __init__(self, armed=False, connected=True):
        self.newest = Newest()
        self.newest.hello = {"kind": "hello"}
        vehicle = {"connected": connected, "armed": armed}
        self.newest.state = {"kind": "state", "vehicle": vehicle, "targets": [], "events": []}
        self.newest.states = 1
        self.is_connected = True
        self.orders = []
        self.watched = []

    def watch(self, wanted):
        self.watched.append(wanted)

    async def changed(self):
        await asyncio.Event().wait()

    async def order(self, order):
        self.orders.append(order)
        return True, "done"

    async def run(self):
        pass


@pytest.fixture
def deployment(tmp_path):
    path = tmp_path / "deployment.yaml"
    camera = {"source": "rtsp://user:secret@10.0.0.1/a", "model": MODEL}
    path.write_text(yaml.safe_dump({"map": "map", "camera": camera}))
    path.chmod(0o640)
    return path


@pytest.fixture
def site(tmp_path, deployment, small_assets):
    def make(source=None, *, token=None, **config):
        config = {"control": True} | config
        flights = tmp_path / "flights"
        record = flights / "flight"
        (record / "snapshots").mkdir(parents=True, exist_ok=True)
        (record / "record.json").write_text(json.dumps({"utc_ns": 5}))
        (record / "events.csv").write_text("time_ns,level,text\n")
        return ConsoleSite(
            ConsoleConfig(**config), source or Still(), small_assets.map_cache,
            Records(flights), deployment, token,
        )  # fmt: skip

    return make


def _client(site):
    return TestClient(make_application(site), base_url=f"http://{HOST}")


@pytest.mark.parametrize(
    "host",
    ["evil.example", "127.0.0.1.evil.example:8080", "10.1.2.3:8080", "", "[::1", "localhost."],
)
def test_a_name_that_was_made_to_point_here_gets_nothing(site, host):
    """DNS rebinding: the browser sends the attacker's name."""
    with _client(site()) as client:
        assert client.get("/api/records", headers={"host": host}).status_code == 421
        assert client.get("/api/records", headers={"host": "localhost:8080"}).status_code == 200


@pytest.mark.parametrize(
    "headers",
    [
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"origin": "http://127.0.0.1:9999"},
        {"origin": f"https://{HOST}"},
        {"sec-fetch-site": "cross-site"},
        {"x-console": "0"},
    ],
)
def test_another_sites_page_cannot_act(site, headers):
    source = Still()
    with _client(site(source)) as client:
        answer = client.post("/api/order", json={"do": "stop"}, headers=SAME | headers)
        assert answer.status_code == 403
        plain = {"host": HOST, "content-type": "text/plain"}  # what a form can send
        assert client.post("/api/order", content="{}", headers=plain).status_code == 403
        assert not source.orders
        assert client.post("/api/order", json={"do": "stop"}, headers=SAME).status_code == 200
        assert source.orders == [{"do": "stop"}]


@pytest.mark.parametrize("origin", [None, "http://evil.example"])
def test_another_sites_page_cannot_listen(site, origin):
    headers = {"host": HOST} | ({"origin": origin} if origin else {})
    with (
        _client(site()) as client,
        pytest.raises(WebSocketDisconnect),
        client.websocket_connect("/ws", headers=headers),
    ):
        pass


def test_a_page_of_our_own_listens_and_garbage_ends_only_itself(site):
    source = Still()
    with _client(site(source)) as client:
        for garbage in ("{", "[1]", '{"frames": ' + "[" * 2000):
            with client.websocket_connect("/ws", headers=SAME) as page:
                assert page.receive_json()["kind"] == "state"
                page.send_text(garbage)
                with pytest.raises(WebSocketDisconnect):
                    page.receive_text()
        with client.websocket_connect("/ws", headers=SAME) as page:
            assert page.receive_json()["connected"] is True


def test_without_the_token_nothing_is_seen(site):
    with _client(site(token=TOKEN)) as client:
        for path in ("/", "/api/records", "/static/console.js", "/tiles/17/1/1.jpg"):
            assert client.get(path).status_code == 401
        for wrong in ("x", TOKEN[:-1], TOKEN + "0"):
            bearer = {"authorization": f"Bearer {wrong}"}
            assert client.get("/api/records", headers=bearer).status_code == 401
        with pytest.raises(WebSocketDisconnect), client.websocket_connect("/ws", headers=SAME):
            pass
        right = {"authorization": f"Bearer {TOKEN}"}
        assert client.get("/api/records", headers=right).status_code == 200


def test_the_token_leaves_the_address_for_a_cookie_that_scripts_cannot_read(site):
    with _client(site(token=TOKEN)) as client:
        answer = client.get(f"/?token={TOKEN}", follow_redirects=False)
        assert (answer.status_code, answer.headers["location"]) == (303, "/")
        cookie = answer.headers["set-cookie"]
        assert "HttpOnly" in cookie
        assert "SameSite=Strict" in cookie
        assert client.get("/api/records").status_code == 200  # by the cookie


def test_off_loopback_a_token_is_needed_and_nobody_else_may_read_it(tmp_path):
    with pytest.raises(ValidationError, match="token_file is needed"):
        ConsoleConfig(listen="0.0.0.0:8080")
    path = tmp_path / "token"
    ConsoleConfig(listen="0.0.0.0:8080", token_file=path)
    path.write_text(TOKEN)
    path.chmod(0o644)
    with pytest.raises(ConfigError, match="chmod 600"):
        read_token(path)
    path.chmod(0o600)
    assert read_token(path) == TOKEN
    path.write_text("short")
    with pytest.raises(ConfigError, match="16 characters"):
        read_token(path)
    path.unlink()
    os.mkfifo(path, 0o600)  # nobody writes into it
    with pytest.raises(ConfigError, match="no regular file"):
        read_token(path)


@pytest.mark.parametrize(
    "path",
    [
        "/static/../server.py", "/static/%2e%2e/server.py", "/static/..%2fserver.py",
        "/static/%2e%2e%2f%2e%2e%2f%2e%2e%2fpyproject.toml", "/static//etc/passwd",
        "/api/records/../tar", "/api/records/..%2f..%2fetc/tar", "/api/records/%2e%2e/tar",
        "/api/records/latest/tar", "/api/records/elsewhere/tar", "/api/records/%00/tar",
    ],
)  # fmt: skip
def test_no_path_leads_out(site, tmp_path, path):
    made = site()
    outside = tmp_path / "elsewhere"
    outside.mkdir()
    (outside / "record.json").write_text("{}")
    for name in ("latest", "elsewhere"):
        (tmp_path / "flights" / name).symlink_to(outside)
    with _client(made) as client:
        answer = client.get(path)
        assert answer.status_code in (404, 405, 409), answer.text[:100]
        assert "root:" not in answer.text


def test_a_record_is_given_without_what_its_links_point_to(site, tmp_path):
    made = site()
    record = tmp_path / "flights" / "flight"
    secret = tmp_path / "secret"
    secret.mkdir()
    (secret / "key").write_text("secret")
    (record / "key").symlink_to(secret / "key")
    (record / "folder").symlink_to(secret)
    with _client(made) as client:
        assert [r["name"] for r in client.get("/api/records").json()] == ["flight"]
        data = client.get("/api/records/flight/tar").content
    with tarfile.open(fileobj=io.BytesIO(data)) as tar:
        names = tar.getnames()
    assert names == ["flight/events.csv", "flight/record.json"]


def test_sizes_are_bounded(site):
    with _client(site()) as client:
        headers = SAME | {"content-type": "application/json"}
        huge = b"[" * (MOST_BODY + 1)
        assert client.post("/api/order", content=huge, headers=headers).status_code == 413

        def endless():  # without a length: the connection ends
            for _ in range(2 * MOST_BODY // 4096):
                yield b"[" * 4096

        answer = client.post("/api/order", content=endless(), headers=headers)
        assert (answer.status_code, answer.json()["text"]) == (409, "the body is too long")


@pytest.mark.parametrize("zoom", [7, 23, 10**10, 10**21])
def test_a_zoom_that_no_map_has_is_no_tile(zoom):
    assert not TileName(zoom, 0, 0).is_valid
    assert TileName(17, 0, 0).is_valid


def test_floods_are_refused_until_they_are_over():
    now = [0.0]
    answered = []

    async def app(scope, receive, send):
        answered.append(scope["path"])

    async def nothing(*_):
        return {}

    guarded = RequestGuard(app, ConsoleConfig(), None, lambda: now[0])
    scope = {
        "type": "http", "method": "GET", "path": "/", "headers": [(b"host", HOST.encode())],
        "query_string": b"",
    }  # fmt: skip

    async def ask(times):
        for _ in range(times):
            await guarded(dict(scope), nothing, nothing)

    asyncio.run(ask(1000))
    assert len(answered) == 400
    now[0] = 1.0
    asyncio.run(ask(1000))
    assert len(answered) == 500


def test_every_answer_forbids_foreign_script_and_a_report_runs_on_its_own(site, tmp_path):
    with _client(site()) as client:
        for path in ("/", "/static/console.js", "/api/records", "/nothing"):
            headers = client.get(path).headers
            assert "script-src 'self'" in headers["content-security-policy"]
            assert "unsafe" not in headers["content-security-policy"]
            assert headers["x-frame-options"] == "DENY"
            assert headers["x-content-type-options"] == "nosniff"
        for name in ("estimates", "targets"):
            (tmp_path / "flights" / "flight" / f"{name}.csv").write_text("a\n")
        report = client.get("/api/records/flight/report")
        assert report.status_code == 200
        assert report.headers["content-security-policy"].startswith("sandbox allow-scripts;")


@pytest.mark.parametrize(
    ("control", "armed", "connected"),
    [(False, False, True), (True, True, True), (True, False, False)],
    ids=["only reads", "armed", "vehicle not heard"],
)
def test_a_page_does_no_more_than_it_may(site, deployment, control, armed, connected):
    """One that only reads does nothing; in flight there are targets and hints."""
    source = Still(armed, connected)
    before = deployment.read_text()
    allowed = 200 if control else 409
    with _client(site(source, control=control)) as client:
        for path, body in (
            ("/api/doctor", {}), ("/api/deployment", {"text": before + "\n", "write": True}),
        ):  # fmt: skip
            assert client.post(path, json=body, headers=SAME).status_code == 409
        for do in ("target", "hint"):
            assert client.post("/api/order", json={"do": do}, headers=SAME).status_code == allowed
        for wrong in ("arm", "", None, 5):
            assert client.post("/api/order", json={"do": wrong}, headers=SAME).status_code == 409
        shown = client.get("/api/deployment").json()
        assert ("secret" in shown["text"], shown["editable"]) == (control, control)
    assert [o["do"] for o in source.orders] == (["target", "hint"] if control else [])
    assert deployment.read_text() == before


def test_targets_go_out_as_geojson_and_as_cursor_on_target_and_a_name_is_no_markup(site):
    source = Still()
    source.newest.state = dict(source.newest.state or {}) | {"targets": [
        {"name": "<car>&", "latitude_deg": 47.5, "longitude_deg": 8.25, "height_m": 450.0,
         "amsl_m": 402.0, "sigma_m": 0.5, "sigma_up_m": 0.7, "elsewhere": 0.0}
    ]}  # fmt: skip
    with _client(site(source)) as client:
        (feature,) = client.get("/api/targets.geojson").json()["features"]
        assert feature["geometry"]["coordinates"] == [8.25, 47.5, 450.0]
        root = ElementTree.fromstring(client.get("/api/targets.cot").text)
        assert root.find("event/point").attrib["lat"] == "47.50000000"
        assert root.find("event/detail/contact").attrib["callsign"] == "<car>&"


def test_with_a_certificate_only_tls_is_spoken_and_only_with_the_token(deployment, tmp_path):
    """The whole process, as an operator begins it."""
    if (openssl := shutil.which("openssl")) is None:
        pytest.skip("no openssl to make a certificate with")
    key, certificate, token = (tmp_path / name for name in ("key.pem", "cert.pem", "token"))
    subprocess.run(
        [openssl, "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj",
         "/CN=localhost", "-addext", "subjectAltName=IP:127.0.0.1", "-keyout", key, "-out",
         certificate], check=True, capture_output=True,
    )  # fmt: skip
    token.write_text(TOKEN)
    token.chmod(0o600)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        listen = f"127.0.0.1:{probe.getsockname()[1]}"
    settings = yaml.safe_load(deployment.read_text())
    settings["console"] = {
        "listen": listen, "token_file": str(token), "tls_certificate": str(certificate),
        "tls_key": str(key),
    }  # fmt: skip
    deployment.write_text(yaml.safe_dump(settings))
    command = [sys.executable, "-m", "companion", "console", str(deployment), "--lifeline"]
    trusted = ssl.create_default_context(cafile=certificate)

    def ask(path, line=None, **headers):
        line = line or http.client.HTTPSConnection(listen, context=trusted, timeout=30)
        line.request("GET", path, headers=headers)
        answer = line.getresponse()
        answer.read()
        line.close()
        return answer

    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        try:
            assert b"console: https://" in process.stdout.readline()  # told once it is there
            assert ask("/api/records").status == 401
            answer = ask(f"/?token={TOKEN}")
            cookie = answer.headers["set-cookie"]
            assert (answer.status, "; Secure" in cookie) == (303, True)
            assert ask("/api/records", cookie=cookie.split(";")[0]).status == 200
            with pytest.raises((http.client.HTTPException, OSError)):
                ask("/", http.client.HTTPConnection(listen, timeout=10))
        finally:
            process.stdin.close()
            process.wait(20)


def _asked(site, attack):
    """What a client gets that comes after `attack`, a coroutine function of the port, has begun."""

    async def both():
        up = asyncio.Event()
        server = Server(site, up.set)
        serving = asyncio.create_task(server.serve([listening]))
        await up.wait()
        open_ends = await attack(port)
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(f"GET /api/records HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
        status = (await reader.readline()).split()[1]
        for end in (writer, *open_ends):
            end.close()
        server.should_exit = True
        await serving
        return int(status)

    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen(256)
        port = listening.getsockname()[1]
        return asyncio.run(both())


@pytest.mark.parametrize(
    "begun", [b"", b"GET / HTTP/1.1\r\nHost:", b"POST /api/order HTTP/1.1\r\n"]
)
def test_clients_that_never_finish_a_request_do_not_keep_the_operator_out(site, begun):
    async def attack(port):
        ends = []
        for _ in range(100):
            ends.append((await asyncio.open_connection("127.0.0.1", port))[1])
            ends[-1].write(begun)
            await ends[-1].drain()
        return ends

    assert _asked(site(), attack) == 200


class Loop:
    """Notes what is to be called, and when; the test lets it happen."""

    def __init__(self):
        self.calls = []

    def call_later(self, delay, call):
        return self.call_at(delay, call)

    def call_at(self, when, call):
        handle = asyncio.TimerHandle(when, call, (), self)
        self.calls.append((handle, call))
        return handle

    def _timer_handle_cancelled(self, _):
        pass

    def get_debug(self):
        return False

    def create_task(self, coroutine):
        coroutine.close()
        return Mock()

    def pass_time(self):
        for handle, call in self.calls:
            if not handle.cancelled():
                call()


def _connected(*pieces):
    """Whether a connection that brought these pieces is still open when the time has passed."""
    loop, gone = Loop(), []
    transport = SimpleNamespace(
        get_extra_info=lambda *_: None, abort=lambda: gone.append(1), is_closing=lambda: False,
        pause_reading=lambda: None, resume_reading=lambda: None,
    )  # fmt: skip
    config = uvicorn.Config(Mock(), interface="asgi3", http=RequestTimeoutProtocol)
    protocol = RequestTimeoutProtocol(config, ServerState(), {}, loop)
    protocol.connection_made(transport)
    for piece in pieces:
        protocol.data_received(piece)
    loop.pass_time()
    return not gone


@pytest.mark.parametrize(
    ("pieces", "stays"),
    [
        ((), False),
        ((b"GET / HT",), False),
        ((b"GET / HTTP/1.1\r\n", b"Host: a\r\n", b"X: "), False),
        ((b"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: 9\r\n\r\n", b"12"), False),
        ((b"GET / HT", b"TP/1.1\r\nHost: a\r\n\r\n"), True),
        ((b"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: 2\r\n\r\n", b"12"), True),
        ((b"GET / HTTP/1.1\r\nHost: a\r\n\r\n", b"GET / HT"), True),  # it is answered first
    ],
)  # fmt: skip
def test_a_request_has_to_be_whole_in_time_and_an_answer_has_all_of_it(pieces, stays):
    assert _connected(*pieces) is stays


def test_settings_are_checked_before_they_are_written_and_the_old_ones_kept(site, deployment):
    before = deployment.read_text()
    with _client(site()) as client:

        def post(text, write):
            body = {"text": text, "write": write}
            return client.post("/api/deployment", json=body, headers=SAME)

        bad = post(before.replace("map: map", "map: map\nno_such: 1"), True)
        assert (bad.status_code, "no such setting" in bad.json()["text"]) == (400, True)
        assert deployment.read_text() == before
        assert post(before + "# new\n", False).json()["ok"]
        assert deployment.read_text() == before
        assert post(before + "# new\n", True).json()["ok"]
        assert any(
            line["key"] == "console.listen" for line in client.get("/api/deployment").json()["help"]
        )
    assert deployment.read_text() == before + "# new\n"
    assert os.stat(deployment).st_mode & 0o777 == 0o640
    (kept,) = deployment.parent.glob("deployment.yaml.*.old")
    assert kept.read_text() == before
    assert {p.name for p in deployment.parent.iterdir()} == {
        deployment.name, kept.name, "flights"
    }  # fmt: skip
