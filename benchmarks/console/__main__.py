"""What the operator's page costs a flight: the same recorded flight without a console, with one,
with one that a client looks at, and a page, one after the other, each as often.

    python -m benchmarks.console SEQUENCE --map CACHE [--frames 300] [--rounds 2] [--out FILE.json]

SEQUENCE is of `python -m sitl sequence`. `companion run` plays it in real time, beside a vehicle
that flies the truth. Processor time is the processes' own (not wall time); of the flight's process
the console's thread is timed apart, since two flights differ by more than it takes. The client
takes the same messages as the page and decodes the pictures: what a companion bears whose operator
has a computer of his own. With --browser the page is in Chromium, beside the flight, and a
picture's age is that of what has been painted; without, it is such a client, too. --console-nice:
priority of the console's process instead of its own, which is 10 behind the flight's.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import yaml

from benchmarks.common.arguments import Parser, existing, output, whole
from benchmarks.common.named_errors import named_errors
from benchmarks.console.chromium import NOTE_AGES, ages, browser_used_s, opened_browser, used_s
from benchmarks.console.limits import LIMITS
from benchmarks.console.vehicle import FirstFrames, ReplayVehicle, begun_ns
from companion.errors import ReportError
from companion.offline.tables import read_columns
from localizer.geometry.camera import Camera
from localizer.map.cache.cache import TileCache

Condition = Literal["no console", "no page", "light client", "one page"]
CONDITIONS: tuple[Condition, ...] = ("no console", "no page", "light client", "one page")
_PATIENCE_S = 120.0
_SETTLED_S = 5.0  # after the first estimate: the way up is no part of the cost


@dataclass(frozen=True)
class FlownWork:
    """What is flown."""

    sequence: FirstFrames
    camera: dict[str, Any]
    map_path: Path
    geoid_m: float
    console_nice: int | None
    browser_nice: int | None = None
    """The page in a browser, so much behind this process in priority; None: a client of it."""


class Page(threading.Thread):
    """Takes what a page takes, so much behind this process in priority. measured: of each picture
    when it was exposed, given out, made, here and decoded, ms of UTC.
    """

    def __init__(self, listen: str, pictures: bool, nice: int = 5) -> None:
        super().__init__(name="page", daemon=True)
        self._listen, self._pictures, self._nice = listen, pictures, nice
        self.measured: list[list[float]] = []
        self.link_s: list[float] = []
        self._over = threading.Event()

    def run(self) -> None:
        """Listen until `end`."""
        from websockets.exceptions import ConnectionClosed
        from websockets.sync.client import connect

        thread = threading.get_native_id()
        slower = min(os.getpriority(os.PRIO_PROCESS, thread) + self._nice, 19)
        os.setpriority(os.PRIO_PROCESS, thread, slower)
        origin: Any = f"http://{self._listen}"
        with connect(f"ws://{self._listen}/ws", origin=origin, max_size=None) as line:
            line.send(json.dumps({"frames": self._pictures, "map": False}))
            shown = 0
            while not self._over.is_set():
                try:
                    message = line.recv(timeout=0.5)
                    self._take(message)
                    if isinstance(message, bytes):
                        shown += 1
                        line.send(json.dumps({"frames": True, "map": False, "shown": shown}))
                except TimeoutError:
                    continue
                except ConnectionClosed:
                    return

    def end(self) -> None:
        """Close the page."""
        self._over.set()
        self.join()

    def forget(self) -> None:
        """What came until now does not count."""
        self.measured.clear()

    def _take(self, message: str | bytes) -> None:
        if isinstance(message, bytes):
            here_ms = time.time() * 1e3
            (size,) = struct.unpack_from("<I", message)
            head = json.loads(message[4 : 4 + size])
            jpeg = np.frombuffer(message, np.uint8, head["parts"][0], 4 + size)
            assert cv2.imdecode(jpeg, cv2.IMREAD_COLOR) is not None
            times = [head[f"{name}_utc_ms"] for name in ("exposure", "published", "made")]
            self.measured.append([*times, here_ms, time.time() * 1e3])
            return
        machine = (json.loads(message).get("state") or {}).get("machine") or {}
        if "console_link_s" in machine:
            self.link_s.append(machine["console_link_s"])


class BrowserPage(Page):
    """The page itself in Chromium; ages are taken when the frame that shows a picture was painted.
    It stands `nice` behind this process, as on a machine of its own it would take nothing.
    """

    def __init__(self, listen: str, nice: int) -> None:
        super().__init__(listen, pictures=True, nice=nice)
        self._fresh = threading.Event()
        self.complaints: list[str] = []

    def forget(self) -> None:
        """What was shown until now does not count."""
        self._fresh.set()

    def run(self) -> None:
        """Show it until `end`."""
        from playwright.sync_api import sync_playwright

        with sync_playwright() as driver:
            browser = opened_browser(driver, self._nice)
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            page.on("pageerror", lambda e: self.complaints.append(str(e)))
            page.goto(f"http://{self._listen}/", timeout=1e3 * _PATIENCE_S)
            page.evaluate(NOTE_AGES)
            while not self._over.is_set():
                page.wait_for_timeout(500)
                if self._fresh.is_set():
                    self._fresh.clear()
                    page.evaluate("window.measured.length = 0")
                self.measured = page.evaluate("window.measured")
                used = page.evaluate("window.consoleLinkS ?? null")
                if used is not None:
                    self.link_s.append(used)
            browser.close()


def fly(work: FlownWork, condition: Condition, folder: Path) -> dict[str, Any]:
    """One run; what it took and how well it localized."""
    listen = f"127.0.0.1:{_free_port(socket.SOCK_STREAM)}"
    port = _free_port(socket.SOCK_DGRAM)
    record = folder / "record"
    work.sequence.write_images(folder / "images")
    deployment = folder / "deployment.yaml"
    deployment.write_text(yaml.safe_dump(_deployment(work, condition, folder, port, listen)))
    begun = _Begin(record, work.sequence)
    command = [sys.executable, "-m", "companion", "run", str(deployment)]
    with (
        ReplayVehicle(port, work.sequence, work.geoid_m, begun.read),
        (folder / "run.log").open("wb") as log,
        _ended(subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)) as process,
    ):
        console = None if condition == "no console" else _console_of(process.pid)
        if console is not None:
            _wait(lambda: _is_up(listen, console, work.console_nice))
        _wait(lambda: begun.read() is not None or process.poll() is not None)
        if process.poll() is not None:
            raise ReportError(f"the companion ended before it localized: {_last_line(folder)}")
        page = None
        if condition in ("light client", "one page"):
            page = _page(work, condition, listen)
            page.start()
        time.sleep(_SETTLED_S)
        if page is not None:
            page.forget()
        link = _link_s(listen) if condition == "no page" else None
        before = _used_s(process.pid), _used_s(console), time.monotonic()
        browser = browser_used_s()
        first_link = page.link_s[-1] if page is not None and page.link_s else link
        end_s = (begun.read() or time.monotonic_ns()) * 1e-9 + work.sequence.length_s - 2.0
        time.sleep(max(end_s - time.monotonic(), 1.0))
        after = _used_s(process.pid), _used_s(console), time.monotonic()
        browser = {kind: used - browser.get(kind, 0.0) for kind, used in browser_used_s().items()}
        last_link = page.link_s[-1] if page is not None and page.link_s else None
        if condition == "no page":
            last_link = _link_s(listen)
        if page is not None:
            page.end()
        elapsed = after[2] - before[2]
        _wait(lambda: process.poll() is not None)
    cost: dict[str, Any] = {
        "condition": condition,
        "flight_percent": 100.0 * (after[0] - before[0]) / elapsed,
        "console_percent": 100.0 * (after[1] - before[1]) / elapsed,
        "link_percent": None if first_link is None or last_link is None
        else 100.0 * (last_link - first_link) / elapsed,
        "load": os.getloadavg()[0],
    }  # fmt: skip
    if page is not None:
        cost["frames_per_s"] = len(page.measured) / elapsed
        cost |= ages(page.measured)
        if isinstance(page, BrowserPage):
            cost |= {f"browser_{k}_percent": 100.0 * v / elapsed for k, v in browser.items()}
    return cost | quality(record, work.sequence)


def _page(work: FlownWork, condition: Condition, listen: str) -> Page:
    if work.browser_nice is None or condition == "light client":
        return Page(listen, pictures=True)
    return BrowserPage(listen, work.browser_nice)


def quality(record: Path, sequence: FirstFrames) -> dict[str, float]:
    """Rate, latency and error of a run, of the rows after the first seconds."""
    columns = read_columns(record / "estimates.csv", ("state", "status"))
    number = columns["sequence"].astype(int)
    late = sequence.times_ns[number] > _SETTLED_S * 1e9
    accepted = late & (columns["accepted"] > 0)
    truth = np.array([sequence.poses[i].translation for i in number])
    at = np.column_stack([columns[f"{axis}_m"] for axis in ("east", "north", "up")])
    error = np.linalg.norm(at - truth, axis=1)[accepted]
    latency = columns["latency_ms"][late]
    return {
        "localized_per_s": float(late.sum() / max(sequence.length_s - _SETTLED_S, 1e-9)),
        "accepted_share": float(accepted.sum() / max(int(late.sum()), 1)),
        "latency_p50_ms": float(np.percentile(latency, 50)),
        "latency_p95_ms": float(np.percentile(latency, 95)),
        "error_median_m": float(np.median(error)) if len(error) else float("nan"),
        "error_p95_m": float(np.percentile(error, 95)) if len(error) else float("nan"),
    }


def summary(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Medians over the rounds, and whether the limits hold. cost_percent: the console's process and
    its thread in the flight's.
    """
    told: dict[str, Any] = {}
    for condition in CONDITIONS:
        mine = [r for r in runs if r["condition"] == condition]
        if not mine:
            continue
        row = {
            key: float(np.median([r[key] for r in mine]))
            for key, value in mine[0].items()
            if isinstance(value, float)
        }
        if condition != "no console":
            row["cost_percent"] = row["console_percent"] + row.get("link_percent", 0.0)
            limit = "no page" if condition == "no page" else "one page"
            row["holds"] = float(row["cost_percent"] <= LIMITS[limit])
        told[condition] = row
    return told


def print_table(told: dict[str, Any]) -> None:
    """One column a condition."""
    names = [c for c in CONDITIONS if c in told]
    rows = list(dict.fromkeys(key for c in names for key in told[c]))
    print(f"{'':18}" + "".join(f"{name:>14}" for name in names))
    for key in rows:
        cells = (f"{told[c][key]:14.2f}" if key in told[c] else f"{'-':>14}" for c in names)
        print(f"{key:18}" + "".join(cells))
    print(
        f"limits: {LIMITS['no page']:.0f} % without a page, {LIMITS['one page']:.0f} % with one, "
        f"a picture {LIMITS['age_ms']:.0f} ms after its exposure, {LIMITS['frames_per_s']:.0f}/s"
    )


class _Begin:
    """When the flight's first image was exposed, asked of its record until it is known."""

    def __init__(self, record: Path, sequence: FirstFrames) -> None:
        self._record, self._sequence = record, sequence
        self._known: int | None = None

    def read(self) -> int | None:
        if self._known is None:
            self._known = begun_ns(self._record, self._sequence)
        return self._known


def _deployment(
    work: FlownWork, condition: Condition, folder: Path, port: int, listen: str
) -> dict[str, Any]:
    return {
        "map": str(work.map_path),
        "camera": {
            "source": str(folder / "images"), "model": work.camera, "settings": {"realtime": True}
        },
        "bridge": {"connection": f"udpin:127.0.0.1:{port}", "mode": "shadow"},
        "record": {"folder": str(folder / "record")},
        "console": None if condition == "no console" else {"listen": listen},
    }  # fmt: skip


@contextlib.contextmanager
def _ended(process: subprocess.Popen[bytes]) -> Iterator[subprocess.Popen[bytes]]:
    try:
        yield process
    finally:
        if process.poll() is None:
            process.terminate()
        try:
            process.wait(20.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _console_of(flight: int) -> int:
    """The console's process beside the flight's, once there is one."""
    found: list[int] = []

    def look() -> bool:
        for child in Path(f"/proc/{flight}/task/{flight}/children").read_text().split():
            if b"\0console\0" in Path(f"/proc/{child}/cmdline").read_bytes():
                found.append(int(child))
        return bool(found)

    _wait(look)
    if found:
        return found[0]
    raise ReportError("no console beside the flight: pip install '.[console]'")


def _used_s(process: int | None) -> float:
    return 0.0 if process is None else used_s(process)


def _link_s(listen: str) -> float | None:
    """The processor time of the console's thread in the flight, by a page that looks once."""
    page = Page(listen, pictures=False)
    page.start()
    _wait(lambda: bool(page.link_s), 10.0)
    page.end()
    return page.link_s[-1] if page.link_s else None


def _is_up(listen: str, console: int, nice: int | None) -> bool:
    """Whether it answers; it sets its own priority on the way up."""
    if nice is not None:
        os.setpriority(os.PRIO_PROCESS, console, nice)
    host, _, port = listen.rpartition(":")
    try:
        socket.create_connection((host, int(port)), 1.0).close()
    except OSError:
        return False
    return True


def _wait(holds: Any, patience_s: float = _PATIENCE_S) -> None:
    end = time.monotonic() + patience_s
    while not holds() and time.monotonic() < end:
        time.sleep(0.2)


def _last_line(folder: Path) -> str:
    return ((folder / "run.log").read_text(errors="replace").splitlines() or [""])[-1]


def _free_port(kind: int) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def main() -> None:
    """Fly, print, write."""
    parser = Parser(__doc__)
    parser.add_argument("sequence", type=existing, help="folder of `python -m sitl sequence`")
    parser.add_argument("--map", type=existing, required=True, help="its tile cache")
    parser.add_argument("--frames", type=whole(100, 100_000), default=300, help="of the sequence")
    parser.add_argument("--rounds", type=whole(1, 20), default=2, help="runs of each condition")
    parser.add_argument("--console-nice", type=whole(-20, 19), help="instead of 10 behind")
    parser.add_argument("--only", choices=CONDITIONS, help="one condition")
    parser.add_argument("--browser", action="store_true", help="the page in Chromium")
    parser.add_argument("--browser-nice", type=whole(0, 19), default=5, help="behind the flight's")
    parser.add_argument("--out", type=output, help="JSON file of all runs")
    options = parser.parse_args()
    cache = TileCache.open(options.map)
    work = FlownWork(
        FirstFrames.read(options.sequence, cache.frame, options.frames),
        Camera.from_json(options.sequence / "camera.json").to_dict(),
        options.map, cache.manifest.geoid_separation_m, options.console_nice,
        options.browser_nice if options.browser else None,
    )  # fmt: skip
    runs = []
    for number in range(options.rounds):
        # There and back: what warms up, or other work that begins, is nobody's in particular.
        for condition in CONDITIONS if number % 2 == 0 else CONDITIONS[::-1]:
            if options.only not in (None, condition):
                continue
            home = Path(tempfile.mkdtemp(prefix="console-"))
            try:
                runs.append(fly(work, condition, home))
            finally:
                shutil.rmtree(home, ignore_errors=True)
            print(json.dumps(runs[-1]), file=sys.stderr, flush=True)
    told = summary(runs)
    if options.out is not None:
        facts = {"summary": told, "runs": runs, "limits": LIMITS, "frames": options.frames}
        facts["console_nice"] = options.console_nice
        facts["browser_nice"] = options.browser_nice if options.browser else None
        options.out.write_text(json.dumps(facts, indent=1))
    print_table(told)


if __name__ == "__main__":
    with named_errors():
        main()
