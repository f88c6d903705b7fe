"""The whole vehicle: the aircraft and its MAVLink, in one thread and simulated time."""

from __future__ import annotations

import time

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.embedded.aircraft import GPS_SIMULATED, Aircraft
from sitl.embedded.control.loop import advance
from sitl.embedded.mavlink.commands import Commands
from sitl.embedded.mavlink.server import MavlinkServer
from sitl.embedded.mavlink.telemetry import DEFAULT_STREAMS, Telemetry
from sitl.embedded.parameters import Parameters
from sitl.embedded.physics.dynamics import TICK_S
from sitl.embedded.physics.rotation import euler
from sitl.geodesy import Location

_MAX_LAG_S = 0.25  # of wall time behind schedule after which the schedule starts anew


class Vehicle(Aircraft):
    """An aircraft that streams, answers commands, and keeps time."""

    def __init__(
        self,
        home: Location,
        heading_deg: float,
        parameters: Parameters,
        server: MavlinkServer,
        seed: int = 0,
    ) -> None:
        super().__init__(home, heading_deg, parameters, server, seed)
        self.telemetry = Telemetry(self)
        self.commands = Commands(self, self.telemetry)
        self._announced = (False, False)
        for link in server.links:
            for message_id, hertz in DEFAULT_STREAMS.items():
                link.set_interval(message_id, 1.0 / hertz)

    def run(self) -> None:
        """Run at SIM_SPEEDUP times real time until a reboot is ordered."""
        schedule = time.monotonic()
        while not self.reboot_ordered:
            self.step()
            schedule += TICK_S / max(self.parameters["SIM_SPEEDUP"], 0.1)
            now = time.monotonic()
            if schedule > now:
                time.sleep(schedule - now)
            elif now - schedule > _MAX_LAG_S:
                schedule = now  # too slow a machine: simulated time falls behind, it never jumps

    def step(self) -> None:
        """One 10 ms tick: inputs, sensors, estimator, control, physics, outputs."""
        simulated = self.parameters["GPS1_TYPE"] in GPS_SIMULATED
        self.injection.receiver_has_fix = simulated and self.gps_has_fix
        for link, message in self.server.poll():
            self.commands.handle(link, message)
        self.tick += 1
        target = self.modes.update(self.time_s)
        advance(
            self.truth,
            self.estimator.output,
            target,
            self._integrator,
            self.wind(),
            self.sensors.imu_bias,
            self.sensors.imu_noise(),
            self._increment,
            self.modes.armed,
        )
        self.modes.on_ground = bool(self.truth[2] >= 0.0)
        self.sense()
        self.estimator.update(self._increment, self.time_ms)
        vehicle_yaw = euler(self.estimator.output[0:4])[2]
        self.gimbal.update(self.estimator.location, vehicle_yaw, TICK_S)
        if self.tick % 10 == 0:
            self.modes.check_ekf()
        if self.tick % 3000 == 0 and not self.modes.armed:
            self.report_failures("PreArm")
        self._announce()
        self.telemetry.stream()
        self.server.flush()

    def _announce(self) -> None:
        """What ArduPilot sends unasked: origin and home when they are set, TIMESYNC every 10 s."""
        if self.tick % 1000 == 0:
            self.server.broadcast(mavlink.MAVLink_timesync_message(0, self.time_ms * 1_000_000))
        known = (self.estimator.origin is not None, self.modes.home is not None)
        if known != self._announced:
            self._announced = known
            for message_id in (
                mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
                mavlink.MAVLINK_MSG_ID_HOME_POSITION,
            ):
                message = self.telemetry.message(message_id)
                if message is not None:
                    self.server.broadcast(message)
