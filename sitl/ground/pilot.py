"""Scripted ground station for either simulated vehicle, with a record of the true motion.

Calls block until the vehicle has executed the command; `PilotError` if it refuses or stays silent.
Seconds are simulated; true states and gimbal angles are looked up by CLOCK_MONOTONIC.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.errors import PilotError
from sitl.geodesy import Location
from sitl.ground.link import GroundLink
from sitl.ground.mission_client import MissionClient
from sitl.ground.vehicle_record import AUTOPILOT, MODES, PX4_MODES, VEHICLE

_GUIDED_POSITION = 0xDF8  # position only
_READY_S = 120.0  # of a vehicle on the ground, and of a take-off
_SHOWN_S = 30.0  # simulated, until the next heartbeat shows what was accepted


class Pilot:
    """Flies a vehicle by MAVLink. link: commands; record: received data; missions: mission
    protocol.

    The arguments are those of `GroundLink`. Entering the context manager connects.
    """

    def __init__(
        self,
        endpoint: str,
        speedup: float = 1.0,
        alive: Callable[[], None] = lambda: None,
    ) -> None:
        self.link = GroundLink(endpoint, speedup, alive)
        self.record = self.link.record
        self.missions = MissionClient(self.link)
        self._ground_m = 0.0  # AMSL, where it took off

    def __enter__(self) -> Pilot:
        self.link.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.link.close()

    # --- flying ------------------------------------------------------------------------------

    @contextlib.contextmanager
    def fast_forward(self, speedup: float = 10.0) -> Iterator[None]:
        """Context manager: run simulated time faster (SIM_SPEEDUP), to wait on the ground."""
        normal = self.link.speedup
        self.link.set_speed(speedup)
        try:
            yield
        finally:
            self.link.set_speed(normal)

    def wait_ready(self) -> None:
        """Wait for an EKF position, change to GUIDED, wait for the pre-arm checks there, and read
        the EKF origin. `PilotError` after 120 s each.
        """
        self.link.wait(self._has_position, _READY_S, "an EKF position")
        self.set_mode("GUIDED")
        bit = mavlink.MAV_SYS_STATUS_PREARM_CHECK
        self.link.wait(
            lambda: bool(self.record.latest["SYS_STATUS"].onboard_control_sensors_health & bit),
            _READY_S,
            "the pre-arm checks",
        )
        self.read_origin()

    def _has_position(self) -> bool:
        wanted = mavlink.ESTIMATOR_POS_HORIZ_ABS | mavlink.ESTIMATOR_POS_HORIZ_REL
        return (
            bool(self.record.ekf_flags & wanted)
            and not self.record.ekf_flags & mavlink.ESTIMATOR_CONST_POS_MODE
        )

    def set_mode(self, name: str) -> None:
        """Change the mode, one of `MODES`, and wait until the heartbeat reports it."""
        numbers = PX4_MODES[name] if self.record.is_px4 else (MODES[name],)
        self.link.command(mavlink.MAV_CMD_DO_SET_MODE, 1, *numbers)
        self.link.wait(lambda: self.record.mode == name, _SHOWN_S, f"mode {name}")

    def arm(self, timeout_s: float = 60.0) -> None:
        """Arm, asking again until the checks pass; `PilotError` with the refusals on timeout."""
        start_s, start_ns = self.record.time_s, time.monotonic_ns()
        while True:
            if self.link.try_command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == 0:
                break
            if self.record.time_s - start_s > timeout_s:
                reasons = {
                    t.text for t in self.record.texts if t.time_ns > start_ns and "rm: " in t.text
                }
                raise PilotError(f"not armed in {timeout_s:g} s: {'; '.join(sorted(reasons))}")
            self.link.sleep(1.0)
        self.link.wait(lambda: self.record.armed, _SHOWN_S, "the armed heartbeat")

    def reboot(self) -> None:
        """Reboot the disarmed autopilot; the caller then needs a new connection."""
        self.link.command(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1)

    def takeoff(self, height_m: float) -> None:
        """Take off, armed in GUIDED; returns at a true height above ground of height_m - 2 m."""
        ground = self.record.truth.altitude_m
        self._ground_m = ground
        height = height_m + ground if self.record.is_px4 else height_m  # PX4: AMSL
        self.link.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, height)
        self.link.wait(
            lambda: self.record.truth.altitude_m > ground + height_m - 2.0,
            _READY_S,
            f"the take-off to {height_m:g} m",
        )

    def go_to(self, latitude_deg: float, longitude_deg: float, height_m: float) -> None:
        """Send the vehicle to a position and height above home in GUIDED; does not wait."""
        if self.record.is_px4:
            self._reposition(latitude_deg, longitude_deg, height_m)
            return
        self.link.send(
            mavlink.MAVLink_set_position_target_global_int_message(
                0,
                VEHICLE,
                AUTOPILOT,
                mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
                _GUIDED_POSITION,
                round(latitude_deg * 1e7),
                round(longitude_deg * 1e7),
                height_m,
                *([0.0] * 8),
            )
        )

    def _reposition(self, latitude_deg: float, longitude_deg: float, height_m: float) -> None:
        """Send a PX4 vehicle to a position: PX4's Hold ignores SET_POSITION_TARGET."""
        self.link.send(
            mavlink.MAVLink_command_int_message(
                VEHICLE,
                AUTOPILOT,
                mavlink.MAV_FRAME_GLOBAL,
                mavlink.MAV_CMD_DO_REPOSITION,
                0,
                0,
                -1.0,
                0.0,
                0.0,
                math.nan,
                round(latitude_deg * 1e7),
                round(longitude_deg * 1e7),
                self._ground_m + height_m,
            )
        )

    def land(self, timeout_s: float = 180.0) -> None:
        """Land and wait until the vehicle has disarmed."""
        self.set_mode("LAND")
        self.link.wait(lambda: not self.record.armed, timeout_s, "the landing")

    def switch_gnss(self, on: bool) -> None:
        """Switch the simulated receiver on or off."""
        self.link.set_parameter("SIM_GPS1_ENABLE", 1.0 if on else 0.0)

    def use_source_set(self, number: int) -> None:
        """Order an EKF source set, 1 to 3; `PilotError` unless the vehicle accepts it."""
        self.link.command(mavlink.MAV_CMD_SET_EKF_SOURCE_SET, number)

    def set_origin(self, origin: Location) -> None:
        """Set the EKF origin (needed without GNSS) and read it back. `PilotError` if the vehicle
        has none then.
        """
        self.link.send(
            mavlink.MAVLink_set_gps_global_origin_message(
                VEHICLE,
                round(origin.latitude_deg * 1e7),
                round(origin.longitude_deg * 1e7),
                round(origin.altitude_m * 1000),
            )
        )
        if not self.link.wait_wall(lambda: self.read_origin() is not None, 60.0):
            raise PilotError("the vehicle took no EKF origin")

    def read_origin(self) -> Location | None:
        """Request the EKF origin; returns the newest one received, None without any."""
        self.link.try_command(
            mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN
        )
        return self.record.origin

    def point_gimbal(self, pitch_deg: float, yaw_deg: float) -> None:
        """MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW; pitch up positive, yaw from the nose."""
        self.link.command(
            mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW,
            pitch_deg,
            yaw_deg,
            math.nan,
            math.nan,
        )

    def start_mission(self) -> None:
        """Change to AUTO, which flies the uploaded mission, and clear `record.reached`. The call
        does not wait for the flight.
        """
        self.record.reached.clear()
        self.set_mode("AUTO")
