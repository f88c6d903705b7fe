"""Flies one scenario: doctor, vehicle, pilot, injection of simulated fixes, faults, record."""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import yaml

from companion.integrity_monitor.checks import IntegrityLimits
from companion.integrity_monitor.integrity_monitor import IntegrityMonitor
from mavlink_bridge import Bridge, BridgeConfig
from mavlink_bridge.link.link import sleep_until
from mavlink_bridge.messages import VisionFix
from mavlink_bridge.preflight.doctor import Diagnosis, examine
from sitl.errors import PilotError, SimulationError
from sitl.geodesy import Location
from sitl.ground.pilot import Pilot
from sitl.suite.case import Case, CaseEvent, RunningRamp
from sitl.suite.record import CaseRecord, Doctor, Text, VehicleSample
from sitl.suite.simulated_localizer import BridgeFeed, FixModel
from sitl.vehicles.launch import VehicleSetup, open_vehicle
from sitl.vehicles.process import VehicleKind, VehicleProcess, VehicleProcessError

_TIMEOUT_S = 180.0


class DoctorError(SimulationError):
    """`companion doctor` failed."""


def run_doctor(config: BridgeConfig) -> Doctor:
    """Run the doctor, then `companion doctor --fix --yes`, which writes the vehicle's parameters,
    then the doctor again; returns what both runs found. `DoctorError` if nothing was written.

    The exit codes are those of the flight controller's checks only, because a suite has neither map
    nor camera, which `companion doctor` would report as missing.
    """
    before = examine(config)
    found = tuple(f.name for f in before.findings if not f.ok and f.fix is not None)
    _fix(config)
    after = examine(config)
    # A failsafe is the pilot's decision: told, and never written.
    mended = Diagnosis(tuple(f for f in after.findings if f.required or f.fix is not None))
    left = tuple(f"{f.name} {f.found}" for f in mended.findings if not f.ok)
    return Doctor(found, left, before.exit_code, mended.exit_code)


def _fix(config: BridgeConfig) -> None:
    camera = {"width": 640, "height": 480, "fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0}
    with tempfile.TemporaryDirectory(prefix="doctor-") as folder:
        deployment = {
            "map": "no-map",
            "camera": {"source": "no-video", "model": camera},
            "bridge": config.model_dump(mode="json", exclude_none=True),
        }
        path = Path(folder) / "deployment.yaml"
        path.write_text(yaml.safe_dump(deployment), encoding="utf-8")
        command = [sys.executable, "-m", "companion", "doctor", str(path), "--fix", "--yes"]
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False
            )
        except subprocess.TimeoutExpired as error:
            raise DoctorError(f"companion doctor took more than {_TIMEOUT_S:g} s") from error
    if "written" not in done.stdout:
        raise DoctorError(
            f"companion doctor wrote nothing (status {done.returncode}):\n"
            f"{done.stdout[-1500:]}{done.stderr[-500:]}"
        )


HOME = Location(47.397742, 8.545594, 488.0)
GEOID_M = 47.3
_GYROS_SETTLED_S = 27.0  # ArduPilot SITL refuses to arm before about 25 s
_SETTLE_S = 3.0
_REBOOT_S = 60.0  # within which the ports of the next boot are open; a tenth of a second is usual
_NEAR_M = 3.0
_STEP_S = 0.1
_LONGEST_S = 240.0
_ARMING_TRIES = 3
_PACE_S = 10.0


def fly(case: Case, kind: VehicleKind, seed: int = 0) -> CaseRecord:
    """Fly a scenario on a vehicle and return its record. seed: of the simulated errors. Raises
    `SimulationError` if the scenario could not be flown.
    """
    with ExitStack() as stack:
        setup = VehicleSetup(
            parameters=case.vehicle.all_parameters(), seed=seed, px4=case.vehicle.px4
        )
        vehicle = open_vehicle(kind, HOME, setup)
        return _CaseFlight(case, stack.enter_context(vehicle), stack, seed).run()


class _CaseFlight:
    """The flight of one scenario; `stack` closes everything that it opens.

    Above 200 lines: the steps of a flight, read from top to bottom, use the same open objects.
    """

    def __init__(self, case: Case, vehicle: VehicleProcess, stack: ExitStack, seed: int) -> None:
        self._case, self._vehicle, self._stack, self._seed = case, vehicle, stack, seed
        self._record = CaseRecord()
        self._pilots: list[Pilot] = []
        self._pilot = self._connect()
        self._bridge: Bridge
        self._feed: BridgeFeed
        self._model: FixModel = case.fixes
        self._start_ns = 0
        side = case.flight.side_m
        self._corners = [(side, 0.0), (side, side), (0.0, side), (0.0, 0.0)] if side else []
        self._waiting = list(case.timeline)
        self._ramp = RunningRamp(seed)
        self._ticks: list[tuple[float, float]] = []

    def run(self) -> CaseRecord:
        """Everything from power on to the record."""
        case = self._case
        self._wait_on_ground()
        self._inject()
        if case.before.reboot:
            self._pilot.wait_ready()
            self._reboot()
        if not case.flight.ground:
            self._take_off()
        self._start_ns = time.monotonic_ns()
        self._send_to_corner()
        while not self._over():
            self._happen()
            self._sample()
            self._steer()
            self._pilot.link.sleep(_STEP_S)
        if case.flight.ground:
            self._record.refusals = self._refusals()
        for pilot in self._pilots:
            self._collect(pilot)
        self._record.counters = self._bridge.counters()
        self._record.pace = slowest_pace(self._ticks)
        self._record.stall_s = longest_stall(self._ticks)
        return self._record

    # --- before ----------------------------------------------------------------------------------

    def _connect(self) -> Pilot:
        pilot = Pilot(self._vehicle.gcs_endpoint, self._vehicle.speedup, self._vehicle.check)
        pilot.link.connect()
        self._stack.callback(pilot.link.close)
        self._pilots.append(pilot)
        return pilot

    def _wait_on_ground(self) -> None:
        """What takes simulated time and needs no injection is run fast."""
        pilot, spec = self._pilot, self._case.vehicle
        with pilot.fast_forward():
            self._wait_for_gyros()
            if spec.receiver:
                pilot.wait_ready()
        if spec.origin_north_m is not None:
            pilot.set_origin(HOME.offset(spec.origin_north_m, 0.0, 0.0))

    def _wait_for_gyros(self) -> None:
        pilot = self._pilot
        pilot.link.wait(lambda: pilot.record.time_s > _GYROS_SETTLED_S, 60.0, "the gyros to settle")

    def _inject(self) -> None:
        case = self._case
        config = bridge_config(case, self._vehicle.companion_endpoint)
        if case.before.doctor:
            self._record.doctor = run_doctor(config)
            boots = self._vehicle.boots
            self._pilot.reboot()
            self._pilot.link.close()
            if not sleep_until(lambda: self._vehicle.boots > boots, _REBOOT_S):
                raise VehicleProcessError(f"the vehicle did not reboot in {_REBOOT_S:g} s")
            self._pilot = self._connect()
            with self._pilot.fast_forward():
                self._wait_for_gyros()
        self._bridge = Bridge(config, GEOID_M)
        self._bridge.start()
        self._stack.callback(self._bridge.stop)
        submit = self._guarded(self._bridge, config)
        self._feed = BridgeFeed(self._pilot, submit, case.fixes, HOME, GEOID_M, self._seed)
        self._stack.callback(self._feed.close)

    def _guarded(self, bridge: Bridge, config: BridgeConfig) -> Callable[[VisionFix], None]:
        """Where fixes go: the bridge, or the integrity monitor before the bridge if the scenario
        enables the monitor. The monitor gets no video frames here.
        """
        if not self._case.integrity_monitor.enabled:
            return bridge.submit
        injection = config.injection
        limits = IntegrityLimits(
            injection.alert_limit_m,
            injection.time_to_alert_s,
            gnss_is_ours=injection.message == "gps_input",
        )
        integrity_monitor = IntegrityMonitor(self._case.integrity_monitor, limits, bridge)
        integrity_monitor.start()
        self._stack.callback(integrity_monitor.stop)
        return integrity_monitor.submit

    def _take_off(self) -> None:
        self._pilot.wait_ready()
        self._pilot.arm()
        self._pilot.takeoff(self._case.flight.height_m)
        self._pilot.link.sleep(_SETTLE_S)

    # --- during ----------------------------------------------------------------------------------

    @property
    def _now_s(self) -> float:
        return self._seconds(time.monotonic_ns())

    def _seconds(self, time_ns: int) -> float:
        """Simulated seconds since the start of a CLOCK_MONOTONIC time."""
        return (time_ns - self._start_ns) * 1e-9 * self._vehicle.speedup

    def _over(self) -> bool:
        limit = self._case.flight.seconds
        if limit is not None:
            return self._now_s >= limit
        self._record.closed = not self._corners
        lost = self._pilot.record.mode != "GUIDED" and not self._waiting
        return self._record.closed or lost or self._now_s > _LONGEST_S

    def _happen(self) -> None:
        while self._waiting and self._waiting[0].at_s <= self._now_s:
            self._do(self._waiting.pop(0))
        for name, value in self._ramp.due(self._now_s).items():
            self._pilot.link.set_parameter(name, value)

    def _do(self, event: CaseEvent) -> None:
        if event.fixes:
            self._model = Case.changed(self._model, event)
            self._feed.change(self._model, reset=event.reset)
        for name, value in event.vehicle.items():
            self._pilot.link.set_parameter(name, value)
        self._ramp.begin(event, self._now_s)
        if event.source_set is not None:
            self._pilot.use_source_set(event.source_set)
        if event.reboot:
            self._reboot()
            self._corners = []
            self._take_off()

    def _reboot(self) -> None:
        """The simulator starts anew with it: on the ground, at home."""
        self._pilot.link.close()
        self._vehicle.restart()
        self._pilot = self._connect()
        self._feed.pilot = self._pilot

    def _sample(self) -> None:
        pilot = self._pilot
        north, east, _ = HOME.ned_of(pilot.record.truth.location)
        self._ticks.append((self._now_s, pilot.record.time_s))
        counters = self._bridge.counters()
        self._record.samples.append(
            VehicleSample(
                self._now_s,
                north,
                east,
                pilot.record.mode or "",
                pilot.record.armed,
                int(counters.get("bridge_injected") or 0),
                int(counters.get("ekf_source_set") or 0),
                pilot.record.time_s,
            )
        )

    def _steer(self) -> None:
        ekf = self._pilot.record.ekf
        if not self._corners or ekf is None or ekf.location is None:
            return
        north, east, _ = HOME.ned_of(ekf.location)
        if math.hypot(north - self._corners[0][0], east - self._corners[0][1]) < _NEAR_M:
            self._corners.pop(0)
            self._send_to_corner()

    def _send_to_corner(self) -> None:
        if self._corners and self._pilot.record.mode == "GUIDED" and not self._case.flight.ground:
            where = HOME.offset(*self._corners[0], 0.0)
            height = self._case.flight.height_m
            self._pilot.go_to(where.latitude_deg, where.longitude_deg, height)

    def _refusals(self) -> list[str] | None:
        """Try to arm on the ground. Returns the texts of the refusal; None if the vehicle armed."""
        pilot = self._pilot
        pilot.set_mode("GUIDED")
        since = time.monotonic_ns()
        try:
            pilot.arm(timeout_s=float(_ARMING_TRIES))
        except PilotError:
            texts = [t.text for t in pilot.record.texts if t.time_ns > since and "rm: " in t.text]
            return sorted(set(texts))
        return None

    # --- after -----------------------------------------------------------------------------------

    def _collect(self, pilot: Pilot) -> None:
        """Add a pilot's EKF errors and texts to the record; each reboot makes a new pilot."""
        record = self._record
        record.texts += [
            Text(self._seconds(t.time_ns), t.component, t.severity, t.text)
            for t in pilot.record.texts
        ]
        for sample, true in pilot.record.ekf_pairs():
            at_s = self._seconds(sample.time_ns)
            if at_s >= 0 and sample.location is not None:
                north, east, _ = true.ned_of(sample.location)
                record.errors.append((at_s, north, east))


def slowest_pace(ticks: Sequence[tuple[float, float]]) -> float:
    """Lowest ratio of simulated to real time over any ten seconds.

    ticks: (real time s, vehicle's time s) in order. Spans over a reboot, where the vehicle's time
    runs back, are skipped.
    """
    paces, first = [1.0], 0
    for due, own in ticks:
        while due - ticks[first][0] > _PACE_S:
            first += 1
        elapsed = due - ticks[first][0]
        if elapsed > 0.9 * _PACE_S and own > ticks[first][1]:
            paces.append((own - ticks[first][1]) / elapsed)
    return min(paces)


def longest_stall(ticks: Sequence[tuple[float, float]]) -> float:
    """Largest time (s) that the simulated vehicle lost against real time within any second. ticks:
    as for `slowest_pace`.
    """
    worst, first = 0.0, 0
    for due, own in ticks:
        while due - ticks[first][0] > 1.0:
            first += 1
        if own >= ticks[first][1]:
            worst = max(worst, (due - ticks[first][0]) - (own - ticks[first][1]))
    return worst


def bridge_config(case: Case, connection: str) -> BridgeConfig:
    """Bridge configuration of a scenario: injecting, with home as the EKF origin if there is no
    receiver.
    """
    settings: dict[str, Any] = {"mode": "inject", **case.bridge}
    if not case.vehicle.receiver:
        settings.setdefault(
            "origin",
            {
                "latitude_deg": HOME.latitude_deg,
                "longitude_deg": HOME.longitude_deg,
                "altitude_amsl_m": HOME.altitude_m,
            },
        )
    return BridgeConfig.model_validate({**settings, "connection": connection})
