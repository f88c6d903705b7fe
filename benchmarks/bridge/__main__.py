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
import select
import socket
import sys
import threading
import time
from collections import Counter
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from benchmarks.common.arguments import Parser, number, output
from benchmarks.common.figures import write_figures
from benchmarks.common.named_errors import named_errors
from mavlink_bridge import Bridge, BridgeConfig, VisionFix
from mavlink_bridge.config import InjectionConfig, OriginConfig
from mavlink_bridge.link.framing import FrameReader

HOME = (47.397742, 8.545594)
FIX_HZ = 20.0
COMPANION_SWITCH_MS = 0.2
# Hz of what the bridge asks for in its default configuration.
TRAFFIC = {"ATTITUDE": 50, "LOCAL_POSITION_NED": 10, "GLOBAL_POSITION_INT": 5, "GPS_RAW_INT": 5,
           "EKF_STATUS_REPORT": 2, "GIMBAL_DEVICE_ATTITUDE_STATUS": 25}  # fmt: skip


def messages(boot_ms: int) -> dict[str, Any]:
    """One of each, as the autopilot would send it now."""
    q = [1.0, 0.0, 0.0, 0.0]
    return {
        "ATTITUDE": mavlink.MAVLink_attitude_message(boot_ms, 0.1, 0.1, 0.0, 0.0, 0.0, 0.0),
        "LOCAL_POSITION_NED": mavlink.MAVLink_local_position_ned_message(boot_ms, *[1.0] * 6),
        "GLOBAL_POSITION_INT": mavlink.MAVLink_global_position_int_message(
            boot_ms, 473977420, 85455940, 548000, 60000, 0, 0, 0, 0
        ),
        "GPS_RAW_INT": mavlink.MAVLink_gps_raw_int_message(
            0, 3, 473977420, 85455940, 548000, 80, 80, 0, 0, 12
        ),
        "EKF_STATUS_REPORT": mavlink.MAVLink_ekf_status_report_message(831, *[0.1] * 5),
        "GIMBAL_DEVICE_ATTITUDE_STATUS": mavlink.MAVLink_gimbal_device_attitude_status_message(
            0, 0, boot_ms, 32, q, 0.0, 0.0, 0.0, 0, 0.0, 0.0
        ),
    }


def autopilot(connection: Any, load: float) -> None:
    """Streams to whoever speaks; returns (arrival time, usec stamp) of each vision message."""
    peer_socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    peer_socket.bind(("127.0.0.1", 0))
    connection.send(peer_socket.getsockname()[1])
    codec, reader = mavlink.MAVLink(None, 1, 1), FrameReader()
    peer: tuple[str, int] | None = None
    arrivals: list[tuple[int, int]] = []
    sent: Counter[str] = Counter()
    begun = time.monotonic()
    heartbeat = 0.0

    def send(message: Any) -> None:
        if peer is None:
            return
        peer_socket.sendto(message.pack(codec), peer)
        codec.seq = (codec.seq + 1) % 256

    while not connection.poll():
        if select.select([peer_socket], [], [], 0.001)[0]:
            data, peer = peer_socket.recvfrom(65536)
            now = time.monotonic_ns()
            for m in reader.feed(data):
                if m.get_type() == "VISION_POSITION_ESTIMATE":
                    arrivals.append((now, m.usec))
                elif m.get_type() == "TIMESYNC" and m.tc1 == 0:
                    send(mavlink.MAVLink_timesync_message(now, m.ts1))
        if peer is None:
            continue
        elapsed = time.monotonic() - begun
        boot_ms = int(elapsed * 1000)
        if elapsed >= heartbeat:
            heartbeat = elapsed + 1.0
            send(mavlink.MAVLink_heartbeat_message(2, 3, 81, 4, 4, 3))
            send(mavlink.MAVLink_gps_global_origin_message(473977420, 85455940, 488000, 0))
        due = {n: m for n, m in messages(boot_ms).items() if sent[n] < elapsed * TRAFFIC[n] * load}
        for name, message in due.items():
            while sent[name] < elapsed * TRAFFIC[name] * load:
                sent[name] += 1
                send(message)
    connection.send((arrivals, sum(sent.values())))


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
        # No waiting for the age of fixes here: the delay under test is the bridge's own.
        injection=InjectionConfig(rate_hz=FIX_HZ, delay_ms=0),
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
            bridge.submit(VisionFix(now, *HOME, 548.0, 0.0, 0.0, 0.0))
            fixes += 1
            time.sleep(max(0.0, begun + fixes / FIX_HZ - time.monotonic()))
        used = time.process_time() - cpu
        elapsed = time.monotonic() - begun
        after = bridge.counters()
    here.send(None)
    arrivals, _ = here.recv()
    process.join()
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
    print("  load  messages/s in  fixes/s  CPU (cores)  estimate to socket ms p50 / p99   lost")
    rows: list[tuple[float, float | None]] = [(load, None) for load in arguments.load]
    rows += [(max(arguments.load), interval) for interval in (5.0, COMPANION_SWITCH_MS)]
    made = []
    for load, interval in rows:
        r = run(load, arguments.seconds, interval)
        what = "" if interval is None else f"  neighbour, switch interval {interval:g} ms"
        name = f"{load:g} times, {r['received']:.0f} messages/s in" + what.replace("  ", ", ")
        made.append((name, f"{r['cpu']:.2f}", f"{r['p50']:.2f} / {r['p99']:.2f}"))
        print(
            f"{load:5.0f}x {r['received']:14.0f} {r['fixes']:8.0f} {r['cpu']:12.2f}"
            f" {r['p50']:22.2f} / {r['p99']:.2f} {r['lost']:10.0f}{what}",
            flush=True,
        )
    if arguments.json:
        columns = ("traffic", "CPU, cores", "estimate to socket, ms, median / p99")
        write_figures(arguments.json, columns, made)


if __name__ == "__main__":
    with named_errors():
        main()
