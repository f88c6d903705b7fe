"""The complete simulated vehicle: aircraft and MAVLink in one thread, in simulated time."""

from __future__ import annotations

import time

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.embedded.aircraft import Aircraft
from sitl.embedded.mavlink.commands import Commands
from sitl.embedded.mavlink.px4_dialect import Px4Commands, Px4Telemetry
from sitl.embedded.mavlink.server import MavlinkServer
from sitl.embedded.mavlink.telemetry import DEFAULT_STREAMS, TelemetryBuilder
from sitl.embedded.parameters import Parameters
from sitl.embedded.physics.dynamics import TICK_S
from sitl.geodesy import Location

_MAX_LAG_S = 0.25  # of wall time behind schedule after which the schedule starts anew


class EmbeddedVehicle:
    """Runs an aircraft with its telemetry and commands in simulated time."""

    def __init__(
        self,
        home: Location,
        heading_deg: float,
        parameters: Parameters,
        server: MavlinkServer,
        seed: int = 0,
    ) -> None:
        self.aircraft = Aircraft(home, heading_deg, parameters, server, seed)
        px4 = parameters.is_px4
        self._sync_ticks = 10 if px4 else 1000
        self.telemetry = (Px4Telemetry if px4 else TelemetryBuilder)(self.aircraft)
        self.commands = (Px4Commands if px4 else Commands)(self.aircraft, self.telemetry)
        self._server = server
        self._announced = (False, False)
        for link in server.links:
            for message_id, hertz in DEFAULT_STREAMS.items():
                link.set_interval(message_id, 1.0 / hertz)

    def run(self) -> None:
        """Run at SIM_SPEEDUP times real time until a reboot command."""
        schedule = time.monotonic()
        while not self.aircraft.reboot_ordered:
            self.step()
            schedule += TICK_S / max(self.aircraft.parameters["SIM_SPEEDUP"], 0.1)
            now = time.monotonic()
            if schedule > now:
                time.sleep(schedule - now)
            elif now - schedule > _MAX_LAG_S:
                schedule = now  # too slow a machine: simulated time falls behind, it never jumps

    def step(self) -> None:
        """One 10 ms tick: inputs, sensors, estimator, control, physics, outputs."""
        aircraft = self.aircraft
        aircraft.begin_tick()
        for link, message in self._server.poll():
            self.commands.handle(link, message)
        aircraft.step()
        self._announce()
        self.telemetry.stream()
        self._server.flush()

    def _announce(self) -> None:
        """Broadcast origin and home once set, and TIMESYNC every 10 s (PX4: ten times a second)."""
        aircraft, server = self.aircraft, self._server
        if aircraft.tick % self._sync_ticks == 0:
            server.broadcast(mavlink.MAVLink_timesync_message(0, aircraft.time_ms * 1_000_000))
        known = (aircraft.estimator.origin is not None, aircraft.modes.home is not None)
        if known != self._announced:
            self._announced = known
            for message_id in (
                mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
                mavlink.MAVLINK_MSG_ID_HOME_POSITION,
            ):
                message = self.telemetry.message(message_id)
                if message is not None:
                    server.broadcast(message)
