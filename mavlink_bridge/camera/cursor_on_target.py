"""Cursor-on-Target: targets, the aircraft, its camera's field of view and video, for ATAK and
WinTAK.

MITRE's "Cursor-on-Target Event Data Model" 2.0; `<sensor>` and `<__video>` as ATAK-CIV reads them.
"""

from __future__ import annotations

import logging
import math
import threading
from datetime import datetime, timedelta, timezone
from xml.etree import ElementTree

from mavlink_bridge import quaternion as quat
from mavlink_bridge.config import CameraConfig, TargetsConfig
from mavlink_bridge.link.clock import SteadyUtc
from mavlink_bridge.link.transport import Endpoint, Transport, open_transport
from mavlink_bridge.messages import CameraView, TargetReport
from mavlink_bridge.vehicle.origin import north_east

_log = logging.getLogger(__name__)

_TARGET_TYPE = "a-u-G"  # atom, unknown affiliation, ground
_AIRCRAFT_TYPE = "a-f-A-M-H-Q"  # friendly, air, military, rotary wing, unmanned: ATAK's UAS
_MEASURED = "m-r"  # how: machine, relayed
_TOLD_ELSEWHERE = 0.05  # from here on a target's other surface is worth a remark
_AIRCRAFT_PERIOD_NS = 900_000_000  # about 1 Hz: views do not come on the second
_AIRCRAFT_STALE_S = 10.0
_STEEP_RAD = math.radians(-60.0)  # below it the picture's upper edge tells the azimuth


class CursorOnTarget:
    """Sends targets, and the aircraft, to `cot_endpoint` over its own socket.

    Any thread may call it.
    """

    def __init__(self, config: TargetsConfig, camera: CameraConfig, utc: SteadyUtc) -> None:
        self._config = config
        self._camera = camera
        self._utc = utc
        self._endpoint = Endpoint.parse(f"udpout:{config.cot_endpoint}")
        self._socket: Transport | None = None  # opened, and its name resolved, by the first event
        self._lock = threading.Lock()
        self._next_ns = 0

    def send(self, target: TargetReport) -> None:
        """Send a target's event, or lose it. May block to resolve a name in `cot_endpoint`, at
        first and after an error.
        """
        self._write(cursor_on_target(target, self._config, self._utc))

    def report_view(self, view: CameraView) -> None:
        """Send aircraft and camera if `cot_aircraft` is set, at most every 0.9 s."""
        if not self._config.cot_aircraft:
            return
        with self._lock:
            if view.time_ns < self._next_ns:
                return
            self._next_ns = view.time_ns + _AIRCRAFT_PERIOD_NS
        self._write(aircraft_on_map(view, self._config, self._camera, self._utc))

    def close(self) -> None:
        """Close the socket. Never blocks."""
        if self._socket is not None:
            self._socket.close()

    def _write(self, event: bytes) -> None:
        with self._lock:
            try:
                self._socket = self._socket or open_transport(self._endpoint)
                self._socket.write(event)
            except OSError as error:
                _log.debug("Cursor-on-Target not sent: %s", error)
                self.close()
                self._socket = None


def cursor_on_target(report: TargetReport, config: TargetsConfig, utc: SteadyUtc) -> bytes:
    """A target's event (XML); hae is the ellipsoidal height."""
    uid = f"pilot-target-{report.target_id}"
    event = _event(uid, _TARGET_TYPE, report, utc, config.cot_stale_s)
    detail = ElementTree.SubElement(event, "detail")
    ElementTree.SubElement(detail, "contact", callsign=f"TGT{report.target_id:04d}")
    if report.elsewhere >= _TOLD_ELSEWHERE:
        remarks = ElementTree.SubElement(detail, "remarks")
        remarks.text = f"{report.elsewhere:.0%} likely on another surface (edge in the image)"
    if report.velocity_ned is not None:
        north, east, _ = report.velocity_ned
        course = math.degrees(math.atan2(east, north)) % 360.0
        ElementTree.SubElement(
            detail, "track", course=f"{course:.1f}", speed=f"{math.hypot(north, east):.2f}"
        )
    return _document(event)


def aircraft_on_map(
    view: CameraView, config: TargetsConfig, camera: CameraConfig, utc: SteadyUtc
) -> bytes:
    """The aircraft's event: position, field of view of the camera, and address of the video.

    The range of the field of view is the horizontal distance to the image's centre, so that it ends
    there on the map. A camera that looks into the sky has no range.
    """
    uid = f"pilot-aircraft-{config.cot_callsign}"
    event = _event(uid, _AIRCRAFT_TYPE, view, utc, _AIRCRAFT_STALE_S)
    detail = ElementTree.SubElement(event, "detail")
    ElementTree.SubElement(detail, "contact", callsign=config.cot_callsign)
    azimuth_deg, elevation_deg, roll_deg = sensor_angles(view.quaternion_ned)
    across, down = view.fov_deg or (camera.horizontal_fov_deg, camera.vertical_fov_deg)
    sensor = ElementTree.SubElement(
        detail,
        "sensor",
        version="0.6",
        type="r-e",
        model=camera.model,
        azimuth=f"{azimuth_deg:.1f}",
        elevation=f"{elevation_deg:.1f}",
        roll=f"{roll_deg:.1f}",
        fov=f"{across:.1f}",
        vfov=f"{down:.1f}",
        north="0",
    )
    if view.image_latitude_deg is not None and view.image_longitude_deg is not None:
        place = (view.latitude_deg, view.longitude_deg)
        centre = (view.image_latitude_deg, view.image_longitude_deg)
        sensor.set("range", f"{max(1.0, math.hypot(*north_east(*place, *centre))):.0f}")
    if "://" in camera.stream_uri:
        ElementTree.SubElement(detail, "__video", url=camera.stream_uri)
    return _document(event)


def sensor_angles(quaternion_ned: quat.Quaternion) -> tuple[float, float, float]:
    """Azimuth from true north, elevation (up positive) and roll of a camera, degrees.
    quaternion_ned: camera (x along the boresight, y right, z down) to NED. Below -60 deg elevation
    the azimuth is that of the image's upper edge, and roll is 0.
    """
    forward = quat.rotate(quaternion_ned, (1.0, 0.0, 0.0))
    right = quat.rotate(quaternion_ned, (0.0, 1.0, 0.0))
    up = quat.rotate(quaternion_ned, (0.0, 0.0, -1.0))
    elevation = math.asin(max(-1.0, min(1.0, -forward[2])))
    along = up if elevation < _STEEP_RAD else forward
    azimuth = math.atan2(along[1], along[0]) % (2.0 * math.pi)
    roll = math.atan2(right[2], -up[2])
    if elevation < _STEEP_RAD:
        roll = 0.0  # it is in the azimuth
    return math.degrees(azimuth), math.degrees(elevation), math.degrees(roll)


def _event(
    uid: str, kind: str, place: TargetReport | CameraView, utc: SteadyUtc, stale_s: float
) -> ElementTree.Element:
    seen = datetime.fromtimestamp(utc.utc_ns(place.time_ns) * 1e-9, tz=timezone.utc)
    event = ElementTree.Element(
        "event",
        version="2.0",
        uid=uid,
        type=kind,
        how=_MEASURED,
        time=_stamp(seen),
        start=_stamp(seen),
        stale=_stamp(seen + timedelta(seconds=stale_s)),
    )
    ElementTree.SubElement(
        event,
        "point",
        lat=f"{place.latitude_deg:.7f}",
        lon=f"{place.longitude_deg:.7f}",
        hae=f"{place.height_m:.2f}",
        ce=_accuracy(place.h_accuracy_m),
        le=_accuracy(place.v_accuracy_m),
    )
    return event


def _stamp(moment: datetime) -> str:
    return moment.strftime("%Y-%m-%dT%H:%M:%S.%f")[:-3] + "Z"


def _accuracy(value: float | None) -> str:
    return "9999999.0" if value is None else f"{value:.1f}"  # CoT's "unknown"


def _document(event: ElementTree.Element) -> bytes:
    document: bytes = ElementTree.tostring(event, encoding="utf-8", xml_declaration=True)
    return document
