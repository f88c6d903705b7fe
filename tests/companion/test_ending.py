"""What hangs is named and left behind, and what comes after it ends as it should."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from companion.config import RecordConfig, TargetConfig
from companion.conversions import CameraExtrinsics
from companion.ending import wait_for_end
from companion.flight.last_fix import FixMemory
from companion.flight.recorder import RecordKeeper
from companion.supervision.processes import Pulse
from companion.targets.reporter import TargetReporter
from companion.targets.target_manager import Click
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Pose
from tests.companion.estimates import DOWN, estimated

FRAME = LocalFrame(Geodetic(47.0, 8.0, 500.0))
TRACKED = estimated(Pose(DOWN, np.array([5.0, 6.0, 80.0])), variance=0.04)


class Hang:
    """Whoever calls it waits until the test is over."""

    def __init__(self) -> None:
        self.reached, self.over = threading.Event(), threading.Event()

    def __call__(self, *_: Any) -> Any:
        self.reached.set()
        self.over.wait(120.0)
        raise OSError("at last")


@pytest.fixture
def hang(monkeypatch: pytest.MonkeyPatch) -> Iterator[Hang]:
    monkeypatch.setattr("companion.ending._PATIENCE_S", 0.01)
    hanging = Hang()
    yield hanging
    hanging.over.set()


def ends(stop: Callable[[], Any]) -> bool:
    """Whether it comes back while the other hangs."""
    ending = threading.Thread(target=stop, daemon=True)
    ending.start()
    ending.join(60.0)
    return not ending.is_alive()


def test_a_thread_that_hangs_is_named_and_one_that_ends_is_not(hang, caplog, monkeypatch):
    hanging = threading.Thread(target=lambda: hang.over.wait(120.0), name="stuck", daemon=True)
    hanging.start()
    assert not wait_for_end(hanging)
    assert "the thread stuck does not end" in caplog.text
    caplog.clear()
    hang.over.set()
    monkeypatch.setattr("companion.ending._PATIENCE_S", 60.0)
    assert wait_for_end(hanging)
    assert not caplog.text


def test_a_map_on_a_dead_disk_keeps_the_targets_end_waiting_no_longer(hang: Hang) -> None:
    """Record and link to the autopilot are closed after the targets: they never were."""
    reporter = TargetReporter(TargetConfig(), hang, lambda _: None)
    reporter.start()
    reporter.add_estimate(TRACKED)
    reporter.begin(Click(1, TRACKED, (320.0, 240.0)))
    assert hang.reached.wait(60.0)
    assert ends(reporter.stop)


def test_a_last_fix_on_a_dead_disk_is_left_there(hang, tmp_path, monkeypatch):
    monkeypatch.setattr("companion.flight.last_fix._WRITE_S", 0.001)
    autopilot: Any = SimpleNamespace(rotation=lambda _: DOWN, velocity=np.zeros(3))
    path = tmp_path / "last-fix.json"
    path.write_text("{}")
    extrinsics = CameraExtrinsics(FRAME, 47.0, np.zeros(3))
    memory = FixMemory(path, autopilot, extrinsics, hang)
    bundle: Any = None
    memory.start()
    memory.add_estimate(TRACKED, bundle)
    assert hang.reached.wait(60.0)
    assert ends(memory.stop)
    assert path.exists()  # the same disk would be waited for once more


def test_a_pulse_that_hangs_never_writes_into_another_file(hang: Hang, tmp_path: Path) -> None:
    """Its pipe was closed under it: the next file that was opened got the pipe's number."""

    def beats() -> dict[str, int]:
        with contextlib.suppress(OSError):
            hang()
        return {}

    reading, writing = os.pipe()
    pulse = Pulse(beats, writing)
    pulse.start()
    assert hang.reached.wait(60.0)
    assert ends(lambda: pulse.stop(clean_shutdown=True))
    assert os.read(reading, 100).startswith(b"ending")
    os.fstat(writing)
    os.close(reading)


def test_a_record_whose_disk_stands_still_gets_no_maps_of_its_targets(hang, tmp_path, monkeypatch):
    monkeypatch.setattr("companion.flight.recorder._CLOSE_S", 0.01)
    asked: list[Path] = []
    monkeypatch.setattr("companion.flight.recorder.write_target_files", asked.append)
    monkeypatch.setattr("companion.flight.recorder.write_manifest", lambda *_: None)
    keeper = RecordKeeper(FRAME, lambda _: None)
    config: Any = None
    keeper.open(config, RecordConfig(folder=tmp_path / "flight"), lambda _: None)
    disk: Any = type("Disk", (), {"position_world": property(hang)})()
    keeper.recorder.target(disk)
    assert hang.reached.wait(60.0)
    assert ends(keeper.close)
    assert not asked
