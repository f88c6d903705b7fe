"""The page in a real browser, on a flight's socket: it shows, clicks are targets, hints arrive."""

import shutil
import socket
import subprocess
import sys
import threading
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from companion.live.protocol import socket_path
from localizer.map.cache.cache import TileCache
from mavlink_bridge.alerts.ids import AlertId
from tests.companion.console.companion_flying import CAMERA, HEIGHT_M, Flight
from tests.companion.console.record_of import write_record

playwright = pytest.importorskip("playwright.sync_api")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine"),
]
SOFTWARE_GL = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader",
               "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
               "--disable-gpu-compositing", "--disable-accelerated-2d-canvas")  # fmt: skip
LAPTOP, PHONE = {"width": 1280, "height": 800}, {"width": 390, "height": 844}


@pytest.fixture(scope="module")
def flight(small_assets, tmp_path_factory):
    """The flight, and the page's process with its address."""
    home = tmp_path_factory.mktemp("deployment")
    listen = _free_address()
    record = home / "flights" / "flight"
    record.mkdir(parents=True)
    (record / "record.json").write_text("{}")
    model = CAMERA.to_dict()
    config = {
        "map": str(small_assets.map_cache),
        "camera": {"source": "udp://127.0.0.1:5600", "model": model},
        "record": {"folder": str(record)},
        "console": {"listen": listen, "control": True},
    }
    path = home / "deployment.yaml"
    path.write_text(yaml.safe_dump(config))
    meeting = socket_path(small_assets.map_cache, record, listen)
    flight = Flight(meeting, TileCache.open(small_assets.map_cache))
    command = [sys.executable, "-m", "companion", "console", str(path), "--lifeline"]
    with flight.flying():
        console = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        console.stdout.readline()
        yield SimpleNamespace(flight=flight, url=f"http://{listen}/", listen=listen)
        console.stdin.close()
        console.wait(20)


@pytest.fixture(scope="module")
def chromium():
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=list(SOFTWARE_GL))
        yield browser
        browser.close()


def _opened(chromium, url):
    """A page at a laptop's size; what it complained of and whom it asked stands in `seen`."""
    page = chromium.new_page(viewport=LAPTOP)
    seen = SimpleNamespace(errors=[], hosts=set())
    page.on("console", lambda m: m.type == "error" and seen.errors.append(m.text))
    page.on("pageerror", lambda e: seen.errors.append(str(e)))
    page.on("request", lambda r: "://" in r.url and seen.hosts.add(r.url.split("/")[2]))
    page.set_default_timeout(60_000)
    page.goto(url)
    return page, seen


@pytest.fixture(scope="module")
def opened(chromium, flight):
    """One page for all tests: each load draws the map by software, for seconds."""
    page, seen = _opened(chromium, flight.url)
    _until(page, lambda: (page.evaluate("window.consoleFrames") or 0) > 2)
    yield page, seen
    page.close()


@pytest.fixture
def page(opened):
    """As it was opened, but for what it was told since."""
    opened[0].set_viewport_size(LAPTOP)
    opened[0].click("nav button[data-view=map]")
    return opened


@pytest.fixture
def replay(chromium, small_assets, tmp_path):
    """A record of 20 s over the map's origin, played by `companion replay --console`."""
    record, listen = tmp_path / "flight", _free_address()
    write_record(record, small_assets.map_cache)
    command = [sys.executable, "-m", "companion", "replay", str(record), "--console", listen]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        while "console:" not in process.stdout.readline():
            pass
        page, seen = _opened(chromium, f"http://{listen}/")
        yield page, seen
        page.close()
        process.terminate()


def _free_address():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{probe.getsockname()[1]}"


def _until(page, holds, seconds=60):
    """The page polls; `wait_for_function` would need eval, which its policy forbids."""
    for _ in range(4 * seconds):
        if holds():
            return
        page.wait_for_timeout(250)
    raise AssertionError("it did not come true")


def test_it_shows_the_flight_and_asks_nobody_else(page, flight):
    page, seen = page
    assert page.inner_text("#word").lower() == "tracking"
    # It may inject, and nothing goes out: that it injects would be wrong.
    assert "inject: sends none" in page.inner_text("#figures").lower()
    assert seen.hosts == {flight.listen}
    assert seen.errors == []


@pytest.mark.parametrize("size", [LAPTOP, PHONE], ids=["laptop", "phone"])
def test_every_view_passes_axe_and_is_never_wider_than_the_screen(page, size):
    """axe-core: contrast, names, keyboard, landmarks."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright")
    page, _ = page
    page.set_viewport_size(size)
    for view in _views(page):
        page.click(f"nav button[data-view={view}]")
        found = axe.Axe().run(page)
        assert found.violations_count == 0, f"{view}: {found.generate_report()}"
        wide = page.evaluate("document.documentElement.scrollWidth")
        assert wide <= size["width"], f"{view} must be dragged sideways"


def test_the_views_are_reached_by_keyboard(page):
    page, _ = page
    page.focus("nav button[data-view=video]")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    assert page.evaluate("document.body.dataset.view") == "targets"


def test_a_record_is_shown_with_the_maps_view_and_a_time_bar(replay):
    page, seen = replay
    _until(page, lambda: (page.evaluate("window.consoleFrames") or 0) > 0)
    assert "kept frame" in page.inner_text("#video-age")
    assert "doctor" not in _views(page)  # nothing to examine
    page.click("#play")
    page.evaluate(
        "() => { const s = document.getElementById('seek'); s.value = 900;"
        " s.dispatchEvent(new Event('input')); }"
    )
    _until(page, lambda: page.inner_text("#clock").startswith("18.0"))
    assert page.inner_text("#word").lower() == "lost"  # as the record has it from 15 s on
    page.click("nav button[data-view=video]")
    page.select_option("#overlay", "checker")
    assert page.is_hidden("#share-label")
    assert seen.errors == []


def _views(page):
    shown = "buttons => buttons.filter(b => b.offsetParent).map(b => b.dataset.view)"
    return page.eval_on_selector_all("nav button", shown)


def test_a_click_is_a_target_at_the_place_that_was_clicked(page, flight):
    """The camera looks straight down: the middle of the picture is the ground below it."""
    page, _ = page
    box = page.locator("#video").bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    _until(page, lambda: flight.flight.targets)
    (place,) = list(flight.flight.targets.values())[:1]
    assert abs(place[1]) < 3.0  # the line that is flown
    assert -24.0 < place[0] < 24.0
    assert place[2] < flight.flight.cache.index.box_min[0, 2] + HEIGHT_M / 2
    _until(page, lambda: page.locator("#targets tbody tr").count() == 1)
    assert any(of.id is AlertId.CONSOLE_TARGET for of in flight.flight.said)


def test_without_a_gpu_the_map_is_drawn_seldom_and_all_at_once(page, flight):
    """The processor's drawings are taken from the flight: as many as pictures were 24 % of it."""
    page, _ = page
    _until(page, lambda: page.evaluate("window.consoleMap?.loaded === true"))
    assert page.evaluate("window.consoleMap.pace.everyMs") == 4000
    before = page.evaluate("[window.consoleMap.drawings, window.consoleFrames]")
    _until(page, lambda: page.evaluate("window.consoleFrames") >= before[1] + 12)
    after = page.evaluate("[window.consoleMap.drawings, window.consoleFrames]")
    assert after[0] - before[0] < (after[1] - before[1]) / 2
    drawn = page.evaluate(
        "[...window.consoleMap.moving].filter(([, f]) => f.length).map(([k]) => k)"
    )
    assert {"vision", "autopilot", "gnss", "ellipse", "footprint", "mission"} <= set(drawn)
    assert len(page.evaluate("window.consoleMap.about.outline")) > 2  # the coverage


def test_a_flight_that_hangs_is_called_silent_and_what_it_does_then_is_shown(page, flight):
    """What was told last would else look as good as new."""
    page, seen = page
    assert page.inner_text("#word").lower() == "tracking"
    shown, over = flight.flight.shown, threading.Event()
    told = shown.state

    def hung(*arguments):
        over.wait(60)
        return told(*arguments)

    shown.state = hung  # the link's own thread stands still, and with it all that the page gets
    try:
        _until(page, lambda: page.inner_text("#word").lower() == "silent")
        assert "nothing heard for" in page.inner_text("#reason")
    finally:
        shown.state = told
        over.set()
    before = page.evaluate("window.consoleFrames")
    _until(page, lambda: page.inner_text("#word").lower() == "tracking")
    _until(page, lambda: page.evaluate("window.consoleFrames") > before + 1)
    assert seen.errors == []


def test_the_mission_is_drawn_and_one_that_changed_is_drawn_anew(page, flight):
    page, _ = page
    _until(page, lambda: page.locator(".station").count() == 3)
    texts = page.locator(".station").all_inner_texts()
    assert texts == ["0", "1", "2"]
    whole = flight.flight.mission
    flight.flight.mission = whole[:2]
    _until(page, lambda: page.locator(".station").count() == 2)
    flight.flight.mission = whole


def test_a_hint_arrives_where_the_map_was_clicked(page, flight):
    """After those of the map: it is not followed any more."""
    page, _ = page
    _until(page, lambda: page.evaluate("window.consoleMap?.loaded === true"))
    page.click("#follow")
    page.click("#hint")
    page.click("#map", position={"x": 150, "y": 150})
    _until(page, lambda: flight.flight.hints)
    latitude, longitude, radius = flight.flight.hints[0]
    frame = flight.flight.cache.frame
    at = frame.enu_from_geodetic(latitude, longitude, frame.origin.height_m)
    assert np.hypot(*at[:2]) < 400.0
    assert radius == 150.0


def test_the_doctor_button_runs_the_doctor_and_tells_how_it_ended(page):
    page, seen = page
    page.click("nav button[data-view=doctor]")
    page.click("#examine")
    _until(page, lambda: page.inner_text("#doctor-told") in ("good", "advice", "not fit to fly"))
    said = page.inner_text("#doctor")
    assert "map" in said, said
    assert len(said.splitlines()) > 5
    assert seen.errors == []
