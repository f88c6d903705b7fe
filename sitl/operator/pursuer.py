"""A flight that follows a car: the aircraft follows it, and the operator clicks it once."""

from __future__ import annotations

import csv
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np

from localizer.geometry.camera import Camera
from localizer.geometry.geo import LocalFrame
from localizer.geometry.pose import Array, Pose, matrix_from_quaternion
from localizer.map.cache.cache import TileCache
from sitl.camera.movers import Mover
from sitl.camera.world_camera import FRAME_COLUMNS
from sitl.demo.assets import FlightAssets
from sitl.ground.pilot import Pilot
from sitl.operator.chase import Chase, make_chase, pursuit
from sitl.operator.station import Station
from sitl.vehicles.process import VehicleProcess

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
