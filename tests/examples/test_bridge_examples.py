"""The bridge's examples as users run them, beside the embedded vehicle and real ArduCopter."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.config import TargetConfig
from companion.conversions import target_report
from companion.targets.clicks import ClickPolicy
from companion.targets.reporter import TargetReporter
from companion.targets.target_manager import TargetEstimate
from localizer.geometry.camera import Camera
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Array, Pose
from localizer.map.cache.pick import BundleHits
from localizer.types import PoseEstimate, RegistrationStatus, TrackingState
from mavlink_bridge import Bridge, BridgeConfig
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.reading import alert_of
from sitl.geodesy import Location
from sitl.ground.pilot import Pilot
from sitl.vehicles.launch import ArduPilotSitl, EmbeddedSitl, vision_only_parameters

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
HOME = Location(47.397742, 8.545594, 488.0)
GEOID = 47.3
GYROS_SETTLED_S = 27.0  # ArduPilot refuses to arm before
BOTH = [EmbeddedSitl, pytest.param(ArduPilotSitl, marks=pytest.mark.sitl)]


class Example:
    """A running example: what it printed, and its input."""

    def __init__(self, name: str, *arguments: object) -> None:
        self.process = subprocess.Popen(
            [sys.executable, str(EXAMPLES / name), *map(str, arguments)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            cwd=EXAMPLES.parent, env={"PYTHONPATH": str(EXAMPLES.parent), "PATH": ""},
        )  # fmt: skip
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line.rstrip("\n"))

    def write(self, line: str) -> None:
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def end(self) -> int:
        """Its exit code, once its input has ended."""
        self.process.stdin.close()
        code = self.process.wait(60.0)
        self._reader.join(60.0)
        return code


@pytest.fixture
def run() -> Iterator[Callable[..., Example]]:
    running: list[Example] = []

    def start(name: str, *arguments: object) -> Example:
        running.append(Example(name, *arguments))
        return running[-1]

    yield start
    for example in running:
        if example.process.poll() is None:
            example.process.kill()
            example.end()


class Feed:
    """Another's localizer: where the vehicle is, `north_m` beside the truth, 15 times a second."""

    def __init__(self, example: Example, pilot: Pilot, north_m: float) -> None:
        self._example, self._pilot, self._north_m = example, pilot, north_m
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(1.0 / 15.0):
            truth = self._pilot.record.truth_at(time.monotonic_ns() - 60_000_000)
            if truth is None:
                continue
            north, east, down = HOME.ned_of(truth.location)
            seen = HOME.offset(north + self._north_m, east, down)
            fix = {
                "time_ns": truth.time_ns,
                "latitude_deg": seen.latitude_deg,
                "longitude_deg": seen.longitude_deg,
                "height_m": seen.altitude_m + GEOID,
                "sigma_m": 0.5,
            }
            self._example.write(json.dumps(fix))


@pytest.mark.parametrize("kind", BOTH)
def test_the_ekf_is_where_my_fixes_say(kind: Any, run: Callable[..., Example]) -> None:
    """No receiver: without them there is no position; 20 m beside the truth, so is the EKF."""
    with kind(HOME, parameters=vision_only_parameters()) as vehicle:
        pilot = Pilot(vehicle.gcs_endpoint, vehicle.speedup, vehicle.check)
        pilot.link.connect()
        with pilot.fast_forward():
            pilot.link.wait(
                lambda: pilot.record.time_s > GYROS_SETTLED_S, 60.0, "the gyros to settle"
            )
        place = (HOME.latitude_deg, HOME.longitude_deg, HOME.altitude_m, GEOID)
        example = run("inject_my_fixes.py", vehicle.companion_endpoint, *place)
        example.write("hello")
        feed = Feed(example, pilot, north_m=20.0)
        try:
            pilot.wait_ready()
            pilot.arm()
            ekf = pilot.record.ekf
            assert ekf.location is not None
            north, east, _ = HOME.ned_of(ekf.location)
            assert math.hypot(north - 20.0, east) < 1.0
        finally:
            feed.stop()
            pilot.link.close()
    assert example.end() == 0
    # With the interlock: "injecting without shadow check", where there is no GNSS to check against.
    read = [alert_of(line) for line in example.lines]
    assert (AlertId.INJECTING, True) in read or (AlertId.INJECTION_UNCHECKED, True) in read
    # The line that is no fix was told, and it was the only one.
    refused = [line for line in example.lines if line.startswith("not a fix")]
    assert len(refused) == 1
    assert refused[0].startswith("not a fix: hello: JSONDecodeError")


# --- a click ------------------------------------------------------------------------------------

FRAME = LocalFrame(Geodetic(HOME.latitude_deg, HOME.longitude_deg, HOME.altitude_m + GEOID))
CAMERA = Camera.from_fov(640, 480, 60)
ABOVE = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 100.0]))  # looks down, north is up


def flat(origin: Array, directions: Array) -> BundleHits:
    return BundleHits(-origin[2] / directions[:, 2], np.tile([0.0, 0.0, 1.0], (len(directions), 1)))


class Clicked:
    """The companion's way from a click to a report, 100 m above flat ground at home."""

    def __init__(self, config: BridgeConfig) -> None:
        self._targets = TargetReporter(TargetConfig(rate_hz=10.0), flat, self._tell)
        self._clicks = ClickPolicy(self._targets, lambda *_: None, TargetConfig(rate_hz=10.0))
        self._bridge = Bridge(config, GEOID, on_track=self._clicks.on_request)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._localize)

    def __enter__(self) -> Clicked:
        self._targets.start()
        self._bridge.start()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._bridge.stop()
        self._targets.stop()

    def _localize(self) -> None:
        while not self._stop.wait(0.1):
            estimate = PoseEstimate(
                ABOVE, np.eye(6) * 1e-4, 1.0, TrackingState.TRACKING, RegistrationStatus.OK, True,
                time.monotonic_ns(), 0, CAMERA,
            )  # fmt: skip
            self._clicks.add_estimate(estimate)
            self._targets.add_estimate(estimate)

    def _tell(self, target: TargetEstimate) -> None:
        camera = target.estimate.camera
        self._bridge.report(target_report(target.fix, camera, FRAME, 1))


@pytest.mark.parametrize("kind", BOTH)
def test_a_click_is_answered_with_the_place_under_it(kind, run):
    """Through the vehicle: the click on one port, the companion on another."""
    with kind(HOME) as vehicle, Clicked(BridgeConfig(connection=vehicle.companion_endpoint)):
        example = run("click_to_target.py", vehicle.gcs_endpoint, 0.75, 0.5, 1)
        assert example.process.wait(120.0) == 0, example.lines
        example.end()
    latitude, longitude, altitude = (float(x) for x in example.lines[-1].split()[:3])
    seen = FRAME.enu_from_geodetic(latitude, longitude, altitude + GEOID)
    # A quarter of the picture's width to the right of its centre, seen from 100 m.
    east_m = 100.0 * math.tan(math.radians(30.0)) / 2.0
    np.testing.assert_allclose(seen, [east_m, 0.0, 0.0], atol=0.1)
