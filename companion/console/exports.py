"""Targets for other programs: GeoJSON (RFC 7946) and Cursor on Target."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone
from typing import Any
from xml.etree import ElementTree

_STALE = timedelta(seconds=30)


def geojson(targets: list[dict[str, Any]]) -> dict[str, Any]:
    """The targets of a state document as GeoJSON points; heights above the ellipsoid."""
    return {
        "type": "FeatureCollection",
        "features": [
            {
                "type": "Feature",
                "geometry": {
                    "type": "Point",
                    "coordinates": [t["longitude_deg"], t["latitude_deg"], t["height_m"]],
                },
                "properties": {
                    k: t[k] for k in ("name", "amsl_m", "sigma_m", "sigma_up_m", "elsewhere")
                },
            }
            for t in targets
        ],
    }


def cursor_on_target(targets: list[dict[str, Any]], now: datetime | None = None) -> str:
    """The targets of a state document as Cursor on Target: one event for each."""
    now = now or datetime.now(timezone.utc)
    root = ElementTree.Element("events")
    for t in targets:
        event = ElementTree.SubElement(
            root, "event", version="2.0", uid=f"pilot-{t['name']}", type="a-u-G", how="m-r",
            time=_time(now), start=_time(now), stale=_time(now + _STALE),
        )  # fmt: skip
        ElementTree.SubElement(
            event, "point", lat=f"{t['latitude_deg']:.8f}", lon=f"{t['longitude_deg']:.8f}",
            hae=f"{t['height_m']:.2f}", ce=f"{t['sigma_m']:.2f}", le=f"{t['sigma_up_m']:.2f}",
        )  # fmt: skip
        detail = ElementTree.SubElement(event, "detail")
        ElementTree.SubElement(detail, "contact", callsign=t["name"])
    return ElementTree.tostring(root, encoding="unicode")


def _time(when: datetime) -> str:
    return when.strftime("%Y-%m-%dT%H:%M:%S.%f")[:-3] + "Z"
