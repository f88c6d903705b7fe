"""The command line as a process: what an operator sees of wrong input and of an interrupt."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from typer.testing import CliRunner

from companion.cli.commands import app, main
from companion.errors import ConfigError, ReportError
from companion.writing import make_folder
from mavlink_bridge.errors import BridgeStateError, TlogError
from mavlink_bridge.link.link import sleep_until
from mavlink_bridge.link.signing import load_key
from tests.companion.test_config import MINIMAL
from tests.mavlink_bridge.conftest import FakeAutopilot

MODEL = {"width": 640, "height": 480, "fx": 550, "fy": 550, "cx": 320, "cy": 240}
START_S = 400.0  # of a process, on a busy machine that compiles everything anew


@pytest.fixture
def map_cache(small_assets):
    return small_assets.map_cache


# A part that is being made when the operator interrupts, inside a callback that C calls: there an
# exception would be printed and lost.
INTERRUPTED_IN_A_CALLBACK = """
import ctypes, os, signal, sys
import companion.flight.recorder
import companion.flight.component_table
from companion.cli.commands import main

number, part = getattr(signal, sys.argv.pop()), sys.argv.pop()

def make(*_):
    ctypes.CFUNCTYPE(None)(lambda: os.kill(os.getpid(), number))()
    print("went on", flush=True)
    raise SystemExit(1)

module = {
    "build_localizer": companion.flight.component_table,
    "write_manifest": companion.flight.recorder,
}
setattr(module[part], part, make)
main()
"""

# The same while the called command is imported.
INTERRUPTED_IN_AN_IMPORT = """
import ctypes, os, signal, sys
from companion.__main__ import main

class Finder:
    def find_spec(self, name, *_):
        if name == "companion.cli.key":
            ctypes.CFUNCTYPE(None)(lambda: os.kill(os.getpid(), signal.SIGINT))()

sys.meta_path.insert(0, Finder())
main()
"""


def _config(tmp_path, **changes):
    config = {
        "camera": {"source": "udp://127.0.0.1:5", "model": MODEL},
        "bridge": {"connection": "tcp:127.0.0.1:9"},
        "record": {"folder": str(tmp_path / "record")},
    }
    path = tmp_path / "companion.yaml"
    path.write_text(yaml.safe_dump(config | changes))
    return str(path)


def _process(*arguments):
    return subprocess.Popen(
        [sys.executable, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def _start(tmp_path, **changes):
    return _process("-m", "companion", "run", _config(tmp_path, **changes))


def _ended(process):
    out, err = process.communicate(timeout=START_S)
    assert "Traceback" not in out + err
    return process.returncode, err.strip()


def test_a_part_that_fails_on_the_way_up_leaves_no_thread_behind(map_cache, tmp_path):
    camera = {"source": "nothing.mp4", "model": MODEL}
    code, text = _ended(_start(tmp_path, map=str(map_cache), camera=camera))
    assert code == 2
    assert text.startswith("StreamOpenError: ")
    assert len(text.splitlines()) == 1
    assert not (tmp_path / "record").exists()


def test_markup_in_a_message_is_shown_as_it_is(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("signal.signal", lambda *_: None)  # it would stay after the test
    words = ["companion", "run", _config(tmp_path, map="[/red]nowhere")]
    monkeypatch.setattr("sys.argv", words)
    with pytest.raises(SystemExit, match="2"):
        main()
    assert "[/red]nowhere: no tile cache here" in capsys.readouterr().err


def test_an_interrupt_of_a_flight_ends_it_cleanly(map_cache, tmp_path):
    process = _start(tmp_path, map=str(map_cache))
    assert sleep_until((tmp_path / "record/health.json").exists, START_S)
    process.send_signal(signal.SIGINT)
    assert _ended(process)[0] == 0


@pytest.mark.parametrize(
    ("number", "part"), [("SIGINT", "build_localizer"), ("SIGTERM", "write_manifest")]
)
def test_an_interrupt_is_not_lost_in_a_callback_of_the_way_up(map_cache, tmp_path, number, part):
    path = _config(tmp_path, map=str(map_cache))
    process = _process("-c", INTERRUPTED_IN_A_CALLBACK, "run", path, part, number)
    out, err = process.communicate(timeout=START_S)
    assert (process.returncode, err) == (130, "")
    assert "went on" not in out
    assert not (tmp_path / "record").exists()


def test_an_interrupt_is_not_lost_in_the_import_of_a_command():
    process = _process("-c", INTERRUPTED_IN_AN_IMPORT, "key")
    out, err = process.communicate(timeout=START_S)
    assert (process.returncode, out, err) == (130, "", "")


def test_a_port_in_use_is_told_before_anything_is_compiled(map_cache, tmp_path, monkeypatch):
    monkeypatch.setattr("signal.signal", lambda *_: None)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        targets = {"detections": f"127.0.0.1:{taken.getsockname()[1]}"}
        result = CliRunner().invoke(
            app, ["run", _config(tmp_path, map=str(map_cache), targets=targets)]
        )
    assert str(result.exception).startswith("targets.detections")
    assert "making the localizer ready" not in result.output
    assert not (tmp_path / "record").exists()


def test_a_folder_that_cannot_be_made_is_one_line(map_cache, tmp_path, monkeypatch):
    monkeypatch.setattr("signal.signal", lambda *_: None)
    (tmp_path / "file").touch()
    bridge = {"connection": "tcp:127.0.0.1:9", "tlog": str(tmp_path / "file" / "flight.tlog")}
    result = CliRunner().invoke(app, ["run", _config(tmp_path, map=str(map_cache), bridge=bridge)])
    assert isinstance(result.exception, TlogError)
    assert "file" in str(result.exception)
    assert "\n" not in str(result.exception)
    with pytest.raises(ReportError, match=r"--report .*is a file; give a folder"):
        make_folder(tmp_path / "file", "--report")


def test_an_interrupt_during_the_imports_ends_it_without_a_word():
    process = _process("-X", "importtime", "-m", "companion", "--help")
    assert process.stderr is not None
    # What follows is more than a pipe holds: it is in its imports until this reads on.
    before = next(line for line in process.stderr if "numpy" in line)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=START_S)
    assert process.returncode == 130
    assert out == ""
    assert "Traceback" not in before + err


@pytest.mark.parametrize("options", [("--fov", "nan"), ("--fov=inf",)])
def test_an_option_that_is_no_finite_number_is_named(tmp_path, options):
    """The ranges of options let nan pass."""
    result = CliRunner().invoke(app, ["try", str(tmp_path), *options])
    assert isinstance(result.exception, ConfigError)
    assert re.fullmatch("--fov (nan|inf): give a finite number", str(result.exception))


# --- ``companion key``: a key is made once, and given to a disarmed vehicle only ----------------


class Vehicle(FakeAutopilot):
    """Takes SETUP_SIGNING as ArduPilot does, and signs from then on."""

    armed = False

    def send(self, message: Any, component: int = 1, system: int = 1) -> None:
        if self.armed and message.get_type() == "HEARTBEAT":
            message.base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        super().send(message, component, system)

    def answer(self, m: Any) -> None:
        if m.get_type() != "SETUP_SIGNING":
            super().answer(m)
            return
        signing = self.codec.signing
        if signing.secret_key is None:
            signing.secret_key, signing.sign_outgoing = bytes(m.secret_key), True
            signing.timestamp = m.initial_timestamp


@pytest.fixture
def vehicle() -> Iterator[Vehicle]:
    listening = Vehicle()
    yield listening
    listening.stop()


def test_a_key_is_made_for_its_owner_and_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "mavlink.key"
    result = CliRunner().invoke(app, ["key", str(path)])
    assert result.exit_code == 0, result.output
    key = load_key(path)
    assert path.stat().st_mode & 0o777 == 0o600
    again = CliRunner().invoke(app, ["key", str(path)])
    assert isinstance(again.exception, ConfigError)
    assert load_key(path) == key
    assert key.hex() not in result.output


def test_a_connection_that_is_none_is_told_before_a_key_is_made(tmp_path: Path) -> None:
    path = tmp_path / "mavlink.key"
    result = CliRunner().invoke(app, ["key", str(path), "--install", "pigeon:1"])
    assert isinstance(result.exception, ConfigError)
    assert "--install pigeon:1" in str(result.exception)
    assert not path.exists()


def test_the_vehicle_signs_with_the_installed_key(tmp_path: Path, vehicle: Vehicle) -> None:
    path, where = tmp_path / "mavlink.key", f"udpout:127.0.0.1:{vehicle.port}"
    result = CliRunner().invoke(app, ["key", str(path), "--install", where])
    assert result.exit_code == 0, result.output
    assert "heartbeat is signed" in result.output
    assert vehicle.codec.signing.secret_key == load_key(path)


def test_an_armed_vehicle_is_given_no_key(tmp_path: Path, vehicle: Vehicle) -> None:
    path, where = tmp_path / "mavlink.key", f"udpout:127.0.0.1:{vehicle.port}"
    vehicle.armed = True
    result = CliRunner().invoke(app, ["key", str(path), "--install", where])
    assert isinstance(result.exception, BridgeStateError)
    assert "disarm" in str(result.exception)
    assert not vehicle.of("SETUP_SIGNING")


# --- What a command is doing goes to standard error, what it found to standard output -----------


def test_doctors_table_stands_alone_on_standard_output(tmp_path: Path) -> None:
    file = tmp_path / "d.yaml"
    file.write_text(yaml.safe_dump(MINIMAL | {"map": str(tmp_path / "none")}))
    done = CliRunner().invoke(app, ["doctor", str(file), "--beside-flight"])
    assert done.exit_code == 2
    assert "NOT fit to fly" in done.stdout
    assert "examining" not in done.stdout
    assert "examining" in done.stderr
