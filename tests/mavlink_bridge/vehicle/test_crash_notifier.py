"""What a dead companion's supervisor says, over the ports that it left."""

from __future__ import annotations

import socket
import threading
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.alerts.catalogue import alert, text
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import Name, ProcessFault
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.vehicle.crash_notifier import report_without_bridge

DIED = alert(AlertId.COMPANION_RESTARTS, how=ProcessFault.DIED, what=Name("SIGKILL"))


class Autopilot:
    """Speaks to the companion's port as system 7, and hears what comes back."""

    def __init__(self, port: int) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(0.02)
        self._codec = mavlink.MAVLink(None, 7, 1)
        self._codec.robust_parsing = True
        self._port = port
        self.heard: list[Any] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        message = mavlink.MAVLink_attitude_message(1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        while not self._stop.is_set():
            self.socket.sendto(message.pack(self._codec), ("127.0.0.1", self._port))
            try:
                data, _ = self.socket.recvfrom(4096)
            except OSError:
                continue
            self.heard += self._codec.parse_buffer(data) or []

    def __enter__(self) -> Autopilot:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self.socket.close()


@pytest.fixture
def port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_the_line_goes_out_as_the_vehicle_s_own_companion(port: int) -> None:
    config = BridgeConfig(connection=f"udpin:127.0.0.1:{port}")
    with Autopilot(port) as autopilot:
        assert report_without_bridge(config, DIED, 5.0)
        while not autopilot.heard:  # it was sent
            pass
    line = autopilot.heard[0]
    assert line.get_type() == "STATUSTEXT"
    assert line.text == text(DIED)
    assert (line.severity, line.get_srcSystem(), line.get_srcComponent()) == (2, 7, 191)


def test_nobody_there_costs_less_than_a_second_and_no_error(port: int) -> None:
    """The restart waits for it: the patience is bounded whatever is missing."""
    silent = BridgeConfig(connection=f"udpin:127.0.0.1:{port}")
    assert report_without_bridge(silent, DIED, 5.0)  # said into the dark, as system 1
    gone = BridgeConfig(connection="serial:/dev/nonexistent:57600")
    assert not report_without_bridge(gone, DIED, 0.1)
