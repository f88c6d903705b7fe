"""Half an hour of the bridge against a vehicle on a line that does everything wrong.

    python -m benchmarks.bridge.soak [--minutes 30] [--plot soak.png] [--json soak.json] [--trace]

The embedded vehicle and the line are processes of their own. The line cuts the connection for five
minutes, refuses, falls silent, stops reading, resets, flips bits, truncates, duplicates and swaps
what passes in both directions; the vehicle reboots; the ground link gets noise. Here run the bridge
and what feeds it, and their resident memory, threads, descriptors and waiting messages are sampled
each second. Exit code 1 when a bound is passed or injection does not come back after a fault.
--trace: where memory grew, by tracemalloc (slower).
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import sys
import tempfile
import threading
import time
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bridge.soak_line import HOME, LineFault, world
from benchmarks.bridge.soak_report import (
    COLUMNS,
    FIX_HZ,
    WARM_UP_S,
    ProcessSample,
    judge,
    plot,
    told,
)
from benchmarks.common.arguments import Parser, number, output, whole
from benchmarks.common.figures import write_figures
from benchmarks.common.named_errors import named_errors
from mavlink_bridge import Bridge, BridgeConfig, CameraView, HealthLevel, TargetReport, VisionFix
from mavlink_bridge.config import InjectionConfig, OriginConfig

GEOID_M = 47.0


def rss_mib() -> float:
    """Resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def feed(bridge: Bridge, stop: threading.Event) -> None:
    """A localizer that stands at home: fixes, targets, views and changing health."""
    rng = np.random.default_rng(1)
    metre = 1.0 / 111_319.0
    count = 0
    while not stop.wait(1.0 / FIX_HZ):
        count += 1
        now = time.monotonic_ns() - 40_000_000
        attitude = bridge.attitude_at(now)
        north, east, up = rng.normal(0.0, 0.2, 3)
        latitude = HOME.latitude_deg + north * metre
        longitude = HOME.longitude_deg + east * metre * 1.48
        height = HOME.altitude_m + GEOID_M + up
        yaw = None if attitude is None else attitude.yaw_rad
        P = np.eye(3) * 0.04
        bridge.submit(VisionFix(now, latitude, longitude, height, 0.0, 0.0, yaw, P))
        if count % 4 == 0:
            bridge.report(TargetReport(now, latitude, longitude, height, target_id=count % 3))
            bridge.look(CameraView(now, latitude, longitude, height, (1.0, 0.0, 0.0, 0.0)))
        if count % 100 == 0:
            level = HealthLevel.OK if count % 200 else HealthLevel.DEGRADED
            bridge.set_health(level, f"localization {level.value}")


def take(bridge: Bridge, begun: float) -> ProcessSample:
    """A sample now."""
    return ProcessSample(
        time.monotonic() - begun,
        rss_mib(),
        threading.active_count(),
        len(os.listdir("/proc/self/fd")),
        sum(bridge.waiting().values()),
        int(bridge.counters().get("bridge_injected") or 0),
    )


def fly(
    minutes: float, seed: int, trace: bool
) -> tuple[list[ProcessSample], list[LineFault], dict[str, Any]]:
    """The run: (samples, faults, the bridge's counters at the end)."""
    here, there = multiprocessing.get_context("spawn").Pipe()
    process = multiprocessing.get_context("spawn").Process(
        target=world, args=(there, minutes, seed)
    )
    process.start()
    there.close()
    fc_port, ground_port = here.recv()
    samples: list[ProcessSample] = []
    faults: list[LineFault] = []
    with tempfile.TemporaryDirectory() as folder:
        config = BridgeConfig(
            connection=f"tcp:127.0.0.1:{fc_port}",
            ground_connection=f"udpout:127.0.0.1:{ground_port}",
            mode="inject",
            origin=OriginConfig(
                latitude_deg=HOME.latitude_deg,
                longitude_deg=HOME.longitude_deg,
                altitude_amsl_m=HOME.altitude_m,
            ),
            injection=InjectionConfig(rate_hz=FIX_HZ, delay_ms=60.0),
            tlog=Path(folder) / "soak.tlog",
        )
        stop = threading.Event()
        with Bridge(config, GEOID_M) as bridge:
            feeder = threading.Thread(target=feed, args=(bridge, stop), name="feed")
            feeder.start()
            begun = time.monotonic()
            snapshot: Any = None
            while process.is_alive():
                time.sleep(1.0)
                samples.append(take(bridge, begun))
                while here.poll():
                    try:
                        faults.append(here.recv())
                    except EOFError:
                        break
                    print(f"{samples[-1].time_s:7.0f} s  {faults[-1]}", flush=True)
                if trace and snapshot is None and samples[-1].time_s > WARM_UP_S:
                    tracemalloc.start(8)
                    snapshot = tracemalloc.take_snapshot()
            if snapshot is not None:
                growth = tracemalloc.take_snapshot().compare_to(snapshot, "lineno")
                for line in growth[:10]:
                    print(line)
            counters = bridge.counters()
            stop.set()
            feeder.join()
    process.join()
    return samples, [f for f in faults if f.ended > 0.0], counters | {"begun": begun}


def main() -> int:
    """Run, print, plot."""
    parser = Parser(__doc__)
    parser.add_argument(
        "--minutes", type=number(1, 1440), default=30.0, help="of the run; faults shrink with it"
    )
    parser.add_argument("--seed", type=whole(0, 1 << 31), default=1, help="of the damage")
    parser.add_argument("--plot", type=output, help="PNG of the curves over time")
    parser.add_argument("--json", type=output, help="what was found beside what is wanted")
    parser.add_argument("--trace", action="store_true", help="where memory grew; slower")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.ERROR)
    samples, faults, counters = fly(arguments.minutes, arguments.seed, arguments.trace)
    found = judge(samples, faults, counters)
    if arguments.plot is not None:
        plot(samples, faults, counters["begun"], arguments.plot)
    if arguments.json is not None:
        made = {"minutes": arguments.minutes, "seed": arguments.seed, "counters": told(counters)}
        write_figures(arguments.json, COLUMNS, [bound.row for bound in found], made)
    return 0 if all(bound.good for bound in found) else 1


if __name__ == "__main__":
    with named_errors():
        sys.exit(main())
