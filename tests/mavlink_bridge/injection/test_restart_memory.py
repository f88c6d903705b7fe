"""Mode rc over a restart: the gate that the pilot opened is open again, and not for ever."""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import InjectionOrder
from mavlink_bridge.bridge import Bridge
from mavlink_bridge.config import BridgeConfig, InjectionEnableConfig
from mavlink_bridge.injection.injection_enable import InjectionEnable
from mavlink_bridge.injection.restart_memory import InjectionEnableMemory, ShadowFailureMemory
from mavlink_bridge.link.link import sleep_until

OPEN = {"open": True, "by_channel": False}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "state.json"


def left(path: Path, content: Any, mode: int = 0o600) -> None:
    """What a killed process left: the file's text, or the state, stored now."""
    if isinstance(content, dict):
        content = json.dumps({"utc_s": time.time()} | content)
    path.write_text(content)
    path.chmod(mode)


def exists(path: Path) -> None:
    """Written by a thread of its own."""
    assert sleep_until(path.exists, 20.0)


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
def test_a_killed_process_leaves_the_gate_open(path: Path, by: str) -> None:
    killed, _ = restarted(path)
    if by == "command":
        killed.command(31010, 1.0)
    else:
        killed.on_rc_channels([1900] * 18)
    exists(path)
    killed.stop(clean_shutdown=False)
    assert path.stat().st_mode & 0o777 == 0o600
    enable, told = restarted(path)
    assert enable.enabled
    assert told == [alert(AlertId.INJECTION_RESTORED, seconds=pytest.approx(4.0, abs=0.6))]
    enable.on_rc_channels([1100] * 18)
    # The switch was turned off meanwhile; a low channel says nothing against a command.
    assert enable.enabled is (by == "command")
    enable.stop()
    assert not path.exists()  # an orderly end is not a restart in the air


@pytest.mark.parametrize("step_s", [-3600.0, 3600.0, 1e9])
def test_a_wall_clock_that_is_set_meanwhile_closes_no_gate(path: Path, step_s: float) -> None:
    """A computer without a battery meets the network after take-off; killed afterwards, it came
    back with its gate closed and the vehicle without a position.
    """
    wall, clock = [1e9], [500.0]
    memory = InjectionEnableMemory(path, lambda: wall[0], lambda: clock[0], "this run")
    memory.store_enabled(by_channel=True)
    exists(path)
    text = path.read_text()
    memory.stop()

    def recalled(boot: str, later_s: float) -> tuple[bool, float] | None:
        left(path, text)
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
def test_an_old_file_and_one_from_the_future_count_for_nothing(path: Path, later_s: float) -> None:
    left(path, OPEN)
    enable, told = restarted(path, later_s)
    assert not enable.enabled
    assert told == [alert(AlertId.INJECTION_OFF, by=InjectionOrder.START)]
    enable.stop()


@pytest.mark.parametrize(
    ("content", "mode"),
    [
        *((t, 0o600) for t in ("", "[]", "nonsense", "{" * 5000, '{"utc_s": 1' + "0" * 400 + "}")),
        ({"open": 1}, 0o600),
        (OPEN, 0o666),  # another user's
    ],
)
def test_a_damaged_file_or_another_users_is_ignored(path: Path, content: Any, mode: int) -> None:
    left(path, content, mode)
    memory = InjectionEnableMemory(path)
    assert memory.recall() is None
    memory.stop()


@pytest.mark.parametrize(("flown", "kept"), [("map a", True), ("map b", False), ("", True)])
def test_a_no_go_is_of_the_map_that_was_seen(path: Path, flown: str, kept: bool) -> None:
    """The map was exchanged for the right one, and ten minutes long nothing was injected."""
    killed = ShadowFailureMemory(path, about="map a")
    killed.store(True)
    exists(path)
    killed.stop(clean_shutdown=False)
    again = ShadowFailureMemory(path, about=flown)
    assert again.recall() == kept
    again.stop()


@pytest.mark.parametrize(
    ("against", "kept"),
    [
        ("20 m off", True),
        ("", False),
        (5, False),
        (None, False),
        ("\x1b[2J", False),
        (["x"], False),
    ],
)
def test_a_no_go_of_an_older_version_is_of_any_map_and_of_nonsense_is_none(path, against, kept):
    left(path, {"against": against})
    memory = ShadowFailureMemory(path, about="map a")
    assert memory.recall() is kept
    memory.stop()


def test_an_orderly_end_in_the_middle_of_a_write_leaves_no_open_gate(path, monkeypatch):
    """The write was finished after the order to end, and the next start injected unasked."""
    flush, ends = os.fsync, threading.Event()

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


def _bridge(path: Path, connection: str, told: list[Alert]) -> Bridge:
    config = BridgeConfig(connection=connection, mode="rc", state_file=path)
    return Bridge(config, 0.0, on_alert=told.append)


def test_the_bridge_restores_the_gate_that_a_killed_one_left_open(path, autopilot):
    left(path, OPEN)
    told = list[Alert]()
    with _bridge(path, f"udpout:127.0.0.1:{autopilot.port}", told):
        # Told once somebody may hear it: after the first word about the flight controller.
        assert sleep_until(lambda: any(a.id is AlertId.INJECTION_RESTORED for a in told), 30.0)
    assert told[0].id in (AlertId.FC_FOUND, AlertId.FC_SILENT)
    assert not path.exists()


def test_a_bridge_that_does_not_end_in_order_leaves_the_gate_to_the_next(path: Path) -> None:
    """Its process takes over from a killed one, and fails on the way up. A standby that never flew
    leaves the file alone.
    """
    left(path, OPEN)
    bridge = _bridge(path, "udpout:127.0.0.1:9", [])
    bridge.start()
    bridge.hand_over()
    bridge.stop()
    _bridge(path, "udpout:127.0.0.1:9", []).stop()
    assert json.loads(path.read_text())["open"] is True


def test_what_is_not_remembered_is_not_kept_by_such_an_end(path: Path) -> None:
    enable, _ = restarted(path)
    enable.command(31010, 1.0)
    exists(path)
    enable.command(31010, 0.0)
    assert sleep_until(lambda: not path.exists(), 20.0)
    enable.stop(clean_shutdown=False)
    assert not path.exists()
