"""Where the camera can be since it was last seen, by a simulated IMU."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from companion.flight.reachable_region import ReachableRegion
from companion.inertial import InertialTrack
from localizer.geometry.pose import Pose
from localizer.types import TrackingState
from mavlink_bridge.messages import Attitude, InertialSample, VehicleState

S = 1_000_000_000
LEVEL = (1.0, 0.0, 0.0, 0.0)


class Flying:
    """Level, flying north at 6 m/s, and braking from `brakes_s` on; the IMU is read at 50 Hz."""

    def __init__(self, brakes_s=1e9, hole=(1e9, 1e9)):
        self.now_s = 0.0
        self._brakes_s, self._hole = brakes_s, hole
        self._samples = []

    def state(self):
        return replace(VehicleState(), local_velocity_ned=(6.0, 0.0, 0.0))

    def attitude_at(self, time_ns):
        return Attitude(time_ns, 0.0, 0.0, 0.0, LEVEL)

    def inertial_since(self, time_ns):
        return tuple(s for s in self._samples if s.time_ns > time_ns)

    def until(self, end_s, reach=None):
        while self.now_s < end_s:
            self.now_s += 0.02
            braking = self._brakes_s <= self.now_s < self._brakes_s + 3.0
            if not self._hole[0] <= self.now_s < self._hole[1]:
                force = (-2.0 if braking else 0.0, 0.0, -9.80665)
                t = round(self.now_s * S)
                self._samples.append(InertialSample(t, force, (0.0, 0.0, 0.0)))
            if reach is not None and round(self.now_s * 50) % 5 == 0:
                reach.follow()
                self._samples = self._samples[-100:]


def _estimate(time_ns, east, north, state=TrackingState.TRACKING):
    pose = Pose(np.eye(3), np.array([east, north, 60.0]))
    return SimpleNamespace(
        accepted=True, state=state, exposure_time_ns=time_ns, world_from_camera=pose
    )


def _seen_at_two(vehicle):
    reach = ReachableRegion(vehicle, InertialTrack())
    vehicle.until(2.0, reach)
    reach.add_estimate(_estimate(round(1.8 * S), 100.0, -50.0), None)
    return reach


def test_nothing_is_known_before_a_place_was_seen():
    reach = ReachableRegion(Flying(), InertialTrack())
    assert reach.region(5 * S) is None
    reach.add_estimate(_estimate(S, 0.0, 0.0, TrackingState.BRIDGING), None)
    assert reach.region(5 * S) is None


def test_the_imu_carries_the_place_through_a_brake():
    vehicle = Flying(brakes_s=4.0)
    reach = _seen_at_two(vehicle)
    vehicle.until(14.0, reach)
    region = reach.region(14 * S)
    # 2.2 s at 6 m/s, 3 s of braking to a stand.
    assert region.centre == pytest.approx([100.0, -50.0 + 13.2 + 9.0], abs=1.5)
    radius = float(np.sqrt(region.shape[0, 0]))
    assert 15.0 < radius < 60.0


def test_a_hole_in_the_imus_record_leaves_what_can_be_flown():
    vehicle = Flying(hole=(6.0, 8.0))
    reach = _seen_at_two(vehicle)
    vehicle.until(14.0, reach)
    region = reach.region(14 * S)
    assert region.centre == pytest.approx([100.0, -50.0])
    assert region.contains(np.array([100.0, -50.0 + 6.0 * 12.2]))


def test_it_grows_until_it_holds_the_map():
    vehicle = Flying()
    reach = _seen_at_two(vehicle)
    vehicle.until(60.0, reach)
    radii = [float(np.sqrt(reach.region(t * S).shape[0, 0])) for t in (61, 120, 600)]
    assert radii == sorted(radii)
    assert radii[-1] > 1000.0
