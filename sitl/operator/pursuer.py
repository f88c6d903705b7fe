"""A flight that follows a car, which the operator clicks once, and the car on its road.

Under each roof the car is hidden for about two seconds. The aircraft stays above and behind it.
"""

from __future__ import annotations

import csv
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from localizer.geometry.camera import Camera
from localizer.geometry.geo import LocalFrame
from localizer.geometry.pose import Array, Pose, matrix_from_quaternion
from localizer.map.cache.cache import TileCache
from localizer.map.cache.tile import TileMesh, build_mips
from localizer.synth.tiles.vegetation import CAR_COLOURS, CAR_LENGTH_M, car_mesh
from localizer.synth.world import WorldInfo
from sitl.camera.movers import Mover, round_trip
from sitl.camera.world_camera import FRAME_COLUMNS
from sitl.demo.assets import FlightAssets
from sitl.errors import SimulationError
from sitl.ground.link import Connection
from sitl.ground.pilot import Pilot
from sitl.vehicles.process import VehicleProcess

CAR = "followed car"
SPEED_MPS = 6.0
_HIDDEN_S = 2.0
_ROOF_HEIGHT_M, _ROOF_WIDTH_M = 5.0, 9.0
_ROOFS_AFTER_S = (18.0, 40.0)  # from the place where it is clicked
_AHEAD_M = 60.0  # of road that is left behind the last roof
_OTHER_LANE_M = 4.4


@dataclass(frozen=True)
class Chase:
    """A car and the roofs that hide it. begin_m: path position at which it is clicked."""

    car: Mover
    roofs: tuple[Mover, ...]
    begin_m: float

    @property
    def movers(self) -> tuple[Mover, ...]:
        """Objects to draw in addition to the world's traffic."""
        return (self.car, *self.roofs)

    def hidden_ns(self) -> tuple[tuple[int, int], ...]:
        """Time spans (CLOCK_MONOTONIC) in which the car's centre is below a roof."""
        half = 0.5 * _roof_length()
        spans = []
        for after_s in _ROOFS_AFTER_S:
            middle = after_s * SPEED_MPS + self.begin_m - self.car.phase_m
            begin, end = ((middle + d) / SPEED_MPS * 1e9 for d in (-half, half))
            spans.append((self.car.epoch_ns + round(begin), self.car.epoch_ns + round(end)))
        return tuple(spans)

    def begins_ns(self) -> int:
        """CLOCK_MONOTONIC time at which the car is where it is clicked."""
        return self.car.epoch_ns + round((self.begin_m - self.car.phase_m) / SPEED_MPS * 1e9)


def make_chase(
    world: WorldInfo, frame: LocalFrame, epoch_ns: int, lead_s: float, seed: int = 0
) -> Chase:
    """Choose the road nearest to home that is long enough. frame: the map's ENU. The car reaches
    its begin_m lead_s after epoch_ns. Raises `SimulationError` if no road is long enough.
    """
    needed = _ROOFS_AFTER_S[-1] * SPEED_MPS + 0.5 * _roof_length() + _AHEAD_M
    frame_from_world = frame.ecef_from_enu.inverse @ world.frame.ecef_from_enu
    best: tuple[float, Array, float] | None = None
    for lane in world.roads:
        path = round_trip(lane, 0.0, _OTHER_LANE_M)
        path[:, 2] = world.ground_height(path[:, 0], path[:, 1])
        path = frame_from_world.apply(path)
        steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        one_way = float(along[len(lane) - 1])
        for start in np.arange(20.0, one_way - needed - 20.0, 20.0):
            place = np.array([np.interp(start, along, path[:, k]) for k in range(2)])
            away = float(np.hypot(*place))
            if best is None or away < best[0]:
                best = (away, path, float(start))
    if best is None:
        raise SimulationError(f"no road of {needed:.0f} m in this world")
    _, path, start = best
    rng = np.random.default_rng([seed, 97])
    mesh = car_mesh(CAR_COLOURS[int(rng.integers(len(CAR_COLOURS)))], seed=seed)
    car = Mover(CAR, path, SPEED_MPS, start - lead_s * SPEED_MPS, mesh, epoch_ns)
    roofs = tuple(
        Mover(f"roof {k}", path, 0.0, start + s * SPEED_MPS, _roof(seed + k), epoch_ns)
        for k, s in enumerate(_ROOFS_AFTER_S)
    )
    return Chase(car, roofs, start)


def pursuit(car: Mover, time_ns: int, height_m: float, behind_m: float) -> Array:
    """Desired aircraft position (3,), map ENU: above and behind the car."""
    velocity = car.velocity_at(time_ns)
    ahead = velocity / max(float(np.linalg.norm(velocity)), 1e-9)
    place: Array = car.position_at(time_ns) - behind_m * ahead
    place[2] += height_m
    return place


def _roof_length() -> float:
    """Length (m) at which the whole car is below the roof for the wanted time."""
    return _HIDDEN_S * SPEED_MPS + CAR_LENGTH_M


def _roof(seed: int) -> TileMesh:
    """A flat roof along x, as a tarpaulin over a market street."""
    half_l, half_w = 0.5 * _roof_length(), 0.5 * _ROOF_WIDTH_M
    corners = [(-1, -1), (1, -1), (-1, 1), (1, 1)]
    positions = np.array([[a * half_l, b * half_w, _ROOF_HEIGHT_M] for a, b in corners], np.float32)
    uv = np.array([[(a + 1) / 2, (b + 1) / 2] for a, b in corners], np.float32)
    rng = np.random.default_rng([seed, 101])
    cells = rng.uniform(90, 200, (8, 16, 1)) * np.ones(3)
    texture = np.kron(cells, np.ones((8, 8, 1))) + rng.normal(0, 6, (64, 128, 3))
    image = np.clip(texture, 0, 255).astype(np.uint8)
    triangles = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
    return TileMesh(positions, uv, triangles, build_mips(image), Pose.identity())


_CAMERA = 100
_CONNECTED_S = 30.0
_HEARTBEAT_NS = 500_000_000
_ANSWER_NS = 1_500_000_000
_TRIES = 4


class Station:
    """A MAVLink client in the caller's thread. It connects when it is made; `PilotError` if nothing
    listens for 30 s. alive: as of `GroundLink`.
    """

    def __init__(self, endpoint: str, alive: Callable[[], None] = lambda: None) -> None:
        self._link = Connection(endpoint)
        self._link.open(time.monotonic() + _CONNECTED_S, alive)
        self._ack: Any = None
        self._beat_ns = 0

    def close(self) -> None:
        """Disconnect."""
        self._link.close()

    def run_until(self, done: Callable[[], bool], until_ns: int) -> bool:
        """Receive until `done` holds (True) or a CLOCK_MONOTONIC time is reached (False)."""
        while not done():
            now_ns = time.monotonic_ns()
            if now_ns >= until_ns:
                return False
            if now_ns - self._beat_ns >= _HEARTBEAT_NS:
                self._beat_ns = now_ns
                self._link.send_heartbeat()
            for message in self._link.receive():
                if message.get_srcComponent() == _CAMERA and message.get_type() == "COMMAND_ACK":
                    self._ack = message
        return True

    def track(self, x: float, y: float) -> tuple[int | None, int]:
        """Send MAV_CMD_CAMERA_TRACK_POINT for an image point, 0 to 1, until it is answered. Returns
        (MAV_RESULT or None, the target's number).
        """
        command = mavlink.MAV_CMD_CAMERA_TRACK_POINT
        for attempt in range(_TRIES):
            self._ack = None
            self._link.send(
                mavlink.MAVLink_command_long_message(1, _CAMERA, command, attempt, x, y, *[0.0] * 5)
            )
            self.run_until(lambda: self._is_answer(command), time.monotonic_ns() + _ANSWER_NS)
            if self._is_answer(command):
                return int(self._ack.result), int(self._ack.result_param2)
        return None, 0

    def _is_answer(self, command: int) -> bool:
        return self._ack is not None and self._ack.command == command


FOLLOWED_S = 60.0
LATE_S, LATE_SIGMA_S = 0.25, 0.03  # exposure to click, of a link whose delay was measured
LEAD_S = 110.0  # from the world's beginning to the click: take-off and shadow flight need 40 to 100
SECONDS = LEAD_S - 30.0 + FOLLOWED_S + 3.0
_STEER_NS = 400_000_000
_AHEAD_NS = 1_500_000_000  # by what a multirotor lags behind the place that it is sent to
_BEHIND_M = 12.0
_HAND_PX = 1.5
_CAR_TOP_M = 0.75


class _FrameLog:
    """Reads the world camera's growing log: true exposure time and camera pose of each frame."""

    def __init__(self, path: Path) -> None:
        self._file = path.open(newline="", encoding="utf-8")
        self._rest = ""
        self._rows: list[dict[str, str]] = []

    def close(self) -> None:
        self._file.close()

    def newest(self) -> tuple[int, Pose]:
        """(true exposure time ns, true camera pose) of the newest frame; RuntimeError if none."""
        lines = (self._rest + self._file.read()).split("\n")
        self._rest = lines.pop()
        self._rows = [*self._rows, *csv.DictReader(lines, FRAME_COLUMNS)][-1:]
        if not self._rows or self._rows[0]["sequence"] == "sequence":
            raise RuntimeError("no picture has been taken yet")
        row = self._rows[0]
        q = np.array([float(row[k]) for k in ("qw", "qx", "qy", "qz")])
        eye = np.array([float(row[k]) for k in ("east_m", "north_m", "up_m")])
        return int(row["true_time_ns"]), Pose(matrix_from_quaternion(q), eye)


class Pursuer:
    """A `FlightParticipant`: steers the aircraft above a car, and clicks the car once. camera: the
    true one; seed: of car and click.
    """

    def __init__(self, assets: FlightAssets, camera: Camera, height_m: float, seed: int) -> None:
        self._assets, self._camera, self._height_m = assets, camera, height_m
        self._frame: LocalFrame = TileCache.open(assets.map_cache).frame
        self._seed = seed
        self._stop = threading.Event()
        self.chase: Chase | None = None
        self.number = 0
        self.failure = ""
        self.end_ns = 0
        self.late_s = 0.0

    def movers(self, epoch_ns: int) -> tuple[Mover, ...]:
        """The car and the roofs that hide it; sets `chase`, which `take_part` needs."""
        self.chase = make_chase(self._assets.world, self._frame, epoch_ns, LEAD_S, self._seed)
        return self.chase.movers

    @contextmanager
    def take_part(self, vehicle: VehicleProcess, pilot: Pilot, frames: Path) -> Iterator[None]:
        """Context manager: follow the car and click it in a thread; its errors go to `failure`.
        frames: the world camera's log.
        """
        arguments = (vehicle, pilot, frames)
        thread = threading.Thread(target=self._run, args=arguments, name="pursuer")
        thread.start()
        try:
            yield
        finally:
            self._stop.set()
            thread.join()

    def _run(self, vehicle: VehicleProcess, pilot: Pilot, frames: Path) -> None:
        try:
            with closing(Station(vehicle.spare_endpoint, vehicle.check)) as station:
                self._follow(pilot, frames, station)
        except Exception as error:  # told by the verdict: a dead pursuer is no passed flight
            self.failure = f"{type(error).__name__}: {error}"

    def _follow(self, pilot: Pilot, frames: Path, station: Station) -> None:
        chase = self.chase
        assert chase is not None
        begin_ns = chase.begins_ns()
        self.end_ns = begin_ns + round(FOLLOWED_S * 1e9)
        if time.monotonic_ns() > begin_ns:
            raise RuntimeError("the car had gone by before the aircraft was ready")
        with closing(_FrameLog(frames)) as pictures:
            if self._fly_along(pilot, station, chase, begin_ns - _STEER_NS):
                return
            pictures.newest()  # what there is so far is read before it counts
            if station.run_until(self._stop.is_set, begin_ns):
                return
            self._click(station, chase, *pictures.newest())
        self._fly_along(pilot, station, chase, self.end_ns)

    def _fly_along(self, pilot: Pilot, station: Station, chase: Chase, until_ns: int) -> bool:
        """Steer above the car until until_ns; True if the flight ended before that time."""
        home_m = self._home_up_m()
        while time.monotonic_ns() < until_ns:
            ahead_ns = time.monotonic_ns() + _AHEAD_NS
            # Until the car comes, the aircraft waits where it will be met.
            place = pursuit(chase.car, max(ahead_ns, chase.begins_ns()), self._height_m, _BEHIND_M)
            latitude, longitude, _ = self._frame.geodetic_from_enu(place)
            pilot.go_to(float(latitude), float(longitude), float(place[2]) - home_m)
            if station.run_until(self._stop.is_set, min(time.monotonic_ns() + _STEER_NS, until_ns)):
                return True
        return False

    def _home_up_m(self) -> float:
        ground = float(self._assets.world.ground_height(0.0, 0.0))
        world = self._assets.world
        frame_from_world = self._frame.ecef_from_enu.inverse @ world.frame.ecef_from_enu
        return float(frame_from_world.apply(np.array([0.0, 0.0, ground]))[2])

    def _click(self, station: Station, chase: Chase, frame_ns: int, pose: Pose) -> None:
        """Click on the car in the newest frame, after the operator's reaction time."""
        top: Array = chase.car.position_at(frame_ns) + np.array([0.0, 0.0, _CAR_TOP_M])
        pixel, inside = self._camera.project(pose.inverse.apply(top))
        size = np.array([self._camera.width, self._camera.height])
        if not bool(inside) or (pixel < 0).any() or (pixel > size).any():
            raise RuntimeError("the car is not in the picture when it is clicked at")
        hand = np.random.default_rng([self._seed, 103]).normal(0.0, _HAND_PX, 2)
        time.sleep(max(LATE_S - (time.monotonic_ns() - frame_ns) * 1e-9, 0.0))
        self.late_s = (time.monotonic_ns() - frame_ns) * 1e-9
        x, y = (np.asarray(pixel) + hand) / size
        result, self.number = station.track(float(x), float(y))
        if result != 0:
            raise RuntimeError(f"the click was answered by {result}")
