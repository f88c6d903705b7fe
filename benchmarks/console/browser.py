"""A demo flight as a newcomer sees it: the page in a real browser from the moment its address is
printed, and the same flight without a page.

    python -m benchmarks.console.browser [--rounds 1] [--out FILE.json] [--screens FOLDER]

Each round flies `python -m sitl demo` without a page, with a client that takes and decodes what a
page gets (`benchmarks.console`), and with the page open; latency and rate of the localizer are
those of the same 45 s without GNSS. From the page: seconds from the printed address to the page,
its first picture and the first position; age of each picture when the frame that shows it has been
painted, exposure and paint on this machine's clock; what a hint and the doctor, pressed in the
page, were answered; what it complained of and whom it asked. From each flight's report: rate,
latency and accuracy of the localizer. Needs Chromium and playwright (the extra `dev`). The browser
runs already when the address comes. It shares the processors with the flight (--browser-nice lower
in priority); its map is drawn by the processor, too, which no operator's machine does.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any, Literal

import numpy as np

from benchmarks.common.arguments import Parser, existing, output, whole
from benchmarks.common.named_errors import named_errors
from benchmarks.console.__main__ import Page
from benchmarks.console.chromium import (
    NOTE_AGES,
    ages,
    browser_used_s,
    descendants,
    opened_browser,
    used_s,
)
from benchmarks.console.limits import LIMITS
from companion.errors import ReportError
from companion.offline.tables import read_columns

Condition = Literal["no page", "light client", "one page"]
CONDITIONS: tuple[Condition, ...] = ("no page", "light client", "one page")
SHORT = Path(__file__).with_name("short.yaml")
_ADDRESS = re.compile(r"watch it: (http://\S+)")
_PATIENCE_S = 420.0
_OPEN_S = 180.0
_DENIED, _RETURNED = "GNSS denied", "returned on vision"
_WATCHED_S = 45.0  # pictures are measured so long, undisturbed, before buttons are pressed
_SOON_S = 60.0


class Demo:
    """The demo's process, and when it said what. Ended with its context."""

    def __init__(self, folder: Path, scenario: Path, seed: int, vehicle: str) -> None:
        self.report = folder / "report"
        self.lines: list[tuple[float, str]] = []
        self.address: tuple[float, str] | None = None
        self._said = threading.Condition()
        self._process = subprocess.Popen(
            [
                sys.executable, "-m", "sitl", "demo", "--scenario", str(scenario),
                "--seed", str(seed), "--fc", vehicle, "--out", str(self.report),
            ],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            env=os.environ | {"COLUMNS": "200", "PYTHONUNBUFFERED": "1"},
        )  # fmt: skip
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def __enter__(self) -> Demo:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
        try:
            self._process.wait(30.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def wait_for_address(self) -> tuple[float, str]:
        """When it was printed (monotonic seconds), and what."""
        with self._said:
            self._said.wait_for(lambda: self.address is not None or self.is_over, _PATIENCE_S)
        if self.address is None:
            raise ReportError(f"the demo printed no address: {self.tail()}")
        return self.address

    def wait(self) -> None:
        """Until it has made its report."""
        try:
            self._process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired as error:
            raise ReportError(f"the demo has not ended in {_PATIENCE_S:.0f} s") from error
        if not (self.report / "report.json").exists():
            raise ReportError(f"the demo made no report: {self.tail()}")

    @property
    def is_over(self) -> bool:
        """Whether it ended."""
        return self._process.poll() is not None

    def has_said(self, text: str) -> bool:
        """Whether a line had that in it."""
        return any(text in line for _, line in tuple(self.lines))

    def tail(self) -> str:
        """What it said last."""
        return " | ".join(text for _, text in self.lines[-4:])

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            now = time.monotonic()
            found = _ADDRESS.search(line)
            with self._said:
                self.lines.append((now, line.rstrip()))
                if found is not None:
                    self.address = now, found.group(1)
                self._said.notify_all()


class ConsoleCost(threading.Thread):
    """Processor time of the console's process beside the flight, noted every second."""

    def __init__(self) -> None:
        super().__init__(name="console cost", daemon=True)
        self._over = threading.Event()
        self._noted: list[tuple[float, float]] = []

    def run(self) -> None:
        """Note until `end`."""
        pid: int | None = None
        while not self._over.wait(1.0):
            try:
                if pid is None:
                    pid = _console()
                if pid is not None:
                    self._noted.append((time.monotonic(), used_s(pid)))
            except OSError:  # it ended
                pid = None

    def end(self) -> None:
        """Note no more."""
        self._over.set()
        self.join()

    def percent(self, begin_s: float, end_s: float) -> float | None:
        """Of a core, between two times (monotonic); None where it was not there."""
        noted = [(at, used) for at, used in self._noted if begin_s <= at <= end_s]
        if len(noted) < 2:
            return None
        (begun, before), (ended, after) = noted[0], noted[-1]
        return 100.0 * (after - before) / (ended - begun)


def _console() -> int | None:
    for pid in descendants():
        words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        if b"console" in words and b"--lifeline" in words:
            return pid
    return None


def watch(demo: Demo, browser: Any, screens: Path | None, cost: ConsoleCost) -> dict[str, Any]:
    """What the page showed, and when."""
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    complaints: list[str] = []
    hosts: set[str] = set()

    def ask(request: Any) -> None:
        if "://" in request.url:
            hosts.add(request.url.split("/")[2])

    def complain(message: Any) -> None:
        if message.type == "error":
            complaints.append(message.text)

    page.on("pageerror", lambda e: complaints.append(str(e)))
    page.on("request", ask)
    begun, address = demo.wait_for_address()
    refused = _opened(page, address, demo)
    page.on("console", complain)
    told: dict[str, Any] = {"page_s": time.monotonic() - begun, "refused": refused}
    page.evaluate(NOTE_AGES)
    _until(page, demo, lambda: bool(page.evaluate("window.measured.length")), "picture")
    told["first_picture_s"] = time.monotonic() - begun
    _until(page, demo, lambda: page.inner_text("#word").lower() == "tracking", "position")
    told["first_position_s"] = time.monotonic() - begun
    _until(page, demo, lambda: demo.has_said(_DENIED), "flight without GNSS")
    page.evaluate("window.measured.length = 0")
    used, link_s, begun_s = browser_used_s(), _link_s(page), time.monotonic()
    page.wait_for_timeout(1e3 * _WATCHED_S)
    link_s, ended_s = _link_s(page) - link_s, time.monotonic()
    share = 100.0 / (ended_s - begun_s)
    told |= {
        f"browser_{kind}_percent": share * (now - used[kind])
        for kind, now in browser_used_s().items()
    }
    told["link_percent"], told["console_percent"] = share * link_s, cost.percent(begun_s, ended_s)
    told["watched_s"] = begun_s, ended_s
    told |= _ages(page.evaluate("window.measured"))
    told["problems"] = problems(told)
    told["mission_points"] = page.evaluate("window.consoleMap?.missionLength ?? 0")
    told["hint"] = _hint(page)
    told["doctor"] = _refused_doctor(page)
    told["in_flight"] = not demo.is_over
    if screens is not None:
        _pictures(page, demo, screens)
    told |= {"complaints": complaints, "hosts": sorted(hosts)}
    told["only_itself"] = hosts == {address.split("/")[2]}
    demo.wait()
    page.close()
    return told


def listen(demo: Demo, cost: ConsoleCost) -> dict[str, Any]:
    """What a client gets, decoded, as long as `watch` looks at the page."""
    begun, address = demo.wait_for_address()
    page = Page(address.split("/")[2], pictures=True)
    page.start()
    _wait(demo, lambda: bool(page.measured and page.link_s), "picture")
    told: dict[str, Any] = {"first_picture_s": time.monotonic() - begun}
    _wait(demo, lambda: demo.has_said(_DENIED), "flight without GNSS")
    page.forget()
    link_s, begun_s = page.link_s[-1], time.monotonic()
    time.sleep(_WATCHED_S)
    ended_s = time.monotonic()
    told["link_percent"] = 100.0 * (page.link_s[-1] - link_s) / (ended_s - begun_s)
    told["console_percent"] = cost.percent(begun_s, ended_s)
    told["watched_s"] = begun_s, ended_s
    told |= _ages(list(page.measured))
    page.end()
    demo.wait()
    return told


def problems(told: dict[str, Any]) -> list[str]:
    """Of what is asked for beside a flight, what does not hold."""
    found = []
    if not told["frames_per_s"] >= LIMITS["frames_per_s"]:
        found.append(f"{told['frames_per_s']:.1f} pictures a second")
    if not told["age_p50_ms"] <= LIMITS["age_ms"]:
        found.append(f"a picture is {told['age_p50_ms']:.0f} ms old in the median")
    if not told["age_p95_ms"] <= LIMITS["age_ms"]:
        found.append(f"one picture in twenty is older than {told['age_p95_ms']:.0f} ms")
    taken = (told["console_percent"] or float("nan")) + told["link_percent"]
    if not taken <= LIMITS["one page"]:
        found.append(f"the console takes {taken:.1f} % of a core")
    if told["first_position_s"] > _SOON_S:
        found.append(f"the flight is seen {told['first_position_s']:.0f} s after its address")
    return found


def _link_s(page: Any) -> float:
    return float(page.evaluate("window.consoleLinkS ?? 0"))


def _opened(page: Any, address: str, demo: Demo) -> int:
    """Load it as somebody would who tries again; how often it was refused."""
    from playwright.sync_api import Error

    end, refused = time.monotonic() + _OPEN_S, 0
    while time.monotonic() < end and not demo.is_over:
        try:
            page.goto(address, timeout=30_000)
        except Error:
            refused += 1
            time.sleep(0.5)
        else:
            return refused
    raise ReportError(f"{address}: cannot be opened: {demo.tail()}")


def _until(page: Any, demo: Demo, holds: Any, what: str) -> None:
    _wait(demo, holds, what, lambda: page.wait_for_timeout(100))


def _wait(demo: Demo, holds: Any, what: str, pause: Any = lambda: time.sleep(0.1)) -> None:
    end = time.monotonic() + _OPEN_S
    while not holds():
        if time.monotonic() > end or demo.is_over:
            raise ReportError(f"the page showed no {what}: {demo.tail()}")
        pause()


def _ages(shown: list[list[float]]) -> dict[str, float]:
    """shown: as `NOTE_AGES` notes them."""
    if len(shown) < 2:
        raise ReportError(f"the page showed {len(shown)} pictures in {_WATCHED_S:.0f} s")
    painted = [times[-1] for times in shown]
    return {"frames_per_s": 1e3 * (len(shown) - 1) / (painted[-1] - painted[0]), **ages(shown)}


def _hint(page: Any) -> str:
    """Press it and click into the map; what the flight answered."""
    page.click("nav button[data-view=map]")
    page.click("#hint")
    page.click("#map", position={"x": 200, "y": 200})
    return _answer(page, "#map-note", "click where you are")


def _refused_doctor(page: Any) -> str:
    """Press it; in the air it is refused, and the page says why."""
    page.click("nav button[data-view=doctor]")
    page.click("#examine")
    return _answer(page, "#doctor-told", "")


def _answer(page: Any, where: str, before: str) -> str:
    text = ""
    for _ in range(50):
        text = str(page.inner_text(where))
        if text not in (before, ""):
            break
        page.wait_for_timeout(100)
    return text


def _pictures(page: Any, demo: Demo, folder: Path) -> None:
    """As many as the flight is long enough for."""
    folder.mkdir(parents=True, exist_ok=True)
    views = page.eval_on_selector_all("nav button", "all => all.map(b => b.dataset.view)")
    for width, height in ((1280, 800), (390, 844)):
        page.set_viewport_size({"width": width, "height": height})
        for view in views:
            if demo.has_said(_RETURNED):
                return
            page.click(f"nav button[data-view={view}]")
            page.wait_for_timeout(1500)
            page.screenshot(path=folder / f"{view}-{width}.jpg", type="jpeg", quality=75)
    page.set_viewport_size({"width": 1280, "height": 800})


def quality(folder: Path, begun_s: float, ended_s: float) -> dict[str, Any]:
    """The localizer's figures: latency and rate between two times (monotonic), in which nothing but
    the condition differs, the others of the whole flight's report.
    """
    report = json.loads((folder / "report.json").read_text())["report"]
    latency, error = report["stages_ms"].get("latency") or {}, report["localizer_m"]
    columns = read_columns(folder / "companion" / "estimates.csv", ("state", "status"))
    exposed_s = columns["exposure_time_ns"] * 1e-9
    watched = columns["latency_ms"][(exposed_s >= begun_s) & (exposed_s <= ended_s)]
    return {
        # As `benchmarks.console` names them: `benchmarks.console.table` joins both.
        "localized_per_s": len(watched) / (ended_s - begun_s),
        "latency_p50_ms": float(np.percentile(watched, 50)),
        "latency_p95_ms": float(np.percentile(watched, 95)),
        "error_median_m": error["median"],
        "error_p95_m": error["p95"],
        "localizer": report["localizer"],
        "localizer_m": error,
        "latency_ms": latency,
        "completeness_sent": report["completeness_sent"],
        "inside_bound": report["inside_bound"],
        "ekf_in_map_m": report["ekf_in_map_m"],
    }


def fly(condition: Condition, options: Any) -> dict[str, Any]:
    """One flight."""
    folder = Path(tempfile.mkdtemp(prefix="console-"))
    cost = ConsoleCost()
    cost.start()
    try:
        with Demo(folder, options.scenario, options.seed, options.fc) as demo:
            told: dict[str, Any] = {"condition": condition, "load": os.getloadavg()[0]}
            if condition == "one page":
                from playwright.sync_api import sync_playwright

                with sync_playwright() as driver:
                    browser = opened_browser(driver, options.browser_nice)
                    told |= watch(demo, browser, options.screens, cost)
                    browser.close()
            elif condition == "light client":
                told |= listen(demo, cost)
            else:
                _wait(demo, lambda: demo.has_said(_DENIED), "flight without GNSS")
                begun_s = time.monotonic()
                told["watched_s"] = begun_s, begun_s + _WATCHED_S
                demo.wait()
                told["console_percent"] = cost.percent(*told["watched_s"])
            begun = demo.lines[0][0] if demo.lines else 0.0
            told["said"] = [f"{at - begun:.1f} {text}" for at, text in demo.lines]
            print(json.dumps(told), file=sys.stderr, flush=True)  # whatever the report lacks
            return told | quality(demo.report, *told["watched_s"])
    finally:
        cost.end()
        if options.keep is not None:
            kept = options.keep / condition.replace(" ", "-")
            shutil.rmtree(kept, ignore_errors=True)
            shutil.copytree(folder / "report", kept, symlinks=True)
        shutil.rmtree(folder, ignore_errors=True)


def main() -> None:
    """Fly, print, write."""
    parser = Parser(__doc__)
    parser.add_argument("--rounds", type=whole(1, 20), default=1, help="flights of each condition")
    parser.add_argument("--only", choices=CONDITIONS, help="one condition")
    parser.add_argument("--scenario", type=existing, default=SHORT, help="YAML")
    parser.add_argument("--seed", type=whole(0, 10_000), default=0, help="of world and errors")
    parser.add_argument("--fc", default="embedded", help="ardupilot or embedded")
    parser.add_argument("--browser-nice", type=whole(0, 19), default=5, help="behind the flight's")
    parser.add_argument("--screens", type=Path, help="folder for a JPEG of each view and size")
    parser.add_argument("--keep", type=Path, help="folder for the flights' reports")
    parser.add_argument("--out", type=output, help="JSON file of all flights")
    options = parser.parse_args()
    runs = []
    for number in range(options.rounds):
        # There and back: what warms up, or other work that begins, is nobody's in particular.
        for condition in CONDITIONS if number % 2 == 0 else CONDITIONS[::-1]:
            if options.only in (None, condition):
                runs.append(fly(condition, options))
                print(json.dumps(runs[-1]), flush=True)
                if options.out is not None:
                    options.out.write_text(json.dumps({"runs": runs}, indent=1))


if __name__ == "__main__":
    with named_errors():
        main()
