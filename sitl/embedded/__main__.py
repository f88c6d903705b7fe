"""``python -m sitl.embedded``: run the vehicle until it is stopped, as ArduPilot SITL runs."""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path
from types import FrameType

from sitl.embedded.mavlink.server import MavlinkServer
from sitl.embedded.parameters import Parameters, Px4Parameters, read_parameter_file
from sitl.embedded.vehicle import EmbeddedVehicle
from sitl.errors import VehicleError
from sitl.geodesy import Location

SERIAL_OFFSETS = (0, 2, 3)  # serial0, serial1, serial2 of ArduPilot SITL, from the base port


def _home(text: str) -> tuple[Location, float]:
    try:
        latitude, longitude, altitude, heading = (float(part) for part in text.split(","))
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"expected LAT,LON,ALT_AMSL,HEADING in degrees and metres, got {text!r}"
        ) from error
    if not (-90 <= latitude <= 90 and -180 <= longitude <= 180):
        raise argparse.ArgumentTypeError(f"no place on Earth: {text!r}")
    return Location(latitude, longitude, altitude), heading


def _arguments(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m sitl.embedded", description=__doc__)
    parser.add_argument("--home", type=_home, required=True, metavar="LAT,LON,ALT_AMSL,HEADING")
    parser.add_argument("--port", type=int, default=5760, help="base TCP port (serial0)")
    parser.add_argument("--params", type=Path, action="append", default=[], help=".parm file")
    parser.add_argument("--speedup", type=float, default=1.0, help="simulated s per real s")
    parser.add_argument("--seed", type=int, default=0, help="seed of all sensor noise and gusts")
    parser.add_argument("--px4", action="store_true", help="PX4's interface and aiding")
    return parser.parse_args(argv)


def _stop(_signal: int, _frame: FrameType | None) -> None:
    raise SystemExit(0)


def main(argv: list[str] | None = None) -> int:
    """Run the embedded vehicle until interrupted; a reboot starts it anew. Returns the exit status,
    1 after a `VehicleError`.
    """
    arguments = _arguments(argv)
    home, heading_deg = arguments.home
    try:
        parameters = Px4Parameters() if arguments.px4 else Parameters()
        for path in arguments.params:
            for name, value in read_parameter_file(path).items():
                if not parameters.set(name, value):
                    print(f"{path}: the embedded vehicle has no parameter {name}", file=sys.stderr)
        parameters.set("SIM_SPEEDUP", arguments.speedup)
        system_id = int(parameters["SYSID_THISMAV"])
        ports = tuple(arguments.port + offset for offset in SERIAL_OFFSETS)
        print("compiling kernels, if this is the first start; the ports open then", flush=True)
        _compile(home, type(parameters)())
        while True:
            _run(home, heading_deg, parameters, MavlinkServer(ports, system_id), arguments.seed)
    except VehicleError as error:
        print(error, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 0


def _run(
    home: Location, heading_deg: float, parameters: Parameters, server: MavlinkServer, seed: int
) -> None:
    """Run the vehicle until a reboot is ordered. The parameters outlive the reboot."""
    try:
        vehicle = EmbeddedVehicle(home, heading_deg, parameters, server, seed)
        for number, link in enumerate(server.links):
            port = link.listener.getsockname()[1]
            print(f"SERIAL{number} on TCP port {port}", flush=True)  # as ArduPilot SITL prints
        vehicle.run()
    finally:
        server.close()


def _compile(home: Location, parameters: Parameters) -> None:
    """Run a vehicle briefly without links, so that no client waits for compilation."""
    vehicle = EmbeddedVehicle(home, 0.0, parameters, MavlinkServer((), 1))
    vehicle.aircraft.modes.arm()
    for _ in range(60):
        vehicle.step()


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, _stop)
    sys.exit(main())
