"""Half an hour of the bridge against a vehicle on a line that does everything wrong.

    python benchmarks/soak.py [--minutes 30] [--plot soak.png] [--trace]

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
import random
import select
import socket
import sys
import tempfile
import threading
import time
import tracemalloc
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from arguments import Parser, number, output, whole
from named_errors import named_errors
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge import Bridge, BridgeConfig, CameraView, HealthLevel, TargetReport, VisionFix
from mavlink_bridge.config import InjectionConfig, OriginConfig
from sitl.embedded.geodesy import Location
from sitl.vehicles import GIMBAL, EmbeddedSitl, vision_only_parameters

HOME = Location(47.397742, 8.545594, 488.0)
GEOID_M = 47.0
FIX_HZ = 20.0
WARM_UP_S = 120.0
RSS_BOUND_MIB = 8.0  # growth after the warm-up
RECOVERY_BOUND_S = 45.0  # a reboot includes the vehicle's own start

# Share of the flight that each fault begins at, its kind, and its length in seconds of 30 minutes.
SCHEDULE = (
    (0.08, "fuzz", 60.0),
    (0.14, "reset", 30.0),
    (0.19, "silence", 30.0),
    (0.24, "reboot", 0.0),
    (0.30, "stall", 30.0),
    (0.35, "fuzz", 60.0),
    (0.42, "cut", 300.0),
    (0.64, "fuzz", 60.0),
    (0.70, "reboot", 0.0),
    (0.76, "cut", 60.0),
    (0.82, "fuzz", 120.0),
    (0.92, "reset", 20.0),
)


@dataclass(frozen=True)
class Fault:
    """What the line did, CLOCK_MONOTONIC seconds."""

    kind: str
    begun: float
    ended: float


# --- the line and the vehicle, in a process of their own ------------------------------------------


def damage(data: bytes, rng: random.Random, held: list[bytes]) -> bytes:
    """What becomes of a chunk: flipped, cut, doubled, swapped with the next, mixed with noise."""
    kind = rng.randrange(8)
    if kind == 0 and data:
        at = rng.randrange(len(data))
        data = data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]
    elif kind == 1:
        data = data[: rng.randrange(len(data) + 1)]
    elif kind == 2:
        data = data + data
    elif kind == 3:
        held.append(data)
        return b""
    elif kind == 4:
        data = data + rng.randbytes(rng.randrange(200))
    elif kind == 5:
        data = data + bytes([0xFD]) * rng.randrange(1, 50)
    while held:
        data += held.pop()
    return data


class Line:
    """A TCP line between the bridge and the vehicle, and a ground station that talks nonsense."""

    def __init__(self, vehicle: EmbeddedSitl, rng: random.Random) -> None:
        self._vehicle, self._rng = vehicle, rng
        self._listener = self._listen(0)
        self.port: int = self._listener.getsockname()[1]
        self.ground = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.ground.bind(("127.0.0.1", 0))
        self.ground.setblocking(False)
        self._ground_peer: Any = None
        self._pair: tuple[socket.socket, socket.socket] | None = None
        self._held: tuple[list[bytes], list[bytes]] = ([], [])
        self.kind = ""

    @staticmethod
    def _listen(port: int) -> socket.socket:
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(("127.0.0.1", port))
        listener.listen(1)
        return listener

    def hang_up(self) -> None:
        """Close the connection on both sides."""
        for end in self._pair or ():
            end.close()
        self._pair = None

    def refuse(self, *, refusing: bool) -> None:
        """Whether nobody listens at all."""
        if refusing:
            self.hang_up()
            self._listener.close()
        else:
            self._listener = self._listen(self.port)

    def pass_for(self, seconds: float) -> None:
        """Carry bytes."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            try:
                self._step()
            except OSError:
                self.hang_up()

    def _step(self) -> None:
        sockets: list[socket.socket] = [self.ground]
        if self.kind != "cut":
            sockets += self._pair or (self._listener,)
        if self.kind == "stall" and self._pair:
            sockets.remove(self._pair[0])
        ready = select.select(sockets, [], [], 0.05)[0]
        if self.ground in ready:
            self._ground()
        if self._pair is None and self._listener in ready:
            host, port = self._vehicle.companion_endpoint.split(":")[1:]
            bridge = self._listener.accept()[0]
            try:
                self._pair = (bridge, socket.create_connection((host, int(port)), 2.0))
            except OSError:
                bridge.close()
                time.sleep(0.2)
            return
        for i, end in enumerate(self._pair or ()):
            if end in ready and self._pair is not None:
                data = end.recv(65536)
                if not data:
                    raise ConnectionResetError("end of stream")
                if self.kind == "silence":
                    continue
                if self.kind == "fuzz" and self._rng.random() < 0.4:
                    data = damage(data, self._rng, self._held[i])
                if self.kind == "reset" and self._rng.random() < 0.02:
                    raise ConnectionResetError("pulled")
                self._pair[1 - i].sendall(data)

    def _ground(self) -> None:
        data, self._ground_peer = self.ground.recvfrom(65536)
        if self.kind == "fuzz" or self._rng.random() < 0.02:
            for piece in (damage(data, self._rng, []), self._command()):
                self.ground.sendto(piece[:1400], self._ground_peer)

    def _command(self) -> bytes:
        """A frame whose checksum is right and whose content makes no sense."""
        numbers = [self._rng.choice([0.0, -1.0, 1e30, float("nan"), 0.5, 260.0]) for _ in range(7)]
        command = self._rng.choice([2004, 2005, 2010, 511, 512, 521, 31010, 65535])
        component = self._rng.choice([0, 100, 197, 191])
        message = mavlink.MAVLink_command_long_message(1, component, command, 0, *numbers)
        return bytes(message.pack(mavlink.MAVLink(None, 255, 190)))


def world(pipe: Any, minutes: float, seed: int) -> None:
    """Vehicle and line; sends the ports, waits for the start, then the faults as they end."""
    rng = random.Random(seed)
    with EmbeddedSitl(HOME, parameters={**vision_only_parameters(), **GIMBAL}) as vehicle:
        line = Line(vehicle, rng)
        pipe.send((line.port, line.ground.getsockname()[1]))
        begun, scale = time.monotonic(), minutes / 30.0
        for share, kind, seconds in SCHEDULE:
            line.pass_for(begun + share * minutes * 60.0 - time.monotonic())
            start = time.monotonic()
            pipe.send(Fault(kind, start, 0.0))
            if kind == "reboot":
                line.hang_up()
                vehicle.restart()
            else:
                line.kind = kind
                if kind == "cut":
                    line.refuse(refusing=True)
                line.pass_for(seconds * min(scale, 1.0))
                if kind == "cut":
                    line.refuse(refusing=False)
                line.kind = ""
            pipe.send(Fault(kind, start, time.monotonic()))
        line.pass_for(begun + minutes * 60.0 - time.monotonic())
        line.hang_up()


# --- the process under test -----------------------------------------------------------------------


@dataclass(frozen=True)
class Sample:
    """One second of this process. rss_mib; descriptors; waiting: messages and bytes in queues."""

    time_s: float
    rss_mib: float
    threads: int
    descriptors: int
    waiting: int
    injected: int


def rss_mib() -> float:
    """Resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def waiting(bridge: Bridge) -> int:
    """Messages and bytes that wait anywhere in the bridge."""
    fc, links = bridge._fc, bridge._links
    queues: list[Any] = [fc.fixes._fixes, fc.injector._waiting, fc._to_compare, fc.outbound]
    queues += [fc._sync_sent, fc.loop._sent, fc.loop._pending, fc.loop._differences, bridge._texts]
    queues += [q for link in links for q in (link._outbox, link._unsent, link._reader._buffer)]
    return sum(len(q) for q in queues)


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
        yaw = float("nan") if attitude is None else attitude.yaw_rad
        P = np.eye(3) * 0.04
        bridge.submit(VisionFix(now, latitude, longitude, height, 0.0, 0.0, yaw, P))
        if count % 4 == 0:
            bridge.report(TargetReport(now, latitude, longitude, height, target_id=count % 3))
            bridge.look(CameraView(now, latitude, longitude, height, (1.0, 0.0, 0.0, 0.0)))
        if count % 100 == 0:
            level = HealthLevel.OK if count % 200 else HealthLevel.DEGRADED
            bridge.set_health(level, f"localization {level.value}")


def take(bridge: Bridge, begun: float) -> Sample:
    """A sample now."""
    return Sample(
        time.monotonic() - begun,
        rss_mib(),
        threading.active_count(),
        len(os.listdir("/proc/self/fd")),
        waiting(bridge),
        int(bridge.counters().get("bridge_injected", 0)),
    )


def recovery_s(samples: list[Sample], fault: Fault, begun: float) -> float:
    """Seconds from a fault's end until injection flows again for 3 s; NaN if it never did."""
    after = [s for s in samples if s.time_s >= fault.ended - begun]
    for i in range(len(after) - 3):
        if after[i + 3].injected - after[i].injected > 2.0 * FIX_HZ:
            return after[i].time_s - (fault.ended - begun)
    return float("nan")


def fly(minutes: float, seed: int, trace: bool) -> tuple[list[Sample], list[Fault], dict[str, Any]]:
    """The run: (samples, faults, the bridge's counters at the end)."""
    here, there = multiprocessing.get_context("spawn").Pipe()
    process = multiprocessing.get_context("spawn").Process(
        target=world, args=(there, minutes, seed)
    )
    process.start()
    there.close()
    fc_port, ground_port = here.recv()
    samples: list[Sample] = []
    faults: list[Fault] = []
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


def judge(samples: list[Sample], faults: list[Fault], counters: dict[str, Any]) -> bool:
    """Print the table and whether every bound holds."""
    begun = counters["begun"]
    print("\n  minute   RSS MiB  threads  descriptors  waiting   injected")
    step = max(len(samples) // 15, 1)
    for s in samples[::step]:
        print(f"{s.time_s / 60:8.1f} {s.rss_mib:9.1f} {s.threads:8d} {s.descriptors:12d} "
              f"{s.waiting:8d} {s.injected:10d}")  # fmt: skip
    print("\n  fault        at min   for s   injecting again after s")
    recoveries = []
    for fault in faults:
        recoveries.append(recovery_s(samples, fault, begun))
        minute, length = (fault.begun - begun) / 60, fault.ended - fault.begun
        print(f"  {fault.kind:10} {minute:8.1f} {length:7.0f} {recoveries[-1]:14.1f}")
    warm = [s for s in samples if s.time_s > min(WARM_UP_S, samples[-1].time_s / 4)]
    growth = float(
        np.mean([s.rss_mib for s in warm[-30:]]) - np.mean([s.rss_mib for s in warm[:30]])
    )
    threads = {s.threads for s in warm}
    checks = {
        f"RSS grew by {growth:+.1f} MiB (bound {RSS_BOUND_MIB:.0f})": growth <= RSS_BOUND_MIB,
        f"threads {min(threads)} to {max(threads)} (bound: equal)": len(threads) == 1,
        # A link that is between two transports has one descriptor less.
        f"descriptors at most {max(s.descriptors for s in warm)}, at first "
        f"{warm[0].descriptors} (bound: + 1)": (
            max(s.descriptors for s in warm) <= warm[0].descriptors + 1
        ),
        f"waiting at most {max(s.waiting for s in warm)} (bound 8192)": (
            max(s.waiting for s in warm) <= 8192
        ),
        f"handler errors {counters['fc_handler_errors']} + {counters['ground_handler_errors']}, "
        f"failures {counters['fc_failures']} + {counters['ground_failures']} (bound 0)": not any(
            counters[f"{link}_{what}"]
            for link in ("fc", "ground")
            for what in ("handler_errors", "failures")
        ),
        f"slowest return {np.max(recoveries):.0f} s (bound {RECOVERY_BOUND_S:.0f})": bool(
            np.max(recoveries) <= RECOVERY_BOUND_S
        ),
    }
    print()
    for text, good in checks.items():
        print(f"  {'ok   ' if good else 'WRONG'} {text}")
    keys = ("fc_messages", "fc_bad_bytes", "fc_bad_checksums", "fc_lost", "fc_opened",
            "fc_timeouts", "ground_bad_bytes", "bridge_reboots", "bridge_lost", "bridge_injected",
            "ignored_messages", "tlog_dropped", "reset_counter")  # fmt: skip
    print("  " + ", ".join(f"{key} {counters.get(key, 0)}" for key in keys))
    return all(checks.values())


def plot(samples: list[Sample], faults: list[Fault], begun: float, path: Path) -> None:
    """The curves over time, faults shaded."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(4, 1, figsize=(11, 8), sharex=True)
    minutes = [s.time_s / 60 for s in samples]
    rates = np.gradient([s.injected for s in samples], [s.time_s for s in samples])
    curves = (
        ("RSS, MiB", [s.rss_mib for s in samples]),
        ("threads, descriptors", [s.threads for s in samples]),
        ("waiting in queues", [s.waiting for s in samples]),
        ("injected, Hz", rates),
    )
    for axis, (label, values) in zip(axes, curves, strict=True):
        axis.plot(minutes, values, lw=1)
        axis.set_ylabel(label)
        for fault in faults:
            left, right = ((t - begun) / 60 for t in (fault.begun, fault.ended))
            axis.axvspan(left, right, color="tab:red", alpha=0.15)
    axes[1].plot(minutes, [s.descriptors for s in samples], lw=1)
    axes[0].set_ylim(0.0, 1.2 * max(s.rss_mib for s in samples))
    for fault in faults:
        axes[0].text((fault.begun - begun) / 60, 2, fault.kind, rotation=90, fontsize=7)
    axes[-1].set_xlabel("minutes")
    figure.tight_layout()
    figure.savefig(path, dpi=90)


def main() -> int:
    """Run, print, plot."""
    parser = Parser(__doc__)
    parser.add_argument(
        "--minutes", type=number(1, 1440), default=30.0, help="of the run; faults shrink with it"
    )
    parser.add_argument("--seed", type=whole(0, 1 << 31), default=1, help="of the damage")
    parser.add_argument("--plot", type=output, help="PNG of the curves over time")
    parser.add_argument("--trace", action="store_true", help="where memory grew; slower")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.ERROR)
    samples, faults, counters = fly(arguments.minutes, arguments.seed, arguments.trace)
    good = judge(samples, faults, counters)
    if arguments.plot is not None:
        plot(samples, faults, counters["begun"], arguments.plot)
    return 0 if good else 1


if __name__ == "__main__":
    with named_errors():
        sys.exit(main())
