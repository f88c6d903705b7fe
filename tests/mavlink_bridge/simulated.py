"""The bridge's flight-controller end under a simulated clock: minutes of flight in seconds."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from pymavlink.generator.mavcrc import x25crc

from mavlink_bridge import BridgeConfig, HealthLevel, VisionFix
from mavlink_bridge import quaternion as quat
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.camera.look_at import LookAt
from mavlink_bridge.config import CameraConfig, InjectionConfig, OriginConfig
from mavlink_bridge.flight_controller import FC_WANTED, FlightControllerEnd
from mavlink_bridge.injection.injection_enable import InjectionEnable
from mavlink_bridge.link.clock import SteadyUtc
from mavlink_bridge.link.framing import FrameReader
from mavlink_bridge.link.transport import Endpoint
from mavlink_bridge.messages import PlaceHint, TrackRequest
from mavlink_bridge.shared import Shared
from mavlink_bridge.status import StatusNotifier
from mavlink_bridge.vehicle.commands import Commander
from mavlink_bridge.vehicle.origin_exchange import OriginExchange
from mavlink_bridge.vehicle.tracker import VehicleTracker
from mavlink_bridge.vehicle_events import VehicleWatch

MS = 1_000_000
SECOND = 1_000 * MS
HOME = (47.397742, 8.545594)
METRE = 1.0 / 111318.84502145034
GEOID = 47.0
ORIGIN = OriginConfig(latitude_deg=HOME[0], longitude_deg=HOME[1], altitude_amsl_m=488.0)
TURN_RATE = 0.2  # rad/s of the vehicle's yaw


@dataclass
class SimulatedLink:
    """What an end sees of its link; `open` false drops as a closed one does, `full` as a port does
    that takes no more.
    """

    sent: list[tuple[int, Any, int]] = field(default_factory=list)
    system_id: int = 0
    open: bool = True
    congested: bool = False
    full: bool = False
    kept: int = 0
    stranger: str = ""
    endpoint: Endpoint = field(default_factory=lambda: Endpoint.parse("tcp:vehicle:5760"))
    now_ns: int = 0

    def keep_peer(self) -> None:
        """Count it."""
        self.kept += 1

    def send(self, message: Any, component: int) -> bool:
        """Record it if the link is open."""
        takes = self.open and not self.full and self.system_id != 0
        if takes:
            self.sent.append((self.now_ns, message, component))
        return takes


class Flight:
    """A vehicle that turns at 500 m, its bridge, and a localizer at 10 Hz.

    boot_ns: its boot time as a function of the simulated time. mangle: what becomes of each frame.
    """

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, enable: InjectionEnable | None = None, **options: Any
    ) -> None:
        options.setdefault("injection", InjectionConfig(rate_hz=10, delay_ms=100))
        options.setdefault("origin", ORIGIN)
        options.setdefault("mode", "inject")
        config = BridgeConfig(**options)
        self.now_ns = 1_000 * SECOND
        monkeypatch.setattr("mavlink_bridge.link.clock.monotonic_ns", lambda: self.now_ns)
        self.alerts: list[Alert] = []
        self.tracked: list[TrackRequest] = []
        self.hinted: list[PlaceHint] = []

        shared = Shared(
            config,
            GEOID,
            SteadyUtc(1_790_000_000 * SECOND, self.now_ns),
            VehicleTracker(BridgeConfig(camera=CameraConfig(mount="fixed"))),
            self.now_ns,
            lambda: HealthLevel.OK,
            self.alerts.append,
            self.track,
            self.hint,
            VehicleWatch(self.alerts.append, clock=lambda: self.now_ns),
            enable,
            LookAt(config, GEOID, self.alerts.append),
            lambda: self.now_ns,
        )
        self.shared = shared
        self.end = FlightControllerEnd(shared)
        self.link = SimulatedLink()
        self.reader = FrameReader(FC_WANTED)
        self.codec = mavlink.MAVLink(None, 1, 1)
        self.booted_ns = self.now_ns - 100 * SECOND
        self.clock_error_ns = 0
        self.origin: tuple[float, float, float] | None = None
        self.north_m = 0.0
        self.ekf_north_m = 0.0
        self.gnss_north_m: float | None = None  # None: no receiver
        self.armed = False
        self.autopilot = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
        self.reset_count = 0
        self.latency_ms = 50
        self.answers_timesync = True
        self.sees = True
        self.yaw_is_seen = True
        self.yaw_error_rad = 0.0
        self.mangle: Callable[[bytes], bytes] = lambda frame: frame
        self._answered = 0

    def told(self, *wanted: AlertId) -> list[Alert]:
        """The alerts of these kinds that the operator was told, in order."""
        return [alert for alert in self.alerts if alert.id in wanted]

    def track(self, request: TrackRequest) -> None:
        """A wish to track came."""
        self.tracked.append(request)

    def hint(self, hint: PlaceHint) -> bool:
        """A hint at the place came."""
        self.hinted.append(hint)
        return True

    def boot_ns(self, now_ns: int) -> int:
        """The vehicle's clock."""
        return now_ns - self.booted_ns + self.clock_error_ns

    def yaw(self, now_ns: int) -> float:
        """The vehicle's yaw, rad."""
        return quat.wrap_pi(TURN_RATE * now_ns / SECOND)

    def reboot(self) -> None:
        """Clock and origin start over."""
        self.booted_ns, self.clock_error_ns, self.origin = self.now_ns, 0, None

    def run(self, seconds: float) -> None:
        """Fly on, in steps of 10 ms."""
        for _ in range(int(seconds * 100)):
            self.now_ns += 10 * MS
            self.link.now_ns = self.now_ns
            step = self.now_ns // (10 * MS)
            if self.link.open:
                self._vehicle(step)
            if self.sees and step % 10 == 5:
                self._fix(self.now_ns - self.latency_ms * MS)
            self.end.on_tick(self.link, self.now_ns)  # type: ignore[arg-type]

    def vision(self, since_ns: int = 0) -> list[tuple[int, Any]]:
        """What was injected: (time, message)."""
        kinds = ("VISION_POSITION_ESTIMATE", "GPS_INPUT")
        return [(t, m) for t, m, _ in self.link.sent if m.get_type() in kinds and t > since_ns]

    def _fix(self, exposure_ns: int) -> None:
        yaw = self.yaw(exposure_ns) + self.yaw_error_rad
        fix = VisionFix(
            exposure_ns,
            HOME[0] + self.north_m * METRE,
            HOME[1],
            988.0 + GEOID,
            quat.from_euler(0.0, 0.0, yaw) if self.yaw_is_seen else None,
            np.eye(3) * 0.04,
            reset_count=self.reset_count,
        )
        self.end.sender.put(fix)

    def _vehicle(self, step: int) -> None:
        boot_ms = self.boot_ns(self.now_ns) // MS
        if step % 100 == 0:
            mode = 209 if self.armed else 81
            self.say(mavlink.MAVLink_heartbeat_message(2, self.autopilot, mode, 4, 4, 3))
        if step % 20 == 0 and self.gnss_north_m is not None:
            self._gnss(boot_ms, self.gnss_north_m)
        if step % 4 == 0:
            yaw = self.yaw(self.now_ns)
            self.say(mavlink.MAVLink_attitude_message(boot_ms, 0.0, 0.0, yaw, 0.0, 0.0, TURN_RATE))
            self.say(
                mavlink.MAVLink_local_position_ned_message(
                    boot_ms, self.ekf_north_m, 0.0, -500.0, 0, 0, 0
                )
            )
        while self._answered < len(self.link.sent):
            _, message, _ = self.link.sent[self._answered]
            self._answered += 1
            self._answer(message)

    def _gnss(self, boot_ms: int, north_m: float) -> None:
        """The receiver's position, and the EKF's."""
        receiver, ekf = (round((HOME[0] + n * METRE) * 1e7) for n in (north_m, self.ekf_north_m))
        east = round(HOME[1] * 1e7)
        self.say(
            mavlink.MAVLink_gps_raw_int_message(
                0, 3, receiver, east, 988_000, 80, 100, 0, 0, 12, 0, 0, 1000
            )
        )
        self.say(
            mavlink.MAVLink_global_position_int_message(
                boot_ms, ekf, east, 988_000, 500_000, 0, 0, 0, 0
            )
        )

    def _answer(self, m: Any) -> None:
        kind = m.get_type()
        if kind == "TIMESYNC" and m.tc1 == 0 and self.answers_timesync:
            self.say(mavlink.MAVLink_timesync_message(self.boot_ns(m.ts1 + 4 * MS), m.ts1))
        elif kind == "SET_GPS_GLOBAL_ORIGIN" and self.origin is None:
            self.origin = (m.latitude * 1e-7, m.longitude * 1e-7, m.altitude * 1e-3)
        elif kind == "COMMAND_LONG" and m.command == 512 and m.param1 == 49 and self.origin:
            lat, lon, alt = self.origin
            self.say(
                mavlink.MAVLink_gps_global_origin_message(
                    round(lat * 1e7), round(lon * 1e7), round(alt * 1e3), 0
                )
            )

    def say(self, message: Any, system: int = 1, component: int = 1) -> None:
        """One message, of the vehicle's autopilot if nothing else is said."""
        self.codec.srcSystem, self.codec.srcComponent = system, component
        frame = bytes(message.pack(self.codec))
        self.codec.srcSystem, self.codec.srcComponent = 1, 1
        self.codec.seq = (self.codec.seq + 1) % 256
        for decoded in self.reader.feed(self.mangle(frame)):
            self.end.on_message(self.link, decoded, self.now_ns)  # type: ignore[arg-type]

    def longest(self) -> int:
        """Length of the longest of all collections, any of which might grow."""
        return max((lengths(self.end) | lengths(self.reader)).values())

    def attitude_error(self, age_ns: int = 200 * MS) -> float:
        """Error of the interpolated yaw at an exposure, rad; NaN while there is none."""
        at = self.shared.tracker.attitude_at(self.now_ns - age_ns)
        if at is None:
            return math.nan
        return abs(quat.wrap_pi(at.yaw_rad - self.yaw(self.now_ns - age_ns)))


def lengths(of: Any, seen: set[int] | None = None) -> dict[str, int]:
    """The length of each collection that an object holds, and the bridge's objects in it, by the
    attribute's name; the longest of those of one name.
    """
    seen, found = seen or {id(of)}, Counter[str]()
    for name, value in list(vars(of).items()):
        ours = type(value).__module__.startswith("mavlink_bridge") and hasattr(value, "__dict__")
        if isinstance(value, deque | dict | list | set | bytearray):
            found |= Counter({name.lstrip("_"): len(value)})
        elif ours and id(value) not in seen:
            seen.add(id(value))
            found |= Counter(lengths(value, seen))
    return found


def exchanging(configured: OriginConfig | None) -> tuple[OriginExchange, Any, list[Alert]]:
    """An exchange of the EKF's origin with a vehicle that is not armed, its link and its alerts."""
    told: list[Alert] = []
    tracker = VehicleTracker(BridgeConfig(camera=CameraConfig(mount="fixed")))
    config, notifier = BridgeConfig(origin=configured), StatusNotifier(told.append)
    exchange = OriginExchange(config, tracker, Commander(191), notifier, Counter())
    return exchange, SimulatedLink(system_id=1), told


def heartbeat(autopilot: int = 3, *, armed: bool = True) -> Any:
    """HEARTBEAT of a copter's autopilot."""
    return mavlink.MAVLink_heartbeat_message(2, autopilot, 209 if armed else 81, 4, 4, 3)


def origin_message(north_m: float) -> Any:
    """GPS_GLOBAL_ORIGIN so far north of home."""
    latitude, longitude = (round(degrees * 1e7) for degrees in (HOME[0] + north_m * METRE, HOME[1]))
    return mavlink.MAVLink_gps_global_origin_message(latitude, longitude, 488_000, 0)


def frame_of(known: Any, payload: bytes, system: int = 1, component: int = 1) -> bytes:
    """A frame of any payload of a message class, its checksum right."""
    header = bytes([len(payload), 0, 0, 0, system, component]) + known.id.to_bytes(3, "little")
    crc = x25crc(header + payload)
    crc.accumulate(bytes([known.crc_extra]))
    return b"\xfd" + header + payload + crc.crc.to_bytes(2, "little")
