"""Finds settings that are valid but probably wrong: another unit, a port in use."""

from __future__ import annotations

import math
import socket

from companion.config import CompanionConfig
from companion.targets.detections import parse_host_port
from mavlink_bridge.preflight.rules import DoctorFinding

_LONGEST_ARM_M = 2.0  # of most aircraft that carry this
_WIDEST_DEG = 125.0  # beyond it Brown's model is no lens's
_STEEP_ENOUGH_DEG = 10.0  # below the horizon, to see ground near by
_SHORTEST_MS = 1.0  # less is no camera's, no link's and nobody's


def check_plausibility(config: CompanionConfig) -> list[DoctorFinding]:
    """Advice about unusual settings."""
    return [*_arm(config), *_mount(config), *_lens(config), *_milliseconds(config)]


def check_ports(config: CompanionConfig) -> list[DoctorFinding]:
    """A finding if another program uses the port `targets.detections`; otherwise []."""
    address = config.targets.detections
    if address is None:
        return []
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(parse_host_port(address))
    except OSError as error:
        why = f"targets.detections {address}: {error.strerror or error}: another program's?"
        return [DoctorFinding("ports", "in use", "free ports", why, False, True)]
    return []


def _arm(config: CompanionConfig) -> list[DoctorFinding]:
    arm = config.camera.lever_arm_m
    if max(abs(part) for part in arm) <= _LONGEST_ARM_M:
        return []
    found = ", ".join(f"{part:g}" for part in arm) + " m"
    why = "metres, not centimetres: forward, right, down; every position is off by what is wrong"
    return [_odd("camera.lever_arm_m", found, f"within {_LONGEST_ARM_M:g} m", why)]


def _mount(config: CompanionConfig) -> list[DoctorFinding]:
    camera = config.bridge.camera
    pitch = camera.mount_pitch_deg
    if camera.mount != "fixed" or abs(pitch) >= _STEEP_ENOUGH_DEG:
        return []
    why = "a fixed camera that looks to the horizon; in degrees, not radians: -90 is straight down"
    return [_odd("bridge.camera.mount_pitch_deg", f"{pitch:g}", "-10 to -90", why)]


def _lens(config: CompanionConfig) -> list[DoctorFinding]:
    model = config.camera.model
    wide = math.degrees(2.0 * math.atan(0.5 * model.width / model.fx))
    if wide <= _WIDEST_DEG:
        return []
    why = f"fx {model.fx:g} on {model.width} pixels: pixels, not millimetres, and no fisheye"
    return [_odd("camera.model", f"{wide:.0f} degrees wide", f"<= {_WIDEST_DEG:g}", why)]


def _milliseconds(config: CompanionConfig) -> list[DoctorFinding]:
    told = {
        "camera.model.readout_ms": config.camera.model.readout_ms,
        "camera.settings.latency_ms": config.camera.settings.latency_ms,
        "targets.operator_delay_ms": config.targets.operator_delay_ms,
        "bridge.injection.delay_ms": config.bridge.injection.delay_ms,
    }
    why = "milliseconds, not seconds"
    return [
        _odd(name, f"{value:g}", f"0, or >= {_SHORTEST_MS:g}", why)
        for name, value in told.items()
        if 0.0 < value < _SHORTEST_MS
    ]


def _odd(name: str, found: str, needed: str, why: str) -> DoctorFinding:
    return DoctorFinding(name, found, needed, why, False, False)
