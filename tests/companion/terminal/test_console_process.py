"""The console's process beside a flight: killed, it is told once, and the flight goes on."""

import logging
import os
import signal
import socket
import threading

import pytest
import yaml

from companion.live.config import ConsoleConfig
from companion.live.protocol import socket_path
from companion.terminal.console_process import running_console
from localizer.map.cache.cache import TileCache
from tests.companion.console.companion_flying import CAMERA, Flight

pytest.importorskip("uvicorn")


class Ended(logging.Handler):
    """Waits for what is told of the console's end."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.texts: list[str] = []
        self.told = threading.Event()

    def emit(self, record: logging.LogRecord) -> None:
        self.texts.append(record.getMessage())
        self.told.set()


def test_a_console_that_crashes_costs_the_flight_nothing(small_assets, tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        listen = f"127.0.0.1:{probe.getsockname()[1]}"
    record = tmp_path / "flights" / "flight"
    path = tmp_path / "deployment.yaml"
    config = {
        "map": str(small_assets.map_cache),
        "camera": {"source": "udp://127.0.0.1:5600", "model": CAMERA.to_dict()},
        "record": {"folder": str(record)}, "console": {"listen": listen, "control": True},
    }  # fmt: skip
    path.write_text(yaml.safe_dump(config))
    meeting = socket_path(small_assets.map_cache, record, listen)
    flight = Flight(meeting, TileCache.open(small_assets.map_cache))
    handler = Ended()
    log = logging.getLogger("companion.console")
    log.addHandler(handler)
    before = set(_children())
    try:
        with flight.flying(), running_console(path, ConsoleConfig(listen=listen, control=True)):
            (console,) = set(_children()) - before
            _until(lambda: _connections(meeting) == 1)  # it has met the flight
            os.kill(console, signal.SIGSEGV)
            assert handler.told.wait(30.0)
            _until(lambda: _connections(meeting) == 0)
            sent = flight.sent
            _until(lambda: flight.sent >= sent + 3)
            # Another one is served as the first was.
            with socket.socket(socket.AF_UNIX) as again:
                again.connect(str(meeting))
                assert again.recv(1)
    finally:
        log.removeHandler(handler)
    assert len(handler.texts) == 1
    assert "SIGSEGV" in handler.texts[0]


def _children() -> list[int]:
    found = []
    for task in os.listdir("/proc/self/task"):
        with open(f"/proc/self/task/{task}/children") as file:
            found += [int(pid) for pid in file.read().split()]
    return found


def _connections(listening) -> int:
    with open("/proc/net/unix") as file:
        return file.read().count(f" {listening}\n") - 1  # the listening socket itself


def _until(holds) -> None:
    wait = threading.Event()
    for _ in range(600):
        if holds():
            return
        wait.wait(0.1)
    raise AssertionError("it did not come true")
