"""The embedded vehicle's telemetry into a .tlog, on the simulated clock."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.embedded.mavlink.server import MavlinkServer, SerialPort

_LINK_S, _JITTER_S = 0.006, 0.003  # a serial port at 921600 baud, and a busy reader
_SYNC_S = 1.0
_TICK_NS = 10_000_000


class RecordedPort:
    """One port whose reader is a file. Frames arrive some milliseconds late, in their order.

    boot_ns: when the vehicle was switched on, on the companion's clock; utc_offset_ns: UTC less it.
    """

    def __init__(self, path: Path, boot_ns: int, utc_offset_ns: int, seed: int) -> None:
        self._file = path.open("wb")
        self._boot_ns, self._utc_offset_ns = boot_ns, utc_offset_ns
        self._rng = np.random.default_rng([seed, 53])
        self._mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._newest_ns = 0
        self._synced_ns = 0
        self.now_ns = boot_ns

    def write(self, message: Any) -> None:
        """One of the vehicle's messages, sent now."""
        late_s = _LINK_S + _JITTER_S * float(self._rng.exponential())
        self._put(message, self.now_ns + round(1e9 * late_s))

    def tick(self) -> None:
        """10 ms have passed; once a second an answer to the companion's TIMESYNC comes."""
        self.now_ns += _TICK_NS
        if self.now_ns - self._synced_ns < _SYNC_S * 1e9:
            return
        self._synced_ns = self.now_ns
        there, back = (round(1e9 * _LINK_S * float(self._rng.uniform(0.8, 1.4))) for _ in range(2))
        boot_ns = self.now_ns + there - self._boot_ns
        answer = mavlink.MAVLink_timesync_message(boot_ns, self.now_ns)
        self._put(answer, self.now_ns + there + back)

    def _put(self, message: Any, received_ns: int) -> None:
        self._newest_ns = max(self._newest_ns, received_ns)
        raw = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256
        utc_us = (self._newest_ns + self._utc_offset_ns) // 1000
        self._file.write(struct.pack(">Q", utc_us) + raw)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class _Link(SerialPort):
    """A serial port whose client is a `RecordedPort`: nothing comes back from it."""

    recorded: RecordedPort

    def send(self, message: Any) -> None:
        self.recorded.write(message)

    def flush(self) -> None:
        """Everything is written already."""


class RecordingServer(MavlinkServer):
    """The vehicle's links: one, into a file. intervals: seconds by message id."""

    def __init__(self, recorded: RecordedPort) -> None:
        super().__init__((0,), 1)  # a port of the system's choice, which nobody connects to
        listener = self.links[0].listener
        link = _Link("recorded", listener, 1, client=listener)
        link.recorded = recorded
        self.links[0] = link

    def poll(self) -> Iterator[tuple[SerialPort, Any]]:
        """Nobody asks the vehicle anything."""
        return iter(())

    def close(self) -> None:
        """Close the listener that was opened."""
        self.links[0].listener.close()
