"""Every field of every message that the bridge takes in, set to what no sensor says.

Made from the dialect, not by hand: a message that the bridge learns to read is attacked from then
on. Nothing may fail, nothing that is not finite may get out, and nothing may be measured by it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import fields, is_dataclass, replace
from itertools import pairwise, product
from typing import Any, get_args

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.camera.component import TRACKING
from mavlink_bridge.camera.look_at import LOOKS
from mavlink_bridge.components import COMMANDS_IN
from mavlink_bridge.config import InjectionConfig, InjectionEnableConfig, InjectionMessage
from mavlink_bridge.errors import FixError
from mavlink_bridge.flight_controller import FC_WANTED
from mavlink_bridge.injection.encode import InjectionContext
from mavlink_bridge.injection.injection_enable import InjectionEnable
from mavlink_bridge.injection.injector import Injector
from mavlink_bridge.link.clock import SteadyUtc
from mavlink_bridge.messages import CameraView, Origin, TargetReport, VisionFix
from mavlink_bridge.place_hint import PLACE_HINT
from mavlink_bridge.vehicle.profile import select_profile
from tests.mavlink_bridge.simulated import HOME, MS, SECOND, Flight, frame_of

_FLOATS = {"float": 3.4028234663852886e38, "double": 1.7976931348623157e308}
_SIZES = {"char": 8, "int8_t": 8, "uint8_t": 8, "uint8_t_mavlink_version": 8}
_SIZES |= {f"{sign}int{bits}_t": bits for sign in ("", "u") for bits in (8, 16, 32, 64)}
_NAMES = sorted(mavlink.mavlink_map[number].msgname for number in FC_WANTED)
_VEHICLE = sorted(set(_NAMES) - set(COMMANDS_IN))
# What a message is when nothing is wrong with it, where zeros would be refused for themselves.
_HONEST: dict[str, dict[str, Any]] = {
    "ATTITUDE_QUATERNION": {"q1": 1.0},
    "GIMBAL_DEVICE_ATTITUDE_STATUS": {"q": [1.0, 0.0, 0.0, 0.0]},
    "GLOBAL_POSITION_INT": {"lat": 473977420, "lon": 85455940, "alt": 988_000},
    "GPS_GLOBAL_ORIGIN": {"latitude": 473977420, "longitude": 85455940, "altitude": 488_000},
    "GPS_RAW_INT": {"fix_type": 3, "lat": 473977420, "lon": 85455940, "alt": 988_000},
    "HEARTBEAT": {"type": 2, "autopilot": 3, "base_mode": 209, "mavlink_version": 3},
    "SCALED_PRESSURE": {"press_abs": 900.0},
    "DISTANCE_SENSOR": {
        "min_distance": 20,
        "max_distance": 9000,
        "current_distance": 5000,
        "orientation": 25,
    },
}
# Of what the vehicle may say of itself: where no aircraft of ours is.
_RANGES = {
    "latitude_deg": 90.0,
    "longitude_deg": 180.0,
    "altitude_amsl_m": 50e3,
    "altitude_relative_m": 50e3,
    "gps_latitude_deg": 90.0,
    "gps_longitude_deg": 180.0,
    "gps_altitude_amsl_m": 50e3,
    "gps_height_m": 50e3,
    "gps_h_accuracy_m": 100e3,
    "pressure_altitude_m": 50e3,
    "rangefinder_m": 656.0,
}
Values = dict[str, Any]


def message_of(name: str, values: Values) -> Any:
    """The message with these fields."""
    known = mavlink.mavlink_map[getattr(mavlink, f"MAVLINK_MSG_ID_{name}")]
    return known(*(values[field] for field in known.fieldnames))


def honest(name: str, boot_ms: int) -> Values:
    """Fields of a plausible message: zeros, the time, and what zeros would not do for."""
    known = mavlink.mavlink_map[getattr(mavlink, f"MAVLINK_MSG_ID_{name}")]
    values: Values = {}
    for field, kind, length in fields_of(known):
        one: Any = b"" if kind == "char" else 0.0 if kind in _FLOATS else 0
        values[field] = [one] * length if length and kind != "char" else one
    values.update(_HONEST.get(name, {}))
    if "time_boot_ms" in values:
        values["time_boot_ms"] = boot_ms
    if "time_usec" in values:
        values["time_usec"] = boot_ms * 1000
    return values


def fields_of(known: Any) -> Iterator[tuple[str, str, int]]:
    """Name, type, and length of an array, 0 of a single value."""
    for field, kind in zip(known.fieldnames, known.fieldtypes, strict=True):
        # Lengths stand in the order on the wire.
        index = known.ordered_fieldnames.index(field)
        yield field, kind, known.array_lengths[index]


def spoilt(kind: str) -> tuple[Any, ...]:
    """What no sensor says in a field of that type; a text is cut to its length when it is sent."""
    if kind == "char":
        return (b"\xff" * 300, b"\x00", b"%s%n\x1b[2J")
    if kind in _FLOATS:
        return (math.nan, math.inf, -math.inf, _FLOATS[kind], -_FLOATS[kind])
    bits = _SIZES[kind]
    if kind.startswith("u"):
        return ((1 << bits) - 1, 0)
    return ((1 << bits - 1) - 1, -(1 << bits - 1))


def attacks(name: str, boot_ms: Callable[[], int]) -> Iterator[tuple[str, Any]]:
    """Each field spoilt in each way, alone and all at once: what was done, and the message."""
    known = mavlink.mavlink_map[getattr(mavlink, f"MAVLINK_MSG_ID_{name}")]
    for field, kind, length in fields_of(known):
        for value in spoilt(kind):
            given = [value] * length if length and kind != "char" else value
            yield f"{field}={value}", message_of(name, honest(name, boot_ms()) | {field: given})
    for index in range(5):
        every = {}
        for field, kind, length in fields_of(known):
            values = spoilt(kind)
            value = values[index % len(values)]
            every[field] = [value] * length if length and kind != "char" else value
        yield f"all, {index}", message_of(name, honest(name, boot_ms()) | every)


def not_finite(value: Any, at: str = "") -> Iterator[str]:
    """Where in a dataclass, mapping or sequence a number is not finite."""
    if isinstance(value, float):
        if not math.isfinite(value):
            yield f"{at} = {value}"
    elif is_dataclass(value):
        for field in fields(value):
            yield from not_finite(getattr(value, field.name), f"{at}.{field.name}")
    elif isinstance(value, dict):
        for key, one in value.items():
            yield from not_finite(one, f"{at}.{key}")
    elif isinstance(value, list | tuple):
        for index, one in enumerate(value):
            yield from not_finite(one, f"{at}[{index}]")


class Attacked(Flight):
    """A flight, armed and injecting, to which messages are said that no sensor says."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *arguments: Any, **options: Any) -> None:
        super().__init__(monkeypatch, *arguments, **options)
        self.armed = True
        self.gnss_north_m = 0.0
        self.origin = (*HOME, 488.0)
        self.run(8.0)
        self.began_ns = self.now_ns
        self.counted = len(self.link.sent)
        self.origin_known = self.end.origin.origin
        assert self.origin_known is not None

    def boot_ms(self) -> int:
        """The vehicle's boot time."""
        return self.boot_ns(self.now_ns) // MS

    def frame(self, message: Any, system: int, component: int) -> bytes:
        """The message as others send it."""
        return bytes(message.pack(mavlink.MAVLink(None, system, component)))

    def say_frame(self, frame: bytes) -> int:
        """Bytes as they come; how many messages they were."""
        messages = self.reader.feed(frame)
        for message in messages:
            self.end.on_message(self.link, message, self.now_ns)  # type: ignore[arg-type]
        return len(messages)

    def wrong(self) -> list[str]:
        """What is not finite in all that can be asked, and in what was sent since the last call."""
        tracker, now = self.shared.tracker, self.now_ns
        seen = {
            "state": tracker.snapshot(now),
            "attitude": tracker.attitude_at(now - 50 * MS),
            "gimbal": tracker.gimbal_at(now - 50 * MS),
            "global": tracker.global_at(now - 300 * MS),
            "local": tracker.local_at(now - 50 * MS),
            "inertial": tracker.inertial_since(now - SECOND),
            "figures": self.end.figures(),
        }
        found = list(not_finite(seen))
        state = tracker.snapshot(now)
        for field, most in _RANGES.items():
            value = getattr(state, field)
            if value is not None and abs(value) > most:
                found.append(f"state.{field} = {value}")
        if state.origin != self.origin_known:
            found.append(f"origin = {state.origin}")
        for sample in tracker.inertial_since(now - SECOND):
            if max(abs(one) for one in (*sample.specific_force, *sample.rates)) > 300.0:
                found.append(f"{sample}")
        for _, message, _ in self.link.sent[self.counted :]:
            if message.get_type() in ("VISION_POSITION_ESTIMATE", "COMMAND_LONG", "TIMESYNC"):
                found += not_finite(message.to_dict(), message.get_type())
        self.counted = len(self.link.sent)
        return found


@pytest.mark.parametrize("name", _VEHICLE)
def test_no_field_of_the_vehicle_breaks_or_gets_through(name, monkeypatch):
    flight = Attacked(monkeypatch)
    wrong: list[str] = []
    for what, message in attacks(name, flight.boot_ms):
        try:
            flight.say(message)
            flight.run(0.04)
        except Exception as error:
            wrong.append(f"{what}: {type(error).__name__}: {error}")
        wrong += [f"{what}: {one}" for one in flight.wrong()]
    assert wrong == []
    flight.run(0.5)
    assert flight.shared.tracker.clock.reboots == 0
    times = [
        flight.began_ns,
        *(at_ns for at_ns, _ in flight.vision(flight.began_ns)),
        flight.now_ns,
    ]
    assert max(b - a for a, b in pairwise(times)) <= 300 * MS


def test_a_message_of_another_length_is_cut_or_filled_and_breaks_nothing(monkeypatch):
    """MAVLink 2 lets a payload be shorter (zeros were cut) or longer (a newer definition)."""
    flight = Attacked(monkeypatch)
    read: set[str] = set()
    for name in _VEHICLE:
        known = mavlink.mavlink_map[getattr(mavlink, f"MAVLINK_MSG_ID_{name}")]
        for length in (0, 1, known.unpacker.size - 1, known.unpacker.size + 1, 255):
            if flight.say_frame(frame_of(known, b"\xff" * length)):
                read.add(name)
            flight.run(0.03)
            assert not flight.wrong(), (name, length)
    assert read == set(_VEHICLE)
    assert flight.vision(flight.now_ns - SECOND)


_PARAMETERS = {name: [f"param{i}" for i in range(1, 8)] for name in COMMANDS_IN}
_PARAMETERS["COMMAND_INT"][4:] = ["x", "y", "z"]


@pytest.mark.parametrize("name", COMMANDS_IN)
def test_no_parameter_of_a_command_breaks_or_gets_through(name, monkeypatch):
    """Every command that a component of ours knows, from a station that may order."""
    flight = Attacked(
        monkeypatch, InjectionEnable(InjectionEnableConfig(), lambda _: None), mode="rc"
    )
    flight.shared.enable.command(mavlink.MAV_CMD_USER_1, 1.0)  # type: ignore[union-attr]
    wrong = []
    for command, field in product(_COMMANDS, ("all", *_PARAMETERS[name])):
        for component, value in product((100, 191, 197), spoilt("float")):
            values = honest(name, 0) | {"target_system": 1, "target_component": component}
            values["command"] = command
            for one in _PARAMETERS[name] if field == "all" else [field]:
                whole = name == "COMMAND_INT" and one in ("x", "y")
                values[one] = (1 << 31) - 1 if whole else value
            try:
                heard = flight.say_frame(flight.frame(message_of(name, values), 255, 190))
                assert heard == 1
                flight.end.on_tick(flight.link, flight.now_ns)  # type: ignore[arg-type]
            except Exception as error:
                wrong.append(f"{command}, {field}={value}: {type(error).__name__}: {error}")
            wrong += [f"{command}, {field}={value}: {one}" for one in flight.wrong()]
    assert wrong == []
    wanted = [*flight.tracked, *flight.hinted]
    assert list(not_finite(wanted)) == []
    assert flight.hinted == []
    assert all(request.kind == "stop" or 0 <= request.radius <= 1 for request in flight.tracked)


_COMMANDS = (
    *sorted(TRACKING),
    *sorted(LOOKS),
    PLACE_HINT,
    mavlink.MAV_CMD_USER_1,
    mavlink.MAV_CMD_REQUEST_MESSAGE,
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
    mavlink.MAV_CMD_REQUEST_CAMERA_INFORMATION,
    65535,
)


# --- what goes in on our own side --------------------------------------------------------------

FIX = VisionFix(
    SECOND,
    *HOME,
    500.0,
    (1.0, 0.0, 0.0, 0.0),
    velocity_ned=(0.0, 0.0, 0.0),
    protection_m=(1.0, 1.0),
    scale_sigma=0.1,
)
TARGET = TargetReport(
    SECOND, *HOME, 500.0, (0.0, 0.0, 0.0), 1.0, 1.0, (0.5, 0.5), 1, 0.1, (0.1, 0.1, 0.2, 0.2), 0.5
)
VIEW = CameraView(SECOND, *HOME, 500.0, (1.0, 0.0, 0.0, 0.0), *HOME, 400.0, 1.0, 1.0, (60.0, 40.0))


def spoilt_as(before: Any) -> Iterator[Any]:
    """A float, a tuple of them or a covariance with one number spoilt; nothing else."""
    for value in (math.nan, math.inf, -math.inf, 1e308, -1e308):
        if isinstance(before, float):
            yield value
        elif isinstance(before, tuple):
            yield from ((*before[:i], value, *before[i + 1 :]) for i in range(len(before)))
        elif isinstance(before, np.ndarray):
            yield np.diag([value, 1.0, 1.0])
            yield np.diag([1.0, 1.0, value])


def variants(made: Any) -> Iterator[tuple[str, Any]]:
    """Each number of a dataclass spoilt, as far as it lets itself be made."""
    for field in fields(made):
        for value in spoilt_as(getattr(made, field.name)):
            with suppress(FixError):
                yield f"{field.name}={value}", replace(made, **{field.name: value})


@pytest.mark.parametrize("made", [FIX, TARGET, VIEW], ids=lambda made: type(made).__name__)
def test_what_no_message_can_carry_is_refused_where_it_comes_in(made: Any) -> None:
    """But a protection level that nothing bounds: it is beyond every alert limit."""
    assert {what.partition("=")[0] for what, _ in variants(made)} <= {"protection_m"}


@pytest.mark.parametrize("message", get_args(InjectionMessage))
def test_no_number_of_a_fix_makes_a_message_that_is_not_finite(message: InjectionMessage) -> None:
    injection = InjectionConfig(message=message, delay_ms=0)
    context = InjectionContext(
        Origin(*HOME, 450.0), select_profile("ardupilot", (4, 7, 0)), lambda _: None
    )
    made = 0
    for what, fix in variants(FIX):
        injector = Injector(injection, 0.0, SteadyUtc(1_790_000_000 * SECOND, SECOND))
        injector.submit(fix, SECOND)
        injection_made = injector.step(SECOND + MS, context)
        if injection_made is None:
            continue
        sent = injection_made.message
        made += 1
        # Unknown rates of turn and what is not measured are NaN by the message's definition.
        known = {k: v for k, v in sent.to_dict().items() if not k.endswith("speed")}
        known.pop("velocity_covariance", None)
        if message == "external_position_estimate":
            assert math.isnan(known.pop("param4"))
            assert math.isnan(known.pop("z"))
        assert list(not_finite(known)) == [], what
        sent.pack(mavlink.MAVLink(None, 1, 197))
    assert made >= 4
