"""What forbids injection is as true after a restart, until evidence speaks against it."""

from __future__ import annotations

import json
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from companion.integrity_monitor.checks import IntegrityLimits
from companion.integrity_monitor.config import IntegrityMonitorConfig
from companion.integrity_monitor.debouncer import InhibitMemory
from companion.integrity_monitor.integrity_monitor import IntegrityMonitor
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import CalibrationError
from mavlink_bridge.messages import VehicleState
from tests.companion.integrity_monitor.simulated import Flight, monitor
from tests.companion.integrity_monitor.test_checks import looking

LONG = {AlertId.FOCAL_LENGTH: (5.0, CalibrationError.LONG)}
KEPT = {"focal_length": [5.0, "long"]}


class Kept(InhibitMemory):
    """A memory without a file."""

    def __init__(self, found: object = None) -> None:
        self.told: Any = None if found is None else json.loads(json.dumps({"inhibits": found}))

    def recall_state(self) -> tuple[dict[str, Any], float] | None:
        self._kept = frozenset()  # a process that begins has stored nothing
        return None if self.told is None else (self.told, 4.0)

    def store_state(self, state: dict[str, Any]) -> None:
        self.told = json.loads(json.dumps(state))

    def drop(self) -> None:
        self.told = None

    def stop(self, *, clean_shutdown: bool = True) -> None:
        self.told = None if clean_shutdown else self.told


def integrity_monitor(
    kept: Any, *, injecting: bool = False
) -> tuple[IntegrityMonitor, list[AlertId]]:
    """Over a vehicle on the ground. What it forbids with each turn."""
    inhibited: list[AlertId] = []
    flight = Flight(monitor())
    bridge: Any = SimpleNamespace(
        injecting=injecting, state=VehicleState, inertial_since=lambda _: (),
        report_alert=lambda _: None, attitude_at=lambda _: None, gimbal_at=flight.gimbal_at,
        clear=inhibited.remove,
        inhibit=inhibited.append, gnss_place_at=lambda _: None,
    )  # fmt: skip
    return IntegrityMonitor(IntegrityMonitorConfig(), IntegrityLimits(), bridge, kept), inhibited


def test_what_forbade_in_a_process_that_was_killed_forbids_from_the_start() -> None:
    """A focal length that was 5 % long: the next process injected after two seconds, and it took a
    turn or a climb until it was found again.
    """
    kept = Kept(KEPT)
    again, inhibited = integrity_monitor(kept)
    again.start()
    assert inhibited == [AlertId.FOCAL_LENGTH]
    again.stop()
    again.run_checks()
    assert inhibited == [AlertId.FOCAL_LENGTH]
    assert kept.told == {"inhibits": KEPT}  # for the next, too
    again.close()
    assert kept.told is None


def test_an_end_that_is_none_in_order_leaves_it() -> None:
    kept = Kept(KEPT)
    again, _ = integrity_monitor(kept)
    again.start()
    again.hand_over()
    again.stop()
    assert kept.told is not None


def test_what_flies_is_not_taken_back_by_a_restart() -> None:
    """Found after injection had begun: a process that was killed goes on, as without the kill."""
    kept = Kept(KEPT)
    flying, _ = integrity_monitor(kept, injecting=True)
    flying.start()
    flying.stop()
    flying.run_checks()
    assert kept.told is None


def test_evidence_ends_what_was_kept() -> None:
    """The camera looks where it is said to: 4 degrees off was another, or wrong."""
    watched = monitor()
    watched.restore({AlertId.BORESIGHT: (4.0, CalibrationError.YAW)})
    flight = Flight(watched, noise_m=0.05)
    for quarter in range(1, 160):
        flight.fly(0.25 * quarter)
        watched.add_observation(looking(flight, 0.0))
    assert flight.ended(AlertId.BORESIGHT) < 40.0
    assert not watched.inhibiting


def test_without_evidence_it_stands() -> None:
    watched = monitor()
    watched.restore(LONG)
    Flight(watched, noise_m=0.05).fly(40.0)
    assert watched.inhibiting == {AlertId.FOCAL_LENGTH}


@pytest.mark.parametrize(
    "found",
    [
        5, [], {"focal_length": 5}, {"focal_length": [5.0]}, {"focal_length": ["x", "long"]},
        {"focal_length": [float("nan"), "long"]}, {"focal_length": [5.0, "\x1b[2J"]},
        {"motion": [5.0, ""]}, {"no rule": [5.0, ""]}, {"focal_length": [5.0, 30 * "x"]},
    ],
)  # fmt: skip
def test_what_is_no_finding_that_forbids_is_none(found: object) -> None:
    assert Kept(found).recall() == {}


def test_it_is_of_the_camera_and_the_map_that_flew(tmp_path: Path) -> None:
    """Who mends the deployment and begins anew is not kept from it by what was."""
    path = tmp_path / "guardian-forbids.json"
    path.write_text(json.dumps({"inhibits": KEPT, "utc_s": time.time(), "about": "this camera"}))
    path.chmod(0o600)
    for about, found in (("another", {}), ("this camera", LONG)):
        memory = InhibitMemory(path, about=about)
        assert memory.recall() == found
        memory.stop(clean_shutdown=False)
    assert path.exists()
