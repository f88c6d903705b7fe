"""Every number that the monitor and the priors take from the vehicle, set to what is none.

The bridge lets nothing of it in (tests/mavlink_bridge/test_every_field.py). Behind it nothing may
fail all the same: a monitor that fails lets no fix pass.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import pytest

from companion.conversions import CameraExtrinsics, vehicle_prior
from companion.integrity_monitor.checks import IntegrityChecks, IntegrityLimits
from companion.integrity_monitor.config import IntegrityMonitorConfig
from localizer.geometry.geo import Geodetic, LocalFrame
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.messages import Attitude, GimbalAttitude, InertialSample, VehicleState
from tests.companion.integrity_monitor.simulated import (
    HEIGHT,
    LATITUDE,
    LONGITUDE,
    Flight,
    leg,
    second,
)

SPOILT = (math.nan, math.inf, -1e308)
SPELL_S = 0.2  # for which one number is spoilt, and then as long none


def spoilt(made: Any, value: float) -> Iterator[tuple[str, Any]]:
    """The dataclass with each of its floats, alone or in a tuple, spoilt."""
    for one in fields(made):
        before = getattr(made, one.name)
        if isinstance(before, float):
            yield one.name, replace(made, **{one.name: value})
        elif isinstance(before, tuple) and before and isinstance(before[0], float):
            for i in range(len(before)):
                whole = (*before[:i], value, *before[i + 1 :])
                yield f"{one.name}[{i}]", replace(made, **{one.name: whole})


KINDS = (VehicleState, Attitude, InertialSample)


@dataclass
class Spoilt(Flight):
    """From 8 s on every other spell one number of what the vehicle says is spoilt, in turn.

    spells: how many there were of each kind.
    """

    value: float = math.nan
    ways: dict[type, int] = field(default_factory=dict)

    def _some(self, made: Any) -> Any:
        turn = math.floor((self.at_s - 8.0) / SPELL_S)
        spoiled = list(spoilt(made, self.value))
        self.ways.setdefault(type(made), len(spoiled))
        first = sum(self.ways.get(kind, 0) for kind in KINDS[: KINDS.index(type(made))])
        index = turn // 2 - first
        if turn % 2 or not 0 <= index < len(spoiled):
            return made
        return spoiled[index][1]

    def state(self) -> VehicleState:
        """All of what is a float there."""
        full = replace(
            super().state(),
            ekf_velocity_variance=0.1,
            ekf_horizontal_variance=0.1,
            ekf_vertical_variance=0.1,
            ekf_compass_variance=0.1,
            altitude_amsl_m=500.0,
            gps_altitude_amsl_m=500.0,
            gps_height_m=547.0,
        )
        state: VehicleState = self._some(full)
        return state

    def attitude_at(self, time_ns: int) -> Attitude | None:
        attitude: Attitude = self._some(super().attitude_at(time_ns))
        return attitude

    def inertial_since(self, time_ns: int) -> tuple[InertialSample, ...]:
        return tuple(self._some(sample) for sample in super().inertial_since(time_ns))


@pytest.mark.parametrize("value", SPOILT)
def test_no_number_of_the_vehicle_fails_the_guardian_or_blinds_it(value: float) -> None:
    freezes_s = 36.0

    def frozen(at_s: float) -> tuple[float, float]:
        return leg(min(at_s, freezes_s))

    flight = Spoilt(
        IntegrityChecks(IntegrityMonitorConfig(), IntegrityLimits()),
        leg,
        frozen,
        noise_m=0.03,
        gnss_north_m=lambda _: 0.0,
        value=value,
    )
    flight.fly(freezes_s)
    assert set(flight.ways) == set(KINDS)
    assert 8.0 + 2.0 * SPELL_S * sum(flight.ways.values()) < freezes_s  # each was spoilt
    # What passes carries a level that is a number, or none that bounds it.
    assert not any(math.isnan(level) for fix in flight.passed for level in fix.protection_m or ())
    # And what is spoilt is not kept: the monitor still sees a position that freezes.
    before = len(flight.lines)
    flight.fly(freezes_s + 8.0)
    assert [a for _, a in flight.lines[before:] if a.id is AlertId.VISION_IMU_MISMATCH]


STATE = VehicleState(
    connected=True,
    ekf_flags=8 | 16,
    latitude_deg=LATITUDE,
    longitude_deg=LONGITUDE,
    altitude_amsl_m=500.0,
    position_time_ns=second(1.0),
    local_velocity_ned=(1.0, 2.0, 3.0),
)
LEVEL = (1.0, 0.0, 0.0, 0.0)
ATTITUDE = Attitude(second(1.0), 0.0, 0.0, 0.0, LEVEL)
GIMBAL = GimbalAttitude(second(1.0), 0.0, 0.0, 0.0, LEVEL, "test")


@pytest.mark.parametrize("value", SPOILT)
def test_a_prior_of_what_is_no_number_is_none(value: float) -> None:
    frame = LocalFrame(Geodetic(LATITUDE, LONGITUDE, HEIGHT))
    extrinsics = CameraExtrinsics(frame, 47.0, np.zeros(3))
    sigma, at_ns = (5.0, 0.1), second(1.1)
    assert vehicle_prior(STATE, ATTITUDE, GIMBAL, extrinsics, sigma, at_ns) is not None
    told = [(state, ATTITUDE, GIMBAL) for _, state in spoilt(STATE, value)]
    told += [(STATE, attitude, GIMBAL) for _, attitude in spoilt(ATTITUDE, value)]
    told += [(STATE, ATTITUDE, gimbal) for _, gimbal in spoilt(GIMBAL, value)]
    for state, attitude, gimbal in told:
        prior = vehicle_prior(state, attitude, gimbal, extrinsics, sigma, at_ns)
        if prior is not None:
            pose, velocity = prior.world_from_camera, prior.velocity
            assert np.isfinite(pose.rotation).all()
            assert np.abs(pose.translation).max() < 1e7
            assert velocity is None or np.isfinite(velocity).all()
