"""What the bridge can carry, and how fast: throughput on one core, latency from estimate to socket.

    python -m benchmarks.bridge [--seconds 10] [--load 1 5 10]

An autopilot (a process of its own, UDP loopback) streams LOAD times what the bridge asks for, while
fixes are submitted at 20 Hz (more than 50 Hz ArduPilot drops). Latency is from `Bridge.submit` to
the arrival of VISION_POSITION_ESTIMATE in the autopilot's process, on the same clock. CPU is that
of the bridge's process alone.

The last rows have a neighbour in the bridge's own process that computes in Python without a pause,
as a localizer may: whoever wakes up waits for the interpreter lock for as long as
`sys.setswitchinterval` says. The companion sets it to 0.2 ms, Python's default is 5 ms.
"""

from __future__ import annotations

import logging
import multiprocessing
import sys
import threading
import time

import numpy as np

from benchmarks.bridge.autopilot import autopilot
from benchmarks.common.arguments import Parser, number, output
from benchmarks.common.figures import show_figures
from benchmarks.common.named_errors import named_errors
from mavlink_bridge import Bridge, BridgeConfig, VisionFix
from mavlink_bridge.config import InjectionConfig, OriginConfig
from mavlink_bridge.errors import BridgeError

HOME = (47.397742, 8.545594)
FIX_HZ = 20.0
COMPANION_SWITCH_MS = 0.2


def compute(stop: threading.Event) -> None:
    """A neighbour that never lets go of the interpreter by itself."""
    total = 0
    while not stop.is_set():
        for i in range(1000):
            total += i * i


def run(load: float, seconds: float, switch_ms: float | None = None) -> dict[str, float]:
    """One measurement. switch_ms: with a computing neighbour, at that switch interval."""
    stop = threading.Event()
    if switch_ms is not None:
        sys.setswitchinterval(switch_ms * 1e-3)
        threading.Thread(target=compute, args=(stop,), daemon=True).start()
    try:
        return measure(load, seconds)
    finally:
        stop.set()
        sys.setswitchinterval(0.005)


def measure(load: float, seconds: float) -> dict[str, float]:
    """Submit and count."""
    here, there = multiprocessing.Pipe()
    # Not forked: a copy of the computing neighbour's locks would be a copy of its state.
    process = multiprocessing.get_context("spawn").Process(
        target=autopilot, args=(there, load), daemon=True
    )
    process.start()
    config = BridgeConfig(
        connection=f"udpout:127.0.0.1:{here.recv()}",
        mode="inject",
        origin=OriginConfig(latitude_deg=HOME[0], longitude_deg=HOME[1], altitude_amsl_m=488.0),
        # No waiting for the age of fixes here: the delay under test is the bridge's own. Forced: no
        # GNSS is sent that the shadow score could compare with.
        injection=InjectionConfig(rate_hz=FIX_HZ, delay_ms=0, force=True),
    )
    submitted: dict[int, int] = {}
    with Bridge(config, 0.0) as bridge:
        while bridge.state().origin is None or bridge.attitude_at(time.monotonic_ns()) is None:
            time.sleep(0.05)
        cpu, begun = time.process_time(), time.monotonic()
        before = bridge.counters()
        fixes = 0
        while time.monotonic() - begun < seconds:
            now = time.monotonic_ns()
            submitted[now // 1000] = now
            bridge.submit(VisionFix(now, *HOME, 548.0, (1.0, 0.0, 0.0, 0.0)))
            fixes += 1
            time.sleep(max(0.0, begun + fixes / FIX_HZ - time.monotonic()))
        used = time.process_time() - cpu
        elapsed = time.monotonic() - begun
        after = bridge.counters()
    here.send(None)
    arrivals, _ = here.recv()
    process.join()
    if not arrivals:
        raise BridgeError("no position came out of the bridge: nothing to measure")
    delays = np.array([t - submitted[s] for t, s in arrivals if s in submitted]) * 1e-6
    received, lost = (
        float(after[name] or 0) - float(before[name] or 0) for name in ("fc_messages", "fc_lost")
    )
    return {
        "received": received / elapsed,
        "fixes": fixes / elapsed,
        "cpu": used / elapsed,
        "p50": float(np.percentile(delays, 50)),
        "p99": float(np.percentile(delays, 99)),
        "lost": lost,
    }


def main() -> None:
    """Print the table."""
    logging.basicConfig(level=logging.ERROR)
    parser = Parser(__doc__)
    parser.add_argument("--seconds", type=number(1, 3600), default=10.0, help="of each row")
    parser.add_argument(
        "--load",
        type=number(0.1, 100),
        nargs="+",
        default=[1.0, 5.0, 10.0],
        help="times the traffic",
    )
    parser.add_argument("--json", type=output, help="the table, for benchmarks.site.keep")
    arguments = parser.parse_args()
    rows: list[tuple[float, float | None]] = [(load, None) for load in arguments.load]
    rows += [(max(arguments.load), interval) for interval in (5.0, COMPANION_SWITCH_MS)]
    made = []
    for load, interval in rows:
        r = run(load, arguments.seconds, interval)
        what = "" if interval is None else f", neighbour, switch interval {interval:g} ms"
        name = f"{load:g} times, {r['received']:.0f} messages/s in{what}"
        latency = f"{r['p50']:.2f} / {r['p99']:.2f}"
        made.append((name, f"{r['fixes']:.0f}", f"{r['cpu']:.2f}", latency, f"{r['lost']:.0f}"))
    columns = (
        "traffic", "fixes/s", "CPU, cores", "estimate to socket, ms, median / p99", "lost",
    )  # fmt: skip
    show_figures(arguments.json, columns, made)


if __name__ == "__main__":
    with named_errors():
        main()
