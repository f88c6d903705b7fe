"""The PX4 interface: its bytes and numbers, and what its sources of position do to each other."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.embedded.control.mode import Mode
from sitl.embedded.parameters import Px4Parameters
from sitl.embedded.physics.rotation import quaternion
from sitl.geodesy import Location

HOME = Location(47.397742, 8.545594, 488.0)
AUXILIARY = {"EKF2_AGP0_ID": 1, "EKF2_AGP0_CTRL": 1, "SIM_GPS1_ENABLE": 0}
ODOMETRY = {"EKF2_EV_CTRL": 5, "SIM_GPS1_ENABLE": 0}


class Link:
    """A link to nobody."""

    name = "serial1"

    def __init__(self) -> None:
        self.sent: list[Any] = []

    def send(self, message: Any) -> None:
        self.sent.append(message)


class Companion:
    """Sends true positions, 30 Hz and 80 ms late, dated by a clock of its own."""

    AHEAD_US = 5_000_000_000

    def __init__(self, bench: Any, kind: str, sensor_id: int = 1) -> None:
        self.bench, self.kind, self.sensor_id = bench, kind, sensor_id
        self.on, self.offset_north, self.reset_counter = True, 0.0, 0
        self.link, self._rng = Link(), np.random.default_rng(3)
        self._queue: list[tuple[int, Any]] = []
        bench.each_tick.append(self)

    def __call__(self) -> None:
        v = self.bench.vehicle
        handle = self.bench.whole.commands.handle
        if v.tick % 10 == 0:
            now_ns = v.time_ms * 1_000_000
            remote_ns = now_ns + self.AHEAD_US * 1000
            handle(self.link, mavlink.MAVLink_timesync_message(remote_ns, now_ns))
        if self.on and v.tick % 3 == 0:
            self._queue.append((v.tick + 8, self._message(v)))
        while self._queue and self._queue[0][0] <= v.tick:
            handle(self.link, self._queue.pop(0)[1])

    def _message(self, v: Any) -> Any:
        noise = self._rng.normal(0, 0.3, 2)
        where = v.true_location.offset(self.offset_north + noise[0], noise[1], 0.0)
        stamp = v.time_ms * 1000 + self.AHEAD_US
        if self.kind == "auxiliary":
            return mavlink.MAVLink_global_position_sensor_message(
                0, 0, self.sensor_id, stamp + 80_000, 80_000, 2, 0,
                round(where.latitude_deg * 1e7), round(where.longitude_deg * 1e7),
                where.altitude_m + 47.0, where.altitude_m, 0.5, 1.0,
            )  # fmt: skip
        ned = (v.estimator.origin or HOME).ned_of(where)
        covariance = [0.0] * 21
        covariance[0] = covariance[6] = covariance[11] = 0.25
        q = [float(c) for c in quaternion(0.0, 0.0, 0.0)]
        return mavlink.MAVLink_odometry_message(
            stamp, 1, 12, *ned, q, *[math.nan] * 6, covariance, [math.nan] * 21,
            self.reset_counter, 2, 90,
        )  # fmt: skip


@pytest.fixture
def px4(bench: Callable[..., Any]) -> Callable[[dict[str, float]], Any]:
    def made(parameters: dict[str, float]) -> Any:
        it = bench(parameters, px4=True)
        if "EKF2_EV_CTRL" in parameters and parameters.get("SIM_GPS1_ENABLE") == 0:
            it.vehicle.estimator.set_origin(HOME)
        return it

    return made


def test_integers_travel_as_bytes() -> None:
    table = Px4Parameters()
    raw = struct.unpack("<f", struct.pack("<i", 5))[0]
    assert table.decode_value("EKF2_EV_CTRL", raw) == 5.0
    table.set("EKF2_EV_CTRL", 5)
    assert struct.pack("<f", table.encode_value("EKF2_EV_CTRL")) == struct.pack("<i", 5)
    assert "EK3_SRC1_POSXY" not in table
    assert "VISO_TYPE" not in list(table)


def test_says_that_it_is_px4(px4: Any) -> None:
    it = px4(AUXILIARY)
    heartbeat = it.whole.telemetry.message(mavlink.MAVLINK_MSG_ID_HEARTBEAT)
    assert (heartbeat.autopilot, heartbeat.custom_mode) == (12, 7 << 16)
    assert it.whole.telemetry.message(mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT) is None
    assert it.whole.telemetry.message(mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS) is not None


@pytest.mark.parametrize(("kind", "parameters"), [("auxiliary", AUXILIARY), ("odometry", ODOMETRY)])
def test_flies_and_descends_when_positions_end(
    px4: Any, kind: str, parameters: dict[str, float]
) -> None:
    it = px4(parameters)
    feed = Companion(it, kind)
    it.take_off()
    it.go(40.0, 0.0, 30.0)
    assert np.max(it.errors(10.0)) < 2.0
    feed.on, ended_s = False, it.vehicle.time_s
    assert it.run(20, lambda: it.vehicle.modes.mode is Mode.LAND)
    assert 4.0 < it.vehicle.time_s - ended_s < 6.5
    assert it.said("Failsafe activated")


def test_another_id_is_not_heard(px4: Any) -> None:
    it = px4(AUXILIARY)
    Companion(it, "auxiliary", sensor_id=2)
    it.run(30.0)
    assert it.failures()


def test_wrong_gnss_is_kept_out_by_the_auxiliary_position(px4: Any) -> None:
    it = px4({**AUXILIARY, "SIM_GPS1_ENABLE": 1})
    Companion(it, "auxiliary")
    it.take_off()
    it.vehicle.parameters.set("SIM_GPS1_ENABLE", 0)
    it.run(8.0)
    it.vehicle.parameters.set("SIM_GPS1_GLTCH_X", 0.0027)
    it.vehicle.parameters.set("SIM_GPS1_ENABLE", 1)
    assert np.max(it.errors(30.0)) < 3.0


def test_odometry_jumps_when_announced_and_the_auxiliary_position_after_5_s(px4: Any) -> None:
    it = px4(ODOMETRY)
    feed = Companion(it, "odometry")
    it.take_off()
    feed.offset_north, feed.reset_counter = 20.0, 1
    it.run(1.0)
    assert 17.0 < it.ekf_error() < 23.0
    it = px4(AUXILIARY)
    feed = Companion(it, "auxiliary")
    it.take_off()
    feed.offset_north = 20.0
    it.run(4.0)
    assert it.ekf_error() < 3.0
    it.run(2.5)
    assert 17.0 < it.ekf_error() < 23.0


def test_odometry_keeps_the_offset_of_gnss_that_it_was_fused_with(px4: Any) -> None:
    it = px4({**ODOMETRY, "SIM_GPS1_ENABLE": 1})
    feed = Companion(it, "odometry")
    it.take_off()
    feed.offset_north = 15.0
    it.run(10.0)
    assert it.ekf_error() < 3.0
    it.vehicle.parameters.set("SIM_GPS1_ENABLE", 0)
    it.run(15.0)
    assert it.ekf_error() < 4.0
    assert it.vehicle.estimator.position_valid
