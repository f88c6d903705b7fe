"""The pilot's clock and tracks, and real flights over TCP of the embedded vehicle."""

from __future__ import annotations

import contextlib
import math
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mavlink_bridge.link.link import sleep_until
from sitl.errors import PilotError
from sitl.geodesy import Location
from sitl.ground.mission_client import (
    gimbal_step,
    return_step,
    speed_step,
    takeoff_step,
    waypoint_step,
)
from sitl.ground.pilot import Pilot
from sitl.ground.tracks import LeastLatencyClock, SampleTrack
from sitl.vehicles import launch, process
from sitl.vehicles.launch import (
    GIMBAL,
    SPEEDS,
    ArduPilotNotFoundError,
    ArduPilotSitl,
    EmbeddedSitl,
    VehicleSetup,
    find_arducopter,
    open_vehicle,
)
from sitl.vehicles.process import VehicleProcess, VehicleProcessError

HOME = Location(47.397742, 8.545594, 488.0)
SPEEDUP = 5.0


def test_boot_clock_takes_the_least_latency():
    clock = LeastLatencyClock(speedup=2.0)
    for boot_ms, latency_ms in ((100, 7), (120, 3), (140, 20)):
        clock.observe(boot_ms, int((1000 + boot_ms / 2 + latency_ms) * 1e6))
    assert clock.monotonic_ns(140) == int((1000 + 70 + 3) * 1e6)


def test_track_brackets_a_time_and_forgets_the_oldest():
    track: SampleTrack[Any] = SampleTrack(limit=10)
    for t in range(100):
        track.add(SimpleNamespace(time_ns=10 * t))
    both = track.neighbours(985)
    assert both is not None
    before, after = both
    assert (before.time_ns, after.time_ns) == (980, 990)
    assert track.neighbours(991) is None
    assert track.neighbours(0) is None
    assert len(track.samples()) <= 20
    track.add(SimpleNamespace(time_ns=5))
    assert track.newest.time_ns == 990


def test_a_vehicle_that_dies_at_once_is_reported_with_its_log(folders, tmp_path, monkeypatch):
    for log in (None, tmp_path / "vehicle.log"):
        vehicle = EmbeddedSitl(HOME, parameters={}, log=log)
        dying = ["/bin/sh", "-c", "echo out of propellers; exit 3"]
        monkeypatch.setattr(vehicle, "command", lambda _instance, it=dying: it)
        with pytest.raises(VehicleProcessError, match=r"(?s)ended with status.*out of propellers"):
            vehicle.start()
    assert log.read_text() == "out of propellers\n"
    assert not list(folders.iterdir())


class _Idle(VehicleProcess):
    """A vehicle that listens, as its log says, and does nothing."""

    kind = "embedded"
    start_timeout_s = 60.0

    def command(self, instance: int) -> list[str]:
        return ["/bin/sh", "-c", f"echo SERIAL2 on TCP port {5763 + 10 * instance}; sleep 600"]


@pytest.fixture
def folders(monkeypatch, tmp_path):
    """Where the folders of vehicles are made."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    return tmp_path / "temporary"


@pytest.mark.parametrize("end", [None, PilotError("not armed"), KeyboardInterrupt(), SystemExit(1)])
def test_a_vehicles_folder_goes_with_its_end(folders, end):
    with pytest.raises(type(end)) if end else contextlib.nullcontext(), _Idle(HOME) as vehicle:
        assert len(list(folders.iterdir())) == 1
        assert "SERIAL2" in vehicle.log_tail()
        if end:
            raise end
    assert not list(folders.iterdir())


@pytest.mark.parametrize("step", ["mkdtemp", "Popen", "_end_with_us", "_wait_listening"])
def test_a_start_that_is_interrupted_leaves_neither_process_nor_folder(folders, monkeypatch, step):
    """In the middle of each of its steps, when that has happened and nobody has been told."""
    where = {"mkdtemp": tempfile, "Popen": subprocess, "_wait_listening": _Idle}.get(step, process)
    real, started, popen = getattr(where, step), [], subprocess.Popen

    def interrupted(*arguments, **more):
        result = real(*arguments, **more)
        signal.raise_signal(signal.SIGINT)
        return result

    def noted(*arguments, **more):
        started.append(popen(*arguments, **more))
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", noted)
    if step == "Popen":
        real = noted
    monkeypatch.setattr(where, step, interrupted)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            _Idle(HOME).start()
    finally:
        signal.signal(signal.SIGINT, before)
    assert None not in [child.poll() for child in started]
    assert not list(folders.iterdir())


def test_a_vehicle_does_not_outlive_a_killed_parent():
    script = (
        "import time; from tests.sitl.ground.test_pilot import HOME, _Idle; v = _Idle(HOME);"
        "v.start(); print(v.processes[0].pid, flush=True); time.sleep(600)"
    )
    root = Path(__file__).resolve().parents[3]
    parent = subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, cwd=root
    )
    pid = parent.stdout.readline().strip()
    folder = Path(f"/proc/{pid}/cwd").readlink()
    parent.kill()
    parent.communicate()
    assert sleep_until(lambda: _ended(pid), 30.0)
    shutil.rmtree(folder)


def _ended(pid: str) -> bool:
    """Gone, or a zombie that nobody waits for."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return True


def test_no_vehicle_at_the_endpoint():
    with pytest.raises(PilotError, match="no vehicle listens"):
        Pilot("tcp:127.0.0.1:9").link.connect(timeout_s=0.5)


def test_a_missing_arducopter_is_a_named_error(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("ARDUPILOT_HOME", raising=False)
    with pytest.raises(ArduPilotNotFoundError, match="ARDUPILOT_HOME"):
        ArduPilotSitl(HOME)
    assert open_vehicle("auto", HOME).kind == "embedded"


def test_px4_flies_on_the_embedded_vehicle(monkeypatch, tmp_path):
    monkeypatch.setattr("sitl.vehicles.launch.find_arducopter", lambda: tmp_path)
    assert open_vehicle("auto", HOME, VehicleSetup(px4=True)).kind == "embedded"


def test_missing_default_parameters_are_a_named_error(monkeypatch, tmp_path):
    binary = tmp_path / "arducopter"
    binary.write_text("#!/bin/sh\n")
    binary.chmod(0o755)
    monkeypatch.setenv("ARDUPILOT_HOME", str(tmp_path))
    assert find_arducopter() == binary
    with pytest.raises(ArduPilotNotFoundError, match=r"copter\.parm"):
        ArduPilotSitl(HOME)


def test_finds_binary_and_defaults_in_a_source_tree(monkeypatch, tmp_path):
    binary = tmp_path / "build/sitl/bin/arducopter"
    defaults = tmp_path / "Tools/autotest/default_params/copter.parm"
    for path in (binary, defaults):
        path.parent.mkdir(parents=True)
        path.write_text("")
    binary.chmod(0o755)
    monkeypatch.setenv("ARDUPILOT_HOME", str(tmp_path))
    assert find_arducopter() == binary
    assert launch.find_defaults(binary) == defaults


# --- flights, of either vehicle ------------------------------------------------------------------


@pytest.fixture(params=["embedded", pytest.param("ardupilot", marks=pytest.mark.sitl)])
def kind(request):
    return request.param


def horizontal(a: Location, b: Location) -> float:
    return math.hypot(*a.ned_of(b)[:2])


def test_flies_a_mission(real_time, kind):
    parameters = {**GIMBAL, **SPEEDS}
    with real_time(), open_vehicle(kind, HOME, VehicleSetup(30.0, parameters, SPEEDUP)) as vehicle:
        pilot = Pilot(vehicle.gcs_endpoint, SPEEDUP, vehicle.check)
        with pilot:
            pilot.wait_ready()
            pilot.arm()
            pilot.takeoff(40.0)
            far = HOME.offset(120.0, 0.0, 0.0)
            turn = HOME.offset(120.0, 80.0, 0.0)
            steps = [
                takeoff_step(40.0),
                speed_step(8.0),
                waypoint_step(far.latitude_deg, far.longitude_deg, 40.0),
                gimbal_step(-60.0, 20.0),
                waypoint_step(turn.latitude_deg, turn.longitude_deg, 50.0),
                return_step(),
            ]
            pilot.missions.upload(steps)
            assert [i.command for i in pilot.missions.download()][1:] == [s.command for s in steps]
            begun = time.monotonic_ns()
            pilot.start_mission()
            pilot.link.wait(lambda: 5 in pilot.record.reached, 120.0, "the last waypoint")
            assert horizontal(pilot.record.truth.location, turn) < 6.0
            pairs = [p for p in pilot.record.ekf_pairs() if p[0].time_ns >= begun]
            flat = [math.hypot(*true.ned_of(sample.location)[:2]) for sample, true in pairs]
            assert len(flat) > 100
            assert np.percentile(flat, 95) < 2.0
            _check_gimbal(pilot)
            pilot.link.wait(lambda: not pilot.record.armed, 180.0, "the landing")
            assert horizontal(pilot.record.truth.location, HOME) < 4.0


def _check_gimbal(pilot):
    newest = pilot.record.gimbal_at(pilot.record.newest_common_ns())
    roll, pitch, yaw = (math.degrees(a) for a in newest.roll_pitch_yaw)
    assert (roll, pitch, yaw) == pytest.approx((0.0, -60.0, 20.0), abs=1.0)
    assert newest.yaw_in_vehicle_frame
    state = pilot.record.gimbal_at(newest.time_ns - 10_000_000)
    assert state is not None
    assert pilot.record.truth_at(newest.time_ns - 50_000_000) is not None


def test_a_reboot_by_command_keeps_the_parameters(kind):
    with open_vehicle(kind, HOME, VehicleSetup(0.0, {}, SPEEDUP)) as vehicle:
        with Pilot(vehicle.gcs_endpoint, SPEEDUP, vehicle.check) as pilot:
            pilot.link.set_parameter("VISO_TYPE", 1)
            pilot.link.sleep(5)
            before = pilot.record.time_s
            pilot.reboot()
        assert sleep_until(lambda: vehicle.boots == 2, 60.0)
        with Pilot(vehicle.gcs_endpoint, SPEEDUP, vehicle.check) as pilot:
            assert 0 < pilot.record.time_s < before + 10
            assert pilot.link.parameter("VISO_TYPE") == 1


def test_waiting_for_a_vehicle_that_died_ends_at_once():
    with open_vehicle("embedded", HOME, VehicleSetup(0.0, {}, SPEEDUP)) as vehicle:
        pilot = Pilot(vehicle.gcs_endpoint, SPEEDUP, vehicle.check)
        with pilot:
            vehicle.stop()
            start = time.monotonic()
            with pytest.raises(VehicleProcessError, match="died"):
                pilot.link.sleep(600)
            assert time.monotonic() - start < 60.0  # of the 600 / SPEEDUP


def test_refusals_reach_the_pilot(kind):
    with open_vehicle(kind, HOME, VehicleSetup(0.0, {"SIM_GPS1_ENABLE": 0}, SPEEDUP)) as vehicle:
        pilot = Pilot(vehicle.gcs_endpoint, SPEEDUP, vehicle.check)
        with pilot:
            pilot.link.sleep(26)
            pilot.set_mode("GUIDED")
            with pytest.raises(PilotError, match=r"GPS 1: Bad fix|Need Position Estimate"):
                pilot.arm(timeout_s=6.0)
            with pytest.raises(PilotError, match="NO_SUCH_PARAM"):
                pilot.link.parameter("NO_SUCH_PARAM", tries=2)
            with pilot.fast_forward(8.0):
                assert pilot.link.parameter("SIM_SPEEDUP") == 8.0
            assert pilot.link.parameter("SIM_SPEEDUP") == SPEEDUP
    with pytest.raises(VehicleProcessError, match="died"):
        vehicle.check()
