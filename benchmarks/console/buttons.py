"""The console's buttons pressed in a flight, in a real browser: hint, click, doctor.

    python -m benchmarks.console.buttons [--fc embedded] [--out FILE.json] [--screens DIR]

The vehicle hovers without GNSS when its companion is started: it knows no place (the loop's
`cold-start`, over a map of 2.6 km2, which takes its search longer than the operator). In the page,
"I am here" is pressed and the map is clicked at the true place; once it tracks, a click into the
video makes a target, which is held against the world that the camera saw; the doctor is pressed in
the air, where it must be refused; then the vehicle lands, and it must run.
Nothing waits for a time: each step waits for what the page shows. Exit code 1: something fails.
Needs Chromium and playwright (the extra `dev`).
"""

from __future__ import annotations

import json
import re
import shutil
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.arguments import Parser, output, whole
from benchmarks.common.named_errors import named_errors
from benchmarks.console.chromium import opened_browser
from companion.errors import ReportError
from sitl.camera.movers import Mover
from sitl.operator.operator import Asked
from sitl.operator.truth import GroundTruth
from sitl.operator.wishes import Wish
from sitl.suite.loop.case import LoopCase, load_loop_cases
from sitl.suite.loop.flight import Cabin, fly
from sitl.suite.loop.runner import loop_assets

CLICK = (0.6, 0.4)  # of the picture: aside of its middle, where a wrong camera would not show
NEAR_M = 1.0  # a click's target to what it pointed at
_RADIUS_M = 60
_PATIENCE_S = 100.0
_LAND_S = 90.0
_CLOSE_S = 20.0
_PICTURE_MS = 10_000.0
_SIZE_M = 1600.0
_LENGTH_S = 90.0
_HEIGHT_M = 50.0  # low, so that it is soon on the ground
_NOTE_ORDERS = """() => {
  window.orders = [];
  addEventListener("console-order", ({ detail }) => window.orders.push(detail));
}"""


class PageOperator:
    """A `Passenger` with the page before him. told: what he saw, and when since he got aboard."""

    def __init__(self, listen: str, browser_nice: int, screens: Path | None) -> None:
        self._listen, self._nice, self._screens = listen, browser_nice, screens
        self._over = threading.Event()
        self._landed = threading.Event()
        self._pressed = threading.Event()
        self._cabin: Cabin | None = None
        self._aboard = threading.Event()
        self._begun_s = time.monotonic()
        self.told: dict[str, Any] = {}
        # He has his browser open before he flies.
        self._thread = threading.Thread(target=self._run, name="page operator", daemon=True)
        self._thread.start()

    def movers(self, _epoch_ns: int) -> tuple[Mover, ...]:
        """He brings none along."""
        return ()

    @contextmanager
    def ride(self, cabin: Cabin) -> Iterator[None]:
        """Press in the air, then have it landed and press again."""
        self._cabin, self._begun_s = cabin, time.monotonic()
        self._aboard.set()
        try:
            yield
            if self._pressed.is_set():
                cabin.pilot.land(_LAND_S)
                self._landed.set()
                self._thread.join(_PATIENCE_S)
        finally:
            self._over.set()
            self._thread.join(_CLOSE_S)

    def _run(self) -> None:
        from playwright.sync_api import sync_playwright

        try:
            with sync_playwright() as driver:
                browser = opened_browser(driver, self._nice)
                try:
                    self._aboard.wait()
                    page = browser.new_page(viewport={"width": 1280, "height": 800})
                    self._press(page)
                finally:
                    browser.close()
        except Exception as error:  # a dead operator is no passed flight
            self.told["failure"] = f"{type(error).__name__}: {str(error).splitlines()[0]}"
            print(self.told["failure"], file=sys.stderr, flush=True)

    def _press(self, page: Any) -> None:
        complaints: list[str] = []
        page.on("pageerror", lambda error: complaints.append(str(error)))
        self.told["complaints"] = complaints
        self._until(page, lambda: _opened(page, self._listen), "page")
        page.evaluate(_NOTE_ORDERS)
        self._until(page, lambda: page.evaluate("window.consoleMap?.loaded === true"), "map")
        self._until(page, lambda: (page.evaluate("window.consoleFrames") or 0) > 0, "picture")
        self._note("page_s")
        self.told["word_before"] = _word(page)
        self._hint(page)
        self._picture(page, "hint")
        self._until(page, lambda: _word(page) == "tracking", "tracking")
        self._note("tracking_s")
        self._click(page)
        self._picture(page, "target")
        page.click("nav button[data-view=doctor]")
        page.click("#examine")
        self._until(page, lambda: page.inner_text("#doctor-told") != "", "answer of the doctor")
        self.told["doctor_in_the_air"] = page.inner_text("#doctor-told")
        self._note("doctor_refused_s")
        self._pressed.set()
        self._picture(page, "doctor-in-the-air")
        # The flight hovers to its end whatever was pressed when, and lands then.
        self._until(page, self._landed.is_set, "landing", _LENGTH_S + _LAND_S)
        self._until(page, lambda: "disarmed" in page.inner_text("#figures"), "disarmed vehicle")
        page.click("#examine")
        begun_s = time.monotonic()
        words = ("good", "advice", "not fit to fly")
        self._until(page, lambda: page.inner_text("#doctor-told") in words, "doctor")
        self.told["doctor_took_s"] = time.monotonic() - begun_s
        self.told["doctor_on_the_ground"] = page.inner_text("#doctor-told")
        self.told["doctor_lines"] = page.inner_text("#doctor").splitlines()
        self._picture(page, "doctor-on-the-ground")

    def _hint(self, page: Any) -> None:
        assert self._cabin is not None
        at = self._cabin.pilot.record.truth.location
        page.fill("#radius", str(_RADIUS_M))
        page.click("#follow")
        where = page.evaluate(
            "([lon, lat]) => { const p = window.consoleMap.map.project([lon, lat]);"
            " return [p.x, p.y]; }",
            [at.longitude_deg, at.latitude_deg],
        )
        page.click("#hint")
        self.told["word_at_hint"] = _word(page)
        # By the mouse itself: the aircraft's sign may stand where he clicks.
        box = page.locator("#map").bounding_box()
        page.mouse.click(box["x"] + where[0], box["y"] + where[1])
        said = "click where you are"
        self._until(page, lambda: page.inner_text("#map-note") != said, "answer to the hint")
        self.told["hint"] = page.inner_text("#map-note")
        self._note("hint_s")

    def _click(self, page: Any) -> None:
        box = page.locator("#video").bounding_box()
        page.mouse.click(box["x"] + CLICK[0] * box["width"], box["y"] + CLICK[1] * box["height"])
        self._until(page, lambda: page.locator("#targets tbody tr").count() > 0, "target")
        self._note("target_s")
        self.told["order"] = page.evaluate("window.orders[0]")
        cells = page.locator("#targets tbody tr").first.locator("td").all_inner_texts()
        self.told["target"] = {"place": cells[1], "ellipsoidal_m": float(cells[4])}
        self.told["target_said"] = page.inner_text("#video-told")

    def _picture(self, page: Any, name: str) -> None:
        """For somebody who looks; whatever was pressed was pressed without it."""
        from playwright.sync_api import Error

        if self._screens is None:
            return
        try:
            page.screenshot(path=self._screens / f"{name}.png", timeout=_PICTURE_MS)
        except Error as error:
            self.told.setdefault("no_pictures", []).append(f"{name}: {error.message[:80]}")

    def _note(self, name: str) -> None:
        self.told[name] = time.monotonic() - self._begun_s
        print(f"{name}: {self.told[name]:.1f}", file=sys.stderr, flush=True)

    def _until(
        self, page: Any, holds: Callable[[], bool], what: str, patience_s: float = _PATIENCE_S
    ) -> None:
        """The page's own policy forbids playwright's way to wait for a condition."""
        end = time.monotonic() + patience_s
        while not holds():
            if self._over.is_set() or time.monotonic() > end:
                raise ReportError(f"the page showed no {what}")
            page.wait_for_timeout(100)


def flight(listen: str) -> LoopCase:
    """The loop's cold start, with a console."""
    (cold,) = load_loop_cases(["cold-start"])
    return cold.model_copy(
        update={
            "name": "buttons",
            "seconds": _LENGTH_S,
            "height_m": _HEIGHT_M,
            "size_m": _SIZE_M,
            "deployment": {"console": {"listen": listen, "control": True}},
        }
    )


def press(
    kind: Any, seed: int, folder: Path, browser_nice: int, screens: Path | None = None
) -> dict[str, Any]:
    """Fly it; what was pressed, what came of it, and what is wrong with that (`problems`)."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        listen = f"127.0.0.1:{probe.getsockname()[1]}"
    case = flight(listen)
    assets = loop_assets(case, seed, None, lambda _phase, _share: None)
    operator = PageOperator(listen, browser_nice, screens)
    fly(case, assets, kind, seed, folder, operator)
    told = operator.told
    if "order" in told:
        witness = GroundTruth(assets.world, case.scenario.camera.camera(), folder / "frames.csv")
        told["target_off_m"] = target_error(witness, told["order"], told["target"])
    told["hint_to_tracking_s"] = told.get("tracking_s", np.nan) - told.get("hint_s", np.nan)
    return told | {"vehicle": kind, "seed": seed, "problems": problems(told)}


def target_error(witness: GroundTruth, order: dict[str, Any], target: dict[str, Any]) -> float:
    """3-D, of what the page's table told to what the clicked pixel saw, m."""
    wish = Wish("point", 0.0, (order["x"], order["y"]))
    when = order["exposure_ns"]
    truth = witness.pointed(Asked(wish, when, when, 0, when, 0.0, 1, 0)).place
    if truth is None:
        return float("inf")
    latitude, longitude = (float(x) for x in target["place"].split(","))
    height = target["ellipsoidal_m"] - witness.geoid_m
    return float(np.linalg.norm(witness.place_of(latitude, longitude, height) - truth))


def problems(told: dict[str, Any]) -> list[str]:
    """What did not go as it should."""
    found = [f"{key}: {told[key]}" for key in ("failure", "complaints") if told.get(key)]
    if told.get("word_at_hint") == "tracking":
        found.append("it tracked before the hint, which so shows nothing")
    if not re.match(r"hint .* \+-60 m", told.get("hint", "")):
        found.append(f"the hint was answered: {told.get('hint')}")
    if not told["hint_to_tracking_s"] >= 0.0:
        found.append("it did not track after the hint")
    if not told.get("target_off_m", np.inf) <= NEAR_M:
        found.append(f"the target is {told.get('target_off_m')} m off")
    if "armed" not in told.get("doctor_in_the_air", ""):
        found.append(f"the doctor in the air: {told.get('doctor_in_the_air')}")
    if "doctor_on_the_ground" not in told:
        found.append("the doctor did not run on the ground")
    return found


def table(told: dict[str, Any]) -> dict[str, Any]:
    """As `python -m benchmarks.site.keep` takes it."""
    air, ground = (told.get(f"doctor_{where}", "-") for where in ("in_the_air", "on_the_ground"))
    rows = [
        ["page with map and picture, after the start, s", f"{told.get('page_s', np.nan):.1f}"],
        ["*I am here* to tracking, s", f"{told['hint_to_tracking_s']:.1f}"],
        [
            "target of a click, 3-D off what was clicked, m",
            f"{told.get('target_off_m', np.nan):.3f}",
        ],
        ["the doctor in the air", air],
        ["the doctor after landing", f"{ground}, {told.get('doctor_took_s', np.nan):.1f} s"],
        ["wrong", "; ".join(told["problems"]) or "nothing"],
    ]
    flown = f"{told['vehicle']}, seed {told['seed']}"
    return {"columns": ["pressed in flight", flown], "rows": rows}


def _opened(page: Any, listen: str) -> bool:
    from playwright.sync_api import Error

    try:
        page.goto(f"http://{listen}/", timeout=30_000)
    except Error:
        return False  # the companion is on its way up
    return True


def _word(page: Any) -> str:
    return str(page.inner_text("#word")).lower()


def main() -> None:
    """Fly, print, write."""
    parser = Parser(__doc__)
    parser.add_argument(
        "--fc", choices=("embedded", "ardupilot"), default="embedded", help="the simulated vehicle"
    )
    parser.add_argument("--seed", type=whole(0, 10_000), default=0, help="of world and noise")
    parser.add_argument("--browser-nice", type=whole(0, 19), default=5, help="behind the flight's")
    parser.add_argument("--keep", type=Path, help="folder for the flight's records")
    parser.add_argument("--screens", type=Path, help="folder for a PNG after each button")
    parser.add_argument("--out", type=output, help="JSON file")
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="buttons-"))
    if options.screens is not None:
        options.screens.mkdir(parents=True, exist_ok=True)
    try:
        told = press(options.fc, options.seed, folder, options.browser_nice, options.screens)
        print(json.dumps(told, indent=1, default=str))
        if options.out is not None:
            options.out.write_text(json.dumps(told | table(told), indent=1, default=str))
    finally:
        if options.keep is not None:
            shutil.rmtree(options.keep, ignore_errors=True)
            shutil.copytree(folder, options.keep, symlinks=True)
        shutil.rmtree(folder, ignore_errors=True)
    sys.exit(1 if told["problems"] else 0)


if __name__ == "__main__":
    with named_errors():
        main()
