"""Scripted ground station of the demo flight, from arming to the return."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from mavlink_bridge.alerts.ids import AlertId
from sitl.demo.companion_process import FlightCompanion
from sitl.demo.scenario import Scenario
from sitl.errors import FlightError
from sitl.geodesy import Location
from sitl.ground.mission_client import MissionStep, gimbal_step, speed_step, waypoint_step
from sitl.ground.pilot import Pilot
from sitl.vehicles.launch import VISION_SOURCE

_TRACKING_TIMEOUT_S = 60.0
_LEG_MARGIN_S = 60.0
_LANDING_TIMEOUT_S = 240.0  # 120 m at 0.5 m/s near the ground

Progress = Callable[[str, float], None]


class FlightScript:
    """Scripted ground station, from arming to the return."""

    def __init__(
        self,
        pilot: Pilot,
        scenario: Scenario,
        home: Location,
        companion: FlightCompanion,
        progress: Progress,
    ) -> None:
        self._pilot = pilot
        self._scenario = scenario
        self._home = home
        self.companion = companion
        self._progress = progress
        self.denied_ns: int | None = None
        """When GNSS went off, CLOCK_MONOTONIC; None before."""

    def fly(self) -> tuple[int, int]:
        """Wait for the companion, take off and fly the mission (`land`: and land). The span from
        GNSS off to the last waypoint, CLOCK_MONOTONIC ns. `FlightError` or `PilotError` if it is
        aborted.
        """
        pilot, scenario = self._pilot, self._scenario
        self.companion.wait_up(lambda: self._progress("starting the companion", 0.0))
        steps = mission(scenario, self._home)
        pilot.missions.upload(steps)
        pilot.point_gimbal(scenario.legs[0].gimbal_pitch_deg, 0.0)
        self._progress("taking off on GNSS", 0.05)
        pilot.set_mode("GUIDED")
        pilot.arm()
        pilot.takeoff(scenario.takeoff_height_m)
        at_height_s = pilot.record.time_s
        self._progress("waiting for the localizer to track", 0.15)
        pilot.link.wait(self._tracking, _TRACKING_TIMEOUT_S, "the localizer to track")
        pilot.link.sleep(max(0.0, scenario.deny_after_s - (pilot.record.time_s - at_height_s)))
        self.companion.require()
        self._deny()
        begin_ns = self.denied_ns = time.monotonic_ns()
        pilot.start_mission()
        self._follow(len(steps))
        end_ns = time.monotonic_ns()
        if scenario.land:
            self._land()
        return begin_ns, end_ns

    def distance_from_home(self) -> float:
        """True horizontal distance of the vehicle from its take-off position, m."""
        north, east, _ = self._home.ned_of(self._pilot.record.truth.location)
        return float(np.hypot(north, east))

    def _deny(self) -> None:
        if self._scenario.injection != "gps_input":  # that is a second receiver of the same set
            self._pilot.use_source_set(VISION_SOURCE)
        self._pilot.switch_gnss(False)

    def _follow(self, last_item: int) -> None:
        """Wait for the mission's last item, watching the companion."""
        legs = self._scenario.legs
        length = _mission_length(self._scenario)
        limit = length / self._scenario.speed_m_s * 1.5 + _LEG_MARGIN_S
        started = self._pilot.record.time_s
        while last_item not in self._pilot.record.reached:
            self.companion.require()
            if self._pilot.record.mode != "AUTO":
                raise FlightError(
                    f"the vehicle left AUTO for {self._pilot.record.mode}: "
                    + "; ".join(t.text for t in self._pilot.record.texts[-4:])
                )
            elapsed = self._pilot.record.time_s - started
            if elapsed > limit:
                raise FlightError(f"the mission took longer than {limit:.0f} s")
            share = min(0.2 + 0.8 * elapsed * self._scenario.speed_m_s / length / 1.15, 0.99)
            done = sum(1 for item in self._pilot.record.reached if item > 1)
            self._progress(f"GNSS denied: waypoint {min(done + 1, len(legs))}/{len(legs)}", share)
            self._pilot.link.sleep(0.5)
        self._progress("returned on vision alone", 1.0)

    def _land(self) -> None:
        self._progress("landing on vision alone", 0.99)
        self._pilot.land(_LANDING_TIMEOUT_S)

    def _tracking(self) -> bool:
        self.companion.require()
        return self.companion.health().alerts == (AlertId.TRACKING.value,)


def mission(scenario: Scenario, home: Location) -> list[MissionStep]:
    """Mission items of a scenario: the speed, then for each leg a gimbal command and a waypoint."""
    steps = [speed_step(scenario.speed_m_s)]
    for leg in scenario.legs:
        place = home.offset(leg.north_m, leg.east_m, 0.0)
        steps.append(gimbal_step(leg.gimbal_pitch_deg, 0.0))
        steps.append(waypoint_step(place.latitude_deg, place.longitude_deg, leg.height_m))
    return steps


def _mission_length(scenario: Scenario) -> float:
    corners = np.array([(0.0, 0.0)] + [(leg.east_m, leg.north_m) for leg in scenario.legs])
    return float(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum())
