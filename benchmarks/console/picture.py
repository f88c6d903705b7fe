"""What one picture of the console costs each process, without a flight around it.

    python -m benchmarks.console.picture [--pictures 200] [--hz 10] [--out FILE.json]

This process stands for the flight: it gives out pictures of the demo's size with a reference view,
as a flight does, and its link's thread serves them. A child process stands for the console: it
takes them over the socket and makes what a page is sent. Processor milliseconds a picture, of each
thread's own clock; of the way also the time from "given out" to "there", of which a picture's age
has the more the busier the machine is.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.arguments import Parser, existing, number, output, whole
from benchmarks.common.named_errors import named_errors
from companion.console.flight_source import FlightSource
from companion.console.pictures import page_message
from companion.errors import ReportError
from companion.live.orders import Helm, Orders
from companion.live.publisher import Publisher
from companion.live.shown import Instruments, Shown
from localizer.geometry.camera import Camera
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Pose
from localizer.types import (
    Frame,
    PoseEstimate,
    ReferenceBundle,
    RegistrationStatus,
    RenderedView,
    TrackingState,
)
from mavlink_bridge.injection.shadow import ShadowScore
from mavlink_bridge.messages import VehicleState

_CAMERA = Camera.from_fov(640, 480, 65.0)  # the demo's
_SEEN = Camera.from_fov(512, 384, 65.0)  # as large a view as the localizer renders
_HEIGHT_M = 80.0
_DOWN = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, _HEIGHT_M]))
_WIDTH_PX = 640
_PATIENCE_S = 20.0
_FASTEST_HZ = 15.0
_ROWS = (
    ("the link's thread in the flight, CPU ms", "flight_link_ms"),
    ("the console takes it, CPU ms", "console_receive_ms"),
    ("the console makes JPEG and edges, CPU ms", "console_make_ms"),
    ("from given out to there, p50, ms", "way_p50_ms"),
    ("from given out to there, p95, ms", "way_p95_ms"),
)


def give(pictures: int, hz: float, width_px: int) -> dict[str, float]:
    """Serve that many to a child process; both sides' figures."""
    shown = Shown(LocalFrame(Geodetic(47.0, 8.0, 400.0)), 48.0, _instruments(), {"mode": "shadow"})
    helm = Helm(lambda *_: None, lambda _: None, lambda *_: None)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "s"
        publisher = Publisher(path, shown, Orders(False, helm), _FASTEST_HZ)
        publisher.start()
        command = [sys.executable, "-m", "benchmarks.console.picture", "--take", str(path)]
        command += ["--pictures", str(pictures), "--width", str(width_px)]
        try:
            with subprocess.Popen(command, stdout=subprocess.PIPE) as child:
                stalls = _fly(publisher, shown, hz, child)
                out, _ = child.communicate()
        finally:
            publisher.stop()
            publisher.close()
    if child.returncode != 0:
        raise ReportError("the process that takes the pictures failed: see above")
    told: dict[str, float] = json.loads(out)
    link_s = told.pop("link_s")
    return {"flight_link_ms": 1e3 * link_s / told["pictures"], **stalls, **told}


def _fly(
    publisher: Publisher, shown: Shown, hz: float, child: subprocess.Popen[bytes]
) -> dict[str, float]:
    """Frames and estimates until the child has enough; what the giving itself took, us."""
    rng = np.random.default_rng(0)
    # Blurred noise: edges and JPEG as of a photo, not of a flat colour.
    images = [_photo(rng, _CAMERA) for _ in range(4)]
    views = [_photo(rng, _SEEN) for _ in range(4)]
    depth = np.full((_SEEN.height, _SEEN.width), _HEIGHT_M, np.float32)
    taken: list[float] = []
    anchors: Any = None  # the console looks at none
    number = 0
    while child.poll() is None:
        time.sleep(1.0 / hz)
        now = time.monotonic_ns()
        frame = Frame(images[number % 4], now, _CAMERA, number)
        view = RenderedView(views[number % 4], depth, _DOWN, _SEEN)
        estimate = PoseEstimate(
            _DOWN, np.eye(6) * 0.01, 0.8, TrackingState.TRACKING, RegistrationStatus.OK, True,
            now, number, _CAMERA, {"latency": 50.0}, now,
        )  # fmt: skip
        begun = time.perf_counter()
        if publisher.is_watched:
            shown.add_frame(frame)
        shown.add_estimate(estimate, ReferenceBundle(view, anchors, now))
        publisher.wake()
        taken.append(1e6 * (time.perf_counter() - begun))
        number += 1
    return {"flight_give_p95_us": float(np.percentile(taken or [np.nan], 95))}


def _photo(rng: np.random.Generator, camera: Camera) -> np.ndarray:
    import cv2

    coarse = rng.integers(0, 256, (camera.height // 8, camera.width // 8, 3), dtype=np.uint8)
    size = (camera.width, camera.height)
    return np.asarray(cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC))


def _instruments() -> Instruments:
    return Instruments(
        lambda: {"level": "ok", "text": "localization tracking", "rate_hz": 10.0}, VehicleState,
        lambda: ShadowScore(False, 0, ("none",)), lambda: None, lambda: True,
    )  # fmt: skip


async def take(path: Path, pictures: int, width_px: int) -> dict[str, float]:
    """The console's part of it, a picture at a time as a page would get them."""
    source = FlightSource(path)
    source.watch(True)
    task = asyncio.create_task(source.run())
    ways: list[float] = []
    made_s = receive_s = first_link_s = 0.0
    seen, before = 0, 0.0
    try:
        while len(ways) < pictures:
            await asyncio.wait_for(source.changed(), _PATIENCE_S)
            newest = source.newest
            if newest.frames == seen or newest.frame is None or newest.state is None:
                continue
            now_ns, now_s = time.monotonic_ns(), time.thread_time()
            if seen == 0:
                first_link_s = _link_s(newest.state)  # the way up is no part of it
            else:
                receive_s += now_s - before
                ways.append(1e-6 * (now_ns - newest.frame.head["published_ns"]))
            seen = newest.frames
            page_message(newest.frame, False, width_px)
            before = time.thread_time()
            if ways:
                made_s += before - now_s
        link_s = _link_s(source.newest.state or {}) - first_link_s
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
    count = len(ways)
    return {
        "pictures": count,
        "link_s": link_s,
        "console_receive_ms": 1e3 * receive_s / count,
        "console_make_ms": 1e3 * made_s / count,
        "way_p50_ms": float(np.percentile(ways, 50)),
        "way_p95_ms": float(np.percentile(ways, 95)),
    }


def _link_s(state: dict[str, Any]) -> float:
    return float((state.get("machine") or {}).get("console_link_s") or 0.0)


def main() -> None:
    """Give, take, print, write."""
    parser = Parser(__doc__)
    parser.add_argument("--pictures", type=whole(10, 10_000), default=200, help="that are taken")
    parser.add_argument("--hz", type=number(0.5, 100.0), default=10.0, help="of the flight")
    parser.add_argument("--width", type=whole(64, 4096), default=_WIDTH_PX, help="of the page, px")
    parser.add_argument("--take", type=Path, help="be the console of this socket (used by itself)")
    parser.add_argument(
        "--against", type=existing, nargs="+", default=[], help="what it wrote for another version"
    )
    parser.add_argument("--out", type=output, help="JSON file")
    options = parser.parse_args()
    if options.take is not None:
        print(json.dumps(asyncio.run(take(options.take, options.pictures, options.width))))
        return
    told = give(options.pictures, options.hz, options.width)
    for name, value in told.items():
        print(f"{name:22}{value:10.3f}")
    if options.out is not None:
        runs = [json.loads(path.read_text()) for path in options.against] + [told]
        columns = ["of one picture", *(f"before, {k + 1}" for k in range(len(runs) - 1)), "now"]
        rows = [[label, *(f"{run[key]:.2f}" for run in runs)] for label, key in _ROWS]
        options.out.write_text(json.dumps({"columns": columns, "rows": rows} | told, indent=1))


if __name__ == "__main__":
    with named_errors():
        main()
