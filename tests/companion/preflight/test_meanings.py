"""Settings of the right type that mean something else are named, and right ones pass."""

from __future__ import annotations

import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.config import parse_config
from companion.preflight.coverage import check_origin, check_vehicle_position
from companion.preflight.doctor import check_plausibility, check_ports
from localizer.map.cache.cache import TileCache
from mavlink_bridge.config import OriginConfig
from mavlink_bridge.messages import VehicleState

MODEL = {"width": 1280, "height": 720, "fx": 1100, "fy": 1100, "cx": 640, "cy": 360}


def meanings(camera: dict[str, Any] | None = None, **settings: Any) -> dict[str, str]:
    whole = {"source": "udp://x:1", "model": MODEL} | (camera or {})
    config = parse_config({"map": "map", "camera": whole} | settings, "test")
    found = check_plausibility(config)
    assert not any(f.ok or f.required for f in found)  # advice
    return {f.name: f.why for f in found}


def fixed(pitch_deg: float) -> dict[str, Any]:
    return {"camera": {"mount": "fixed", "mount_pitch_deg": pitch_deg}}


@pytest.mark.parametrize(
    ("camera", "settings", "name", "why"),
    [
        ({"lever_arm_m": [15, 0, -8]}, {}, "camera.lever_arm_m", "metres, not centimetres"),
        ({"model": MODEL | {"fx": 300, "fy": 300}}, {}, "camera.model", "pixels, not millimetres"),
        ({"model": MODEL | {"readout_ms": 0.02}}, {}, "camera.model.readout_ms", "not seconds"),
        ({"settings": {"latency_ms": 0.12}}, {}, "camera.settings.latency_ms", "not seconds"),
        ({}, {"targets": {"operator_delay_ms": 0.25}}, "targets.operator_delay_ms", "not seconds"),
        ({}, {"bridge": fixed(-1.57)}, "bridge.camera.mount_pitch_deg", "not radians"),
        ({}, {"bridge": fixed(0.0)}, "bridge.camera.mount_pitch_deg", "to the horizon"),
    ],
)
def test_what_means_something_else_is_named(camera, settings, name, why):
    found = meanings(camera, **settings)
    assert list(found) == [name]
    assert why in found[name]


@pytest.mark.parametrize(
    ("camera", "settings"),
    [
        ({}, {}),
        ({"lever_arm_m": [0.15, 0, -0.08], "settings": {"latency_ms": 120}}, {}),
        ({"model": MODEL | {"readout_ms": 16.7}}, {"bridge": fixed(-90.0)}),
        ({}, {"bridge": fixed(-25.0), "targets": {"operator_delay_ms": 0}}),
    ],
)
def test_what_is_right_is_not_spoken_of(camera: dict[str, Any], settings: dict[str, Any]) -> None:
    assert meanings(camera, **settings) == {}


def test_a_port_that_another_has_is_named() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as holder:
        holder.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{holder.getsockname()[1]}"
        data = {"map": "map", "camera": {"source": "udp://x:1", "model": MODEL}}
        config = parse_config(data | {"targets": {"detections": address}}, "test")
        (finding,) = check_ports(config)
        assert (finding.ok, finding.required) == (False, True)
        assert f"targets.detections {address}" in finding.why
    assert check_ports(config) == []
    assert check_ports(parse_config(data, "test")) == []


# --- the map of another place ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def cache(small_assets: Any) -> TileCache:
    return TileCache.open(Path(small_assets.map_cache))


def standing(cache: TileCache, east_m: float) -> VehicleState:
    edge = np.array([cache.index.box_max[0, 0], *cache.index.box_min[0, 1:]])
    lat, lon, _ = cache.frame.geodetic_from_enu(edge + np.array([east_m, 0.0, 0.0]))
    return VehicleState(gps_fix_type=3, gps_latitude_deg=float(lat), gps_longitude_deg=float(lon))


def test_a_vehicle_beside_its_map_is_told(cache: TileCache) -> None:
    """Of a map of another place everything else was in order."""
    assert check_vehicle_position(cache, VehicleState()) == []
    assert check_vehicle_position(cache, standing(cache, -50.0)) == []
    assert check_vehicle_position(cache, standing(cache, 250.0)) == []
    assert check_vehicle_position(cache, replace(standing(cache, 9e3), gps_fix_type=1)) == []
    (near,) = check_vehicle_position(cache, standing(cache, 9e3))
    assert (near.ok, near.required) == (False, False)
    (far,) = check_vehicle_position(cache, standing(cache, 2e5))
    assert (far.ok, far.required) == (False, True)
    assert "another place?" in far.why


def test_swapped_coordinates_are_named(cache: TileCache) -> None:
    o = cache.manifest.origin
    lat, lon = o.latitude_deg, o.longitude_deg
    swapped = VehicleState(gps_fix_type=3, gps_latitude_deg=lon, gps_longitude_deg=lat)
    (finding,) = check_vehicle_position(cache, swapped)
    assert "latitude and longitude are swapped" in finding.why
    amsl_m = o.height_m - cache.manifest.geoid_separation_m
    for (a, b), ok in (((lat, lon), True), ((lon, lat), False)):
        origin = OriginConfig(latitude_deg=a, longitude_deg=b, altitude_amsl_m=amsl_m)
        found = check_origin(origin, cache)
        assert (found.ok, "are swapped" in found.why) == (ok, not ok)


def test_the_other_side_of_the_earth_is_far(cache: TileCache) -> None:
    """In the map's plane it lies under the map."""
    o = cache.manifest.origin
    beyond = {"gps_latitude_deg": -o.latitude_deg, "gps_longitude_deg": o.longitude_deg - 180.0}
    (finding,) = check_vehicle_position(cache, VehicleState(gps_fix_type=3, **beyond))
    assert finding.required
    assert float(finding.found.split()[0]) > 10_000
