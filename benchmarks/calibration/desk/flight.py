"""A shadow flight of the embedded vehicle, as fast as it can be computed."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from benchmarks.calibration.desk.port import RecordedPort, RecordingServer
from companion.geometry import GimbalAngles, GimbalFrame, Mount
from localizer.geometry.geo import LocalFrame
from localizer.geometry.pose import Array, Pose
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.vehicle.streams import wanted_streams
from sitl.camera.pose_sender import GimbalError
from sitl.camera.true_motion import PoseTrack, TruthSample, camera_pose
from sitl.embedded.control.mode import Mode
from sitl.embedded.parameters import Parameters
from sitl.embedded.physics.dynamics import ATTITUDE, RATES, TICK_S
from sitl.embedded.physics.rotation import euler, wrap_pi
from sitl.embedded.vehicle import EmbeddedVehicle
from sitl.errors import SimulationError
from sitl.geodesy import Location
from sitl.vehicles.launch import GIMBAL, SPEEDS

_READY_S = 120.0  # by then the filter has its position, or something is broken
_TRUTH_TICKS = 2
_REACHED_M = 8.0
_AROUND = 10  # samples to both sides of an exposure


@dataclass(frozen=True)
class Corner:
    """A waypoint: metres from home, and where the gimbal looks on the way there."""

    north_m: float
    east_m: float
    height_m: float
    pitch_deg: float


@dataclass(frozen=True)
class DeskAircraft:
    """How the aircraft really is. mount, gimbal: of the camera; shift_m: east, north, up that the
    map shows the ground beside its true place; speed_m_s, wind_m_s: of the flight.
    """

    mount: Mount
    gimbal: GimbalError
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    speed_m_s: float = 8.0
    wind_m_s: float = 4.0


@dataclass(frozen=True)
class DeskFlightRecord:
    """What is left of it. samples: the camera's true poses in the map's ENU, every 20 ms; begin_ns,
    end_ns: of the flight above `low_m`, on the companion's clock. ekf_off_m: mean east, north, up
    of the EKF from the truth meanwhile; ekf_yaw_off_rad: mean of its heading's error.
    """

    samples: tuple[tuple[int, Pose], ...]
    begin_ns: int
    end_ns: int
    ekf_off_m: Array
    ekf_yaw_off_rad: float

    def track(self, time_ns: int) -> PoseTrack:
        """The true motion about a time."""
        at = bisect_left(self.samples, time_ns, key=lambda sample: sample[0])
        return PoseTrack(self.samples[max(at - _AROUND, 0) : at + _AROUND])


class DeskFlight:
    """One flight, stepped. frame, geoid_m: the map's."""

    def __init__(
        self, home: Location, aircraft: DeskAircraft, recorded: RecordedPort, frame: LocalFrame,
        geoid_m: float, seed: int,
    ) -> None:  # fmt: skip
        self._server = RecordingServer(recorded)
        parameters = Parameters(
            GIMBAL | SPEEDS
            | {
                "WPNAV_SPEED": 100 * aircraft.speed_m_s, "SIM_WIND_SPD": aircraft.wind_m_s,
                "SIM_WIND_TURB": 0.3 * aircraft.wind_m_s, "SIM_WIND_DIR": float(37 * seed % 360),
            }
        )  # fmt: skip
        self._vehicle = EmbeddedVehicle(home, 30.0, parameters, self._server, seed)
        bridge = BridgeConfig(connection="udpin:127.0.0.1:0")
        for stream in wanted_streams(bridge, "ardupilotmega"):
            self._server.links[0].set_interval(stream.message_id, 1.0 / stream.rate_hz)
        self._server.links[0].set_interval(mavlink.MAVLINK_MSG_ID_HEARTBEAT, 1.0)
        self._aircraft, self._recorded = aircraft, recorded
        self._frame, self._geoid_m = frame, geoid_m
        self._samples: list[tuple[int, Pose]] = []
        self._off: list[tuple[int, Array]] = []

    def fly(self, corners: tuple[Corner, ...], low_m: float, longest_s: float) -> DeskFlightRecord:
        """Take off, and fly from corner to corner for at most so long."""
        try:
            return self._flown(corners, low_m, longest_s)
        finally:
            self._server.close()

    def _flown(
        self, corners: tuple[Corner, ...], low_m: float, longest_s: float
    ) -> DeskFlightRecord:
        modes, aircraft = self._vehicle.aircraft.modes, self._vehicle.aircraft
        while not aircraft.estimator.position_valid or modes.home is None:
            self._step()
            if aircraft.time_s > _READY_S:
                raise SimulationError(f"the embedded vehicle has no position after {_READY_S:g} s")
        for _ in range(round(5.0 / TICK_S)):
            self._step()
        aircraft.gimbal.point(corners[0].pitch_deg, 0.0, yaw_locked=False)
        if not modes.set_mode(Mode.GUIDED):
            raise SimulationError("the embedded vehicle refuses GUIDED")
        modes.arm()
        modes.takeoff(corners[0].height_m)
        begin_ns = 0
        started_s = aircraft.time_s
        while -aircraft.truth[2] < 0.93 * corners[0].height_m:
            self._step()
            if begin_ns == 0 and -aircraft.truth[2] > low_m:
                begin_ns, started_s = self._recorded.now_ns, aircraft.time_s
        for corner in corners:
            aircraft.gimbal.point(corner.pitch_deg, 0.0, yaw_locked=False)
            target = (corner.north_m, corner.east_m, -corner.height_m)
            modes.go_to_local(target)
            while np.linalg.norm(aircraft.truth[:3] - target) > _REACHED_M:
                self._step()
                if aircraft.time_s - started_s > longest_s:
                    return self._result(begin_ns)
        return self._result(begin_ns)

    def _result(self, begin_ns: int) -> DeskFlightRecord:
        end_ns = self._recorded.now_ns
        off = np.array([o for t, o in self._off if begin_ns <= t <= end_ns]).mean(axis=0)
        for _ in range(round(1.0 / TICK_S)):
            self._step()
        return DeskFlightRecord(tuple(self._samples), begin_ns, end_ns, off[:3], float(off[3]))

    def _step(self) -> None:
        self._recorded.tick()
        self._vehicle.step()
        if self._vehicle.aircraft.tick % _TRUTH_TICKS == 0:
            self._samples.append((self._recorded.now_ns, self._camera()))
            self._off.append((self._recorded.now_ns, self._ekf_off()))

    def _ekf_off(self) -> Array:
        """East, north, up, metres, and heading, rad, of the EKF less the truth."""
        a = self._vehicle.aircraft
        where = a.estimator.location
        n, e, d = (0.0, 0.0, 0.0) if where is None else a.true_location.ned_of(where)
        said, true = (euler(q)[2] for q in (a.estimator.output[0:4], a.truth[ATTITUDE:RATES]))
        return np.array([e, n, -d, wrap_pi(said - true)])

    def _camera(self) -> Pose:
        a = self._vehicle.aircraft
        here = a.true_location
        enu = self._frame.enu_from_geodetic(
            here.latitude_deg, here.longitude_deg, here.altitude_m + self._geoid_m
        )
        reported = GimbalAngles(
            a.gimbal.roll_rad, a.gimbal.pitch_rad, a.gimbal.yaw_rad, GimbalFrame.HEADING
        )
        now_ns = self._recorded.now_ns
        angles = self._aircraft.gimbal.true_angles(reported, now_ns)
        body: Array = np.array(a.truth[ATTITUDE:RATES])
        sample = TruthSample(now_ns, np.asarray(enu) + self._aircraft.shift_m, body, angles)
        return camera_pose(sample, self._frame, self._aircraft.mount)
