"""The autopilot that the bridge's benchmark talks to, a process of its own.

In a module of its own: a spawned process does not find what stands in a package's `__main__`.
"""

from __future__ import annotations

import select
import socket
import time
from collections import Counter
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.link.framing import FrameReader

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
