"""The scripted ground station flies PX4's interface, by PX4's modes, altitudes and commands."""

from __future__ import annotations

from sitl.geodesy import Location
from sitl.ground.pilot import Pilot
from sitl.vehicles.launch import SPEEDS, EmbeddedSitl

HOME = Location(47.397742, 8.545594, 488.0)


def test_the_pilot_takes_off_flies_and_lands() -> None:
    with (
        EmbeddedSitl(HOME, parameters=SPEEDS, speedup=10.0, px4=True) as vehicle,
        Pilot(vehicle.gcs_endpoint, 10.0, vehicle.check) as pilot,
    ):
        pilot.wait_ready()
        assert pilot.record.is_px4
        pilot.arm()
        pilot.takeoff(20.0)
        where = HOME.offset(30.0, 0.0, 0.0)
        pilot.go_to(where.latitude_deg, where.longitude_deg, 20.0)

        def there() -> bool:
            north, _, down = HOME.ned_of(pilot.record.truth.location)
            return abs(north - 30.0) < 3.0 and abs(down + 20.0) < 3.0

        pilot.link.wait(there, 60.0, "30 m north, 20 m up")
        assert pilot.record.mode == "GUIDED"
        pilot.land()
