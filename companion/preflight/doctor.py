"""All checks of `companion doctor`: the bridge's, and map, model, camera, settings and machine."""

from __future__ import annotations

import math
import os
import socket
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime, timezone
from pathlib import Path

from companion.config import CompanionConfig
from companion.errors import CompanionError, DetectorError, redacted
from companion.preflight.coverage import (
    check_heights,
    check_mission,
    check_origin,
    check_vehicle_position,
)
from companion.preflight.map_pin import require_pinned
from companion.sources import StreamState, open_source
from companion.targets.detections import parse_host_port
from companion.targets.detector.network import DetectorNetwork
from localizer.errors import LocalizerError
from localizer.features.extractor import load_extractor
from localizer.geometry.geo import LocalFrame
from localizer.map.cache.cache import TileCache
from localizer.map.inspection.kind import map_kind
from localizer.map.kind import MapKind
from localizer.tracking.opening import MapStack, build_localizer
from mavlink_bridge.errors import BridgeError
from mavlink_bridge.link.signing import load_key
from mavlink_bridge.preflight.client import download_mission
from mavlink_bridge.preflight.doctor import Diagnosis, examine
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


def check_places(config: CompanionConfig) -> list[DoctorFinding]:
    """Findings on the folders, signing keys and console files that the configuration names: a
    flight would not start if one cannot be written or read.
    """
    bridge = config.bridge
    written = {"bridge.tlog": bridge.tlog}
    faults = []
    if config.record is not None:
        faults.append(_unwritable("record.folder", config.record.folder))
    if config.state_dir is not None:
        faults.append(_unwritable("state_dir", config.state_dir))
    faults += [_no_file(key, path) for key, path in written.items() if path is not None]
    keys = {"bridge.signing": bridge.signing, "bridge.ground_signing": bridge.ground_signing}
    for key, signing in keys.items():
        if signing is not None:
            try:
                load_key(signing.key_file)
            except BridgeError as error:
                faults.append(f"{key}: {error}")
    if config.console is not None:
        page = config.console
        read = {"token_file": page.token_file, "tls_certificate": page.tls_certificate}
        for key, path in (read | {"tls_key": page.tls_key}).items():
            if path is not None and not path.is_file():
                faults.append(f"console.{key} {path}: is no file")
    needed = "folders to write to, keys to read"
    return [
        DoctorFinding("files", "unusable", needed, fault, False, True) for fault in faults if fault
    ]


def _no_file(key: str, path: Path) -> str:
    """Why the file cannot be created or written; "" if it can."""
    try:
        if path.is_dir():
            return f"{key} {path}: a folder, not a file"
    except OSError as error:
        return f"{key} {path}: {error.strerror}"
    return _unwritable(key, path.parent)


def _unwritable(key: str, folder: Path) -> str:
    """Why the folder, or its nearest existing parent, cannot be written; "" if it can."""
    try:
        place = folder
        while not place.exists() and place != place.parent:
            place = place.parent
        if not place.is_dir():
            return f"{key} {folder}: {place} is not a folder"
        if not os.access(place, os.W_OK | os.X_OK):
            return f"{key} {folder}: {place} cannot be written"
    except OSError as error:
        return f"{key} {folder}: {error.strerror}"
    return ""


_FEED_S = 8.0  # without any picture
_FEED_ENOUGH_S = 3.0  # of pictures: their rate is known
_MIN_RATE_HZ = 5.0
_GOVERNOR = Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")


def examine_deployment(
    config: CompanionConfig,
    *,
    vehicle: bool = True,
    feed: bool = True,
    say: Callable[[str], None] = lambda _: None,
) -> Diagnosis:
    """Run all checks of a deployment.

    vehicle, feed: False leaves out flight controller or camera. Both are checked in parallel, after
    the localizer, because its compilation would delay the link. say: receives each step as text.
    """
    say("reading the map")
    cache, findings = _check_map(config)
    say("making the localizer; the first time on a machine compiles its kernels")
    findings.append(_check_localizer(config, cache is not None))
    listening = f" and listening to the vehicle at {config.bridge.connection}" if vehicle else ""
    say(f"reading the feed {redacted(config.camera.source)}{listening}")
    with ThreadPoolExecutor(1) as aside:
        camera = aside.submit(_check_camera, config) if feed else None
        diagnosis = examine(config.bridge, say) if vehicle else None
        findings += [*([] if camera is None else [camera.result()]), _check_power()]
    findings += [*check_places(config), *check_plausibility(config)]
    findings += check_ports(config) if feed else []  # beside a flight they are its own
    findings += _check_detector(config)
    if cache is not None and config.bridge.origin is not None:
        findings.append(check_origin(config.bridge.origin, cache))
    if diagnosis is not None:
        found = diagnosis.findings
        findings += found
        if cache is not None and diagnosis.state is not None:
            findings += check_vehicle_position(cache, diagnosis.state)
            findings += check_heights(cache, diagnosis.state)
        if cache is not None and found[0].ok:
            say("reading the mission")
            findings.append(_check_mission(config, cache))
    return Diagnosis(tuple(findings))


def _check_map(config: CompanionConfig) -> tuple[TileCache | None, list[DoctorFinding]]:
    try:
        cache = TileCache.open(config.map)
        require_pinned(config.map, config.map_sha256)
    except (CompanionError, LocalizerError) as error:
        return None, [_failed("map", "unreadable", "a tile cache", str(error))]
    m = cache.manifest
    origin = m.origin
    found = (
        f"{m.tiles} tiles, {m.gsd_m:.2f} m/px, "
        f"{_extent_km(m.extent, cache.frame):.2f} km from corner to corner "
        f"about {origin.latitude_deg:.5f} {origin.longitude_deg:.5f}"
    )
    return cache, [
        DoctorFinding("map", found, "a tile cache", "", True, True),
        *_check_kind(map_kind(cache), config),
    ]


def _check_kind(kind: MapKind, config: CompanionConfig) -> list[DoctorFinding]:
    """Advice on the accuracy that the map allows; one without buildings needs care."""
    why = kind.advice(config.camera.model.camera().horizontal_fov_deg / 2)
    limit = config.map_max_age_days
    age, recent = kind.imagery_age(datetime.now(timezone.utc).date(), limit)
    needed, cost = f"<= {limit} days", "what was built or felled since costs accuracy"
    return [
        DoctorFinding("map's kind", kind.line(), "buildings in the heights", why, not why, False),
        DoctorFinding("map's imagery", age, needed, "" if recent else cost, recent, False),
    ]


def _check_mission(config: CompanionConfig, cache: TileCache) -> DoctorFinding:
    try:
        return check_mission(cache, download_mission(config.bridge))
    except BridgeError as error:
        return DoctorFinding("mission", "not read", "inside the map", str(error), False, False)


def _extent_km(extent: Iterable[tuple[float, float]], frame: LocalFrame) -> float:
    """Largest distance between two corners of the (latitude, longitude) outline."""
    points = [frame.enu_from_geodetic(a, b, frame.origin.height_m) for a, b in extent]
    distances = [float(((p - q) ** 2).sum() ** 0.5) for p in points for q in points]
    return max(distances, default=0.0) / 1000


def _check_localizer(config: CompanionConfig, has_map: bool) -> DoctorFinding:
    """Build the localizer as a flight does, with its model, renderer and device."""
    needed = "a feature network"
    try:
        model = config.localizer.model
        name = _localizer_name(config) if has_map else load_extractor(model).name
    except LocalizerError as error:
        return _failed("localizer", "cannot be made", needed, str(error))
    why = "features without training: fetch the shipped weights again"
    return DoctorFinding("localizer", name, needed, why, "fallback" not in name, False)


def _check_detector(config: CompanionConfig) -> list[DoctorFinding]:
    """Load the detection network, which a flight needs to start; [] without one."""
    if config.targets.detector is None:
        return []
    needed = "a detection network"
    try:
        network = DetectorNetwork(config.targets.detector)
    except DetectorError as error:
        return [_failed("detector", "cannot be made", needed, str(error))]
    return [DoctorFinding("detector", f"{len(network.labels)} classes", needed, "", True, False)]


def _localizer_name(config: CompanionConfig) -> str:
    stack = MapStack(config.map, config.localizer)
    try:
        localizer = build_localizer(stack, config.camera.model.camera(), config.localizer)
        return f"{localizer.features_name}; {stack.renderer.name}; {localizer.optimizer_name}"
    finally:
        stack.close()


def _check_camera(config: CompanionConfig) -> DoctorFinding:
    """Read the feed for a few seconds, and check size and rate of the frames. A feed without frames
    is read for longer before it is called silent.
    """
    feed = config.camera
    settings = feed.settings.model_copy(update={"realtime": True})
    told: list[str] = []

    def on_state(state: StreamState, text: str) -> None:
        if state is StreamState.STALLED:
            told.append(text)

    try:
        source = open_source(feed.source, feed.model.camera(), settings, on_state)
    except (CompanionError, LocalizerError) as error:
        return _failed("camera", "no feed", "frames", str(error))
    times: list[int] = []
    seen = camera = feed.model.camera()
    timer = threading.Timer(_FEED_S, source.close)
    timer.start()
    try:
        for frame in source.frames():
            times.append(frame.exposure_time_ns)
            seen = frame.camera
            if times[-1] - times[0] > _FEED_ENOUGH_S * 1e9:
                break
    except (CompanionError, LocalizerError) as error:
        return _failed("camera", "refused", "frames of the calibrated size", str(error))
    finally:
        timer.cancel()
        source.close()
    if len(times) < 2:
        where = redacted(feed.source)
        why = f"no frames from {where} in {_FEED_S:.0f} s: "
        why += told[-1].removeprefix(f"{where}: ") if told else "is the stream running?"
        return _failed("camera", "silent", "frames", why)
    rate = (len(times) - 1) / max((times[-1] - times[0]) * 1e-9, 1e-9)
    found = f"{seen.width}x{seen.height}, {rate:.1f} Hz"
    needed = f"{camera.width}x{camera.height}, >= {_MIN_RATE_HZ:.0f} Hz"
    if rate < 0.95 * _MIN_RATE_HZ:  # measured over a few seconds
        return DoctorFinding("camera", found, needed, "tracking follows turns by it", False, True)
    scaled = seen != camera
    why = "the calibration is scaled: wrong if the camera crops or zooms" if scaled else ""
    return DoctorFinding("camera", found, needed, why, not scaled, False)


def _check_power() -> DoctorFinding:
    try:
        governor = _GOVERNOR.read_text().strip()
    except OSError:
        return DoctorFinding(
            "power mode", "not reported by this machine", "performance", "", True, False
        )
    good = governor in ("performance", "schedutil")
    why = "slower clocks make late fixes (Jetson: nvpmodel -m 0, jetson_clocks)"
    return DoctorFinding("power mode", governor, "performance", why, good, False)


def _failed(name: str, found: str, needed: str, why: str) -> DoctorFinding:
    return DoctorFinding(name, found, needed, why, False, True)
