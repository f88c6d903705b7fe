"""What the vehicle says, without what cannot be a number of a vehicle.

The bridge lets none of it in. Behind it stands the monitor's own gate: a monitor that fails lets
no fix pass, and one number that is none would stay for good in what it integrates.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields, replace
from typing import Any, Protocol, TypeVar

from mavlink_bridge.messages import (
    Attitude,
    GimbalAttitude,
    InertialSample,
    VehicleState,
)

_LARGEST = 1e6  # of metres, degrees, m/s, m/s^2, rad, and rad/s: far beyond all of them
_UNIT = 1e-3  # by which a quaternion's square may be off
_OLD_NS = 2_000_000_000  # of a velocity, which comes ten times a second

_Told = TypeVar("_Told", Attitude, GimbalAttitude, InertialSample)


class VehicleTelemetry(Protocol):
    """Where the monitor's own evidence comes from; the bridge is one."""

    def state(self) -> VehicleState:
        """What the vehicle says about itself."""
        ...

    def attitude_at(self, time_ns: int) -> Attitude | None:
        """Its attitude at a time."""
        ...

    def inertial_since(self, time_ns: int) -> tuple[InertialSample, ...]:
        """What its IMU read after a time, oldest first."""
        ...

    def gimbal_at(self, time_ns: int) -> GimbalAttitude | None:
        """The camera's attitude to NED at a time."""
        ...

    def gnss_place_at(self, time_ns: int) -> tuple[float, ...] | None:
        """The EKF's latitude, longitude and altitude at a time, while GNSS is what it follows."""
        ...


class ValidatedTelemetry:
    """A vehicle whose every number is one; where one is none, nothing is known."""

    def __init__(self, vehicle: VehicleTelemetry) -> None:
        self._vehicle = vehicle

    def state(self) -> VehicleState:
        """Fields that hold no number are None."""
        return known_state(self._vehicle.state())

    def attitude_at(self, time_ns: int) -> Attitude | None:
        """Its attitude at a time."""
        return _known(self._vehicle.attitude_at(time_ns))

    def inertial_since(self, time_ns: int) -> tuple[InertialSample, ...]:
        """What its IMU read after a time, oldest first."""
        return tuple(s for s in self._vehicle.inertial_since(time_ns) if _known(s) is not None)

    def gimbal_at(self, time_ns: int) -> GimbalAttitude | None:
        """The camera's attitude to NED at a time."""
        return _known(self._vehicle.gimbal_at(time_ns))

    def gnss_place_at(self, time_ns: int) -> tuple[float, ...] | None:
        """The EKF's latitude, longitude and altitude at a time, while GNSS is what it follows."""
        place = self._vehicle.gnss_place_at(time_ns)
        return place if place is not None and _are_numbers(place) else None


def known_state(state: VehicleState) -> VehicleState:
    """The state, None for each field that holds what is no number."""
    unknown: dict[str, Any] = {
        field.name: None for field in fields(state) if not _is_number(getattr(state, field.name))
    }
    return replace(state, **unknown) if unknown else state


def moving_now(state: VehicleState, time_ns: int) -> VehicleState:
    """The state at a time, without a velocity of long before: an EKF that has lost its position
    says none any more (ArduPilot ends LOCAL_POSITION_NED), and its last one would stand.
    """
    old = time_ns - state.local_time_ns > _OLD_NS
    return replace(state, local_velocity_ned=None) if old else state


def known_attitude(attitude: Attitude | None) -> Attitude | None:
    """The attitude; None where one of its numbers is none."""
    return _known(attitude)


def _known(told: _Told | None) -> _Told | None:
    if told is None or not _are_numbers(getattr(told, field.name) for field in fields(told)):
        return None
    q = getattr(told, "quaternion", (1.0, 0.0, 0.0, 0.0))
    return told if abs(sum(one * one for one in q) - 1.0) <= _UNIT else None


def _are_numbers(values: Iterable[Any]) -> bool:
    return all(_is_number(value) for value in values)


def _is_number(value: Any) -> bool:
    """Whether a float, or each of a tuple, can be one of a vehicle; others are no floats."""
    if isinstance(value, tuple):
        return _are_numbers(value)
    return not isinstance(value, float) or abs(value) <= _LARGEST
