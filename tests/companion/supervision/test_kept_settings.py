"""A deployment whose file goes away in flight: a restart flies with what was read before."""

from __future__ import annotations

import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from companion.cli.commands import app
from companion.config import CompanionConfig, load_config
from companion.errors import ConfigError
from companion.supervision.processes import FlightProcess, keep_settings, settings_of

MODEL = {"width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240}
SHIPPED = Path(__file__).parents[3] / "configs" / "deployment.yaml"


@pytest.fixture
def deployment(tmp_path: Path) -> Path:
    path = tmp_path / "companion.yaml"
    path.write_text(
        yaml.safe_dump({"map": "area", "camera": {"model": MODEL, "source": "udp://x:1"}})
    )
    return path


@pytest.fixture
def kept() -> Iterator[Callable[[CompanionConfig], int]]:
    descriptors: list[int] = []

    def made(config: CompanionConfig) -> int:
        descriptors.append(keep_settings(config))
        return descriptors[-1]

    yield made
    for descriptor in descriptors:
        os.close(descriptor)


@pytest.mark.parametrize("left", [None, b"", b"map: area\ncamera: {model: {wid", b"\x00\xff" * 9])
def test_a_lost_file_costs_nothing_in_the_air_and_ends_a_first_start(deployment, kept, left):
    """Each restart ended with it, and none ever flew again."""
    flown = load_config(deployment)
    descriptor = kept(flown)
    deployment.unlink()
    if left is None:
        deployment.mkdir()  # no file any more
    elif left:
        deployment.write_bytes(left)  # half written, or another program's
    for _ in range(2):  # of many restarts each reads it from its begin
        again, why = settings_of(deployment, descriptor)
        assert again == flown
        assert str(deployment) in why
    with pytest.raises(ConfigError):
        settings_of(deployment, None)


def test_a_file_that_is_there_counts(deployment, kept):
    descriptor = kept(load_config(deployment))
    deployment.write_text(deployment.read_text().replace("area", "other"))
    again, why = settings_of(deployment, descriptor)
    assert (again.map, why) == (deployment.parent / "other", "")


def test_every_setting_comes_back_from_a_folder_whose_name_is_no_utf8(kept, tmp_path):
    """No supervised flight began there."""
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/fl\xfcge"))
    folder.mkdir()
    flown = load_config(Path(shutil.copy(SHIPPED, folder)))
    assert settings_of(folder / "gone.yaml", kept(flown))[0] == flown


def test_it_takes_no_standard_streams_place(deployment, kept):
    """Begun with its input closed, every restart was told ``--kept=0``: wrong usage, its end."""
    config = load_config(deployment)
    saved = os.dup(0)
    os.close(0)
    try:
        assert kept(config) >= 3
    finally:
        os.dup2(saved, 0)
        os.close(saved)


_READS = 'import os, sys; sys.exit(os.pread(int(sys.argv[1]), 10, 0) != b\'{"map": "/\')'


def test_restarted_processes_can_read_it(deployment, kept):
    descriptor = kept(load_config(deployment))
    command = [sys.executable, "-S", "-c", _READS, str(descriptor)]
    for _ in range(2):
        process = FlightProcess(command, standby=False, hands_on=(descriptor,))
        assert process.wait(60.0) == 0
        process.close()


def test_restarts_are_given_it_and_the_first_start_is_not(deployment, monkeypatch):
    begun: list[tuple[list[str], tuple[int, ...]]] = []

    class Dies:
        pid = 1

        def __init__(
            self, command: list[str], *, standby: bool, hands_on: tuple[int, ...] = ()
        ) -> None:
            begun.append((command[5:], hands_on))
            self.code = 0 if len(begun) == 3 else -signal.SIGKILL

        def wait(self, _: float) -> int:
            return self.code

        def close(self) -> None:
            pass

    monkeypatch.setattr("companion.supervision.processes.FlightProcess", Dies)
    notifier = "mavlink_bridge.vehicle.crash_notifier"
    monkeypatch.setattr(f"{notifier}.report_without_bridge", lambda *_: True)
    before = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        done = CliRunner().invoke(app, ["run", str(deployment), "--supervised"])
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert done.exit_code == 0, done.output
    assert begun[0] == ([], ())
    (kept,) = begun[1][1]
    assert begun[1:] == [([f"--kept={kept}", "--restart"], (kept,))] * 2
