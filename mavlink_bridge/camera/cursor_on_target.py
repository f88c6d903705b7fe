"""Cursor-on-Target: a target as ATAK and WinTAK show it."""

from __future__ import annotations

import logging
import math
from datetime import datetime, timedelta, timezone
from xml.etree import ElementTree

from mavlink_bridge.config import TargetsConfig
from mavlink_bridge.link.clock import SteadyUtc
from mavlink_bridge.link.transport import Endpoint, UdpTransport
from mavlink_bridge.messages import TargetReport

_log = logging.getLogger(__name__)

_COT_TYPE = "a-u-G"  # atom, unknown affiliation, ground
_TOLD_ELSEWHERE = 0.05  # from here on a target's other surface is worth a remark


class CursorOnTarget:
    """Sends targets to `cot_endpoint` over a socket of its own. Any thread may call it."""

    def __init__(self, config: TargetsConfig, utc: SteadyUtc) -> None:
        self._config = config
        self._utc = utc
        where = Endpoint.parse(f"udpout:{config.cot_endpoint}")
        self._socket = UdpTransport(None, (where.address, where.number))

    def send(self, target: TargetReport) -> None:
        """One event; what the network refuses is lost."""
        try:
            self._socket.write(cursor_on_target(target, self._config, self._utc))
        except OSError as error:
            _log.debug("Cursor-on-Target not sent: %s", error)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def cursor_on_target(report: TargetReport, config: TargetsConfig, utc: SteadyUtc) -> bytes:
    """A Cursor-on-Target event (XML) for ATAK and WinTAK; hae is the ellipsoidal height."""
    seen = datetime.fromtimestamp(utc.utc_ns(report.time_ns) * 1e-9, tz=timezone.utc)

    def stamp(moment: datetime) -> str:
        return moment.strftime("%Y-%m-%dT%H:%M:%S.%f")[:-3] + "Z"

    def accuracy(value: float | None) -> str:
        return "9999999.0" if value is None else f"{value:.1f}"  # CoT's "unknown"

    event = ElementTree.Element(
        "event",
        version="2.0",
        uid=f"pilot-target-{report.target_id}",
        type=_COT_TYPE,
        how="m-r",
        time=stamp(seen),
        start=stamp(seen),
        stale=stamp(seen + timedelta(seconds=config.cot_stale_s)),
    )
    ElementTree.SubElement(
        event,
        "point",
        lat=f"{report.latitude_deg:.7f}",
        lon=f"{report.longitude_deg:.7f}",
        hae=f"{report.height_m:.2f}",
        ce=accuracy(report.h_accuracy_m),
        le=accuracy(report.v_accuracy_m),
    )
    detail = ElementTree.SubElement(event, "detail")
    ElementTree.SubElement(detail, "contact", callsign=f"TGT{report.target_id:04d}")
    if report.elsewhere >= _TOLD_ELSEWHERE:
        remarks = ElementTree.SubElement(detail, "remarks")
        remarks.text = f"{report.elsewhere:.0%} likely on another surface (edge in the picture)"
    if report.velocity_ned is not None:
        north, east, _ = report.velocity_ned
        course = math.degrees(math.atan2(east, north)) % 360.0
        ElementTree.SubElement(
            detail, "track", course=f"{course:.1f}", speed=f"{math.hypot(north, east):.2f}"
        )
    document: bytes = ElementTree.tostring(event, encoding="utf-8", xml_declaration=True)
    return document
