"""Mode rc over a restart: the gate that the pilot opened is open again, and not for ever."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import InjectionOrder
from mavlink_bridge.bridge import Bridge
from mavlink_bridge.config import BridgeConfig, InjectionEnableConfig
from mavlink_bridge.injection.injection_enable import InjectionEnable
from mavlink_bridge.injection.restart_memory import (
    InjectionEnableMemory,
    ShadowFailureMemory,
)
from mavlink_bridge.link.link import sleep_until

_CHILD = """
import sys, time
from pathlib import Path
from mavlink_bridge.config import InjectionEnableConfig
from mavlink_bridge.injection.restart_memory import InjectionEnableMemory
from mavlink_bridge.injection.injection_enable import InjectionEnable
files = [Path(name) for name in sys.argv[1:]]
gates = [
    InjectionEnable(
        InjectionEnableConfig(), lambda _: None, InjectionEnableMemory(file))
    for file in files
]
gates[0].command(31010, 1.0)
gates[1].on_rc_channels([1900] * 18)
while not all(file.exists() for file in files):
    time.sleep(0.01)
print("open", flush=True)
time.sleep(600)
"""
LOW = [1100] * 18


@pytest.fixture(scope="module")
def left_open(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The files of a process with two gates, opened by command and by channel, after kill -9."""
    folder = tmp_path_factory.mktemp("killed")
    files = {by: folder / f"{by}.json" for by in ("command", "channel")}
    child = subprocess.Popen(
        [sys.executable, "-c", _CHILD, *map(str, files.values())], stdout=subprocess.PIPE, text=True
    )
    assert child.stdout.readline() == "open\n"
    os.kill(child.pid, signal.SIGKILL)
    child.wait()
    child.stdout.close()
    return files


def restarted(path: Path, later_s: float = 4.0) -> tuple[InjectionEnable, list[Alert]]:
    told: list[Alert] = []
    kept = json.loads(path.read_text()) if path.exists() else {}
    memory = InjectionEnableMemory(
        path, lambda: kept.get("utc_s", 0.0) + later_s, lambda: kept.get("clock_s", 0.0) + later_s
    )
    enable = InjectionEnable(InjectionEnableConfig(), told.append, memory)
    enable.recall()
    enable.announce()
    return enable, told


@pytest.mark.parametrize("by", ["command", "channel"])
def test_a_killed_process_leaves_the_gate_open(left_open: dict[str, Path], by: str) -> None:
    path = left_open[by]
    assert path.stat().st_mode & 0o777 == 0o600
    enable, told = restarted(path)
    assert enable.enabled
    assert told == [alert(AlertId.INJECTION_RESTORED, seconds=pytest.approx(4.0, abs=0.6))]
    enable.on_rc_channels(LOW)
    # The switch was turned off meanwhile; a low channel says nothing against a command.
    assert enable.enabled is (by == "command")
    enable.stop()
    assert not path.exists()  # an orderly end is not a restart in the air


@pytest.mark.parametrize("step_s", [-3600.0, 3600.0, 1e9])
def test_a_wall_clock_that_is_set_meanwhile_closes_no_gate(tmp_path: Path, step_s: float) -> None:
    """A computer without a battery meets the network after take-off; killed afterwards, it came
    back with its gate closed and the vehicle without a position.
    """
    path, wall, clock = tmp_path / "gate.json", [1e9], [500.0]
    memory = InjectionEnableMemory(path, lambda: wall[0], lambda: clock[0], "this run")
    memory.store_enabled(by_channel=True)
    while not path.exists():
        pass
    left = path.read_text()
    memory.stop()

    def recalled(boot: str, later_s: float) -> tuple[bool, float] | None:
        path.write_text(left)
        path.chmod(0o600)
        again = InjectionEnableMemory(path, lambda: wall[0], lambda: clock[0] + later_s, boot)
        try:
            return again.recall()
        finally:
            again.stop()

    wall[0] += step_s
    assert recalled("this run", 4.0) == (True, 4.0)
    assert recalled("this run", 601.0) is None
    assert recalled("another run", 4.0) is None  # nobody knows how long it was off
    assert recalled("", 4.0) is None
    wall[0] -= step_s - 30.0
    assert recalled("another run", -490.0) == (True, 30.0)


@pytest.mark.parametrize("later_s", [601.0, -5.0])
def test_an_old_file_and_one_from_the_future_count_for_nothing(tmp_path, later_s):
    path = tmp_path / "gate.json"
    path.write_text(json.dumps({"open": True, "by_channel": False, "utc_s": 1000.0}))
    path.chmod(0o600)
    enable, told = restarted(path, later_s)
    assert not enable.enabled
    assert told == [alert(AlertId.INJECTION_OFF, by=InjectionOrder.START)]
    enable.stop()


@pytest.mark.parametrize(
    "text", ["", "[]", "nonsense", '{"open": 1}', "{" * 5000, '{"utc_s": 1' + "0" * 400 + "}"]
)
def test_a_damaged_file_or_another_users_is_ignored(tmp_path: Path, text: str) -> None:
    path = tmp_path / "gate.json"
    path.write_text(text)
    path.chmod(0o600)
    memory = InjectionEnableMemory(path)
    assert memory.recall() is None
    path.write_text(json.dumps({"open": True, "by_channel": False, "utc_s": 1000.0}))
    path.chmod(0o666)
    assert memory.recall() is None
    memory.stop()


@pytest.mark.parametrize(("flown", "kept"), [("map a", True), ("map b", False), ("", True)])
def test_a_no_go_is_of_the_map_that_was_seen(tmp_path: Path, flown: str, kept: bool) -> None:
    """The map was exchanged for the right one, and ten minutes long nothing was injected."""
    path = tmp_path / "no-go.json"
    killed = ShadowFailureMemory(path, about="map a")
    killed.store(True)
    while not path.exists():
        pass
    left = path.read_text()
    killed.stop()
    path.write_text(left)
    path.chmod(0o600)
    again = ShadowFailureMemory(path, about=flown)
    assert again.recall() == kept
    again.stop()


def test_a_no_go_of_an_older_version_is_of_any_map(tmp_path: Path) -> None:
    path = tmp_path / "no-go.json"
    path.write_text(json.dumps({"against": "20 m off", "utc_s": time.time()}))
    path.chmod(0o600)
    memory = ShadowFailureMemory(path, about="map a")
    assert memory.recall()
    memory.stop()


@pytest.mark.parametrize("against", ["", 5, None, "\x1b[2J", ["x"]])
def test_a_no_go_of_nonsense_is_none(tmp_path: Path, against: object) -> None:
    path = tmp_path / "no-go.json"
    stamps = {"utc_s": time.time(), "boot": "", "clock_s": 0.0}
    path.write_text(json.dumps({"against": against} | stamps))
    path.chmod(0o600)
    memory = ShadowFailureMemory(path)
    assert not memory.recall()
    memory.stop()


def test_an_orderly_end_in_the_middle_of_a_write_leaves_no_open_gate(tmp_path, monkeypatch):
    """The write was finished after the order to end, and the next start injected unasked."""
    path, flush, ends = tmp_path / "gate.json", os.fsync, threading.Event()

    def ordered_to_end(descriptor: int) -> None:
        flush(descriptor)
        if not ends.is_set():
            ends.set()
            with contextlib.suppress(RuntimeError):  # a thread does not wait for itself
                memory.stop()

    monkeypatch.setattr(os, "fsync", ordered_to_end)
    memory = InjectionEnableMemory(path)
    memory.store_enabled(by_channel=False)
    assert ends.wait(20.0)
    memory.stop()
    assert not path.exists()


def _left_open(path: Path) -> None:
    path.write_text(json.dumps({"open": True, "by_channel": False, "utc_s": time.time()}))
    path.chmod(0o600)


def _bridge(path: Path, connection: str, told: list[Alert]) -> Bridge:
    config = BridgeConfig(connection=connection, mode="rc", state_file=path)
    return Bridge(config, 0.0, on_alert=told.append)


def test_the_bridge_restores_the_gate_that_a_killed_one_left_open(tmp_path, autopilot):
    path, told = tmp_path / "gate.json", list[Alert]()
    _left_open(path)
    with _bridge(path, f"udpout:127.0.0.1:{autopilot.port}", told):
        # Told once somebody may hear it: after the first word about the flight controller.
        assert sleep_until(lambda: any(a.id is AlertId.INJECTION_RESTORED for a in told), 30.0)
    assert told[0].id in (AlertId.FC_FOUND, AlertId.FC_SILENT)
    assert not path.exists()


def test_a_bridge_that_does_not_end_in_order_leaves_the_gate_to_the_next(tmp_path: Path) -> None:
    """Its process takes over from a killed one, and fails on the way up."""
    path = tmp_path / "gate.json"
    _left_open(path)
    bridge = _bridge(path, "udpout:127.0.0.1:9", [])
    bridge.start()
    bridge.hand_over()
    bridge.stop()
    assert json.loads(path.read_text())["open"] is True
    again = _bridge(path, "udpout:127.0.0.1:9", [])
    again.start()
    again.stop()
    assert not path.exists()


def test_what_is_not_remembered_is_not_kept_by_such_an_end(tmp_path: Path) -> None:
    path = tmp_path / "gate.json"
    enable, _ = restarted(path)
    enable.command(31010, 1.0)
    while not path.exists():
        pass
    enable.command(31010, 0.0)
    while path.exists():
        pass
    enable.stop(clean_shutdown=False)
    assert not path.exists()


def test_a_standby_that_never_flew_leaves_the_file_alone(tmp_path: Path) -> None:
    path = tmp_path / "gate.json"
    _left_open(path)
    _bridge(path, "udpout:127.0.0.1:9", []).stop()
    assert path.exists()
