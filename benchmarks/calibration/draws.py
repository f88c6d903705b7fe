"""What is wrong with one aircraft, and its three-minute shadow flight, on a simulated clock."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.calibration.desk.film import (
    EstimateWithTruth,
    Exposed,
    Eye,
    exposures,
    write_record,
)
from benchmarks.calibration.desk.flight import Corner, DeskAircraft, DeskFlight, DeskFlightRecord
from benchmarks.calibration.desk.port import RecordedPort
from companion.config import CompanionConfig, load_config
from companion.geometry import Mount
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, matrix_from_euler
from localizer.map.cache.cache import TileCache
from localizer.synth.appearance.model import sample_appearance
from sitl.camera.movers import traffic
from sitl.camera.pose_sender import GimbalError
from sitl.camera.realism import CameraRealism
from sitl.demo.assets import FlightAssets
from sitl.demo.flight import home_of
from sitl.demo.scenario import CameraSpec

SECONDS, RATE_HZ = 180.0, 1.5
_LOW_M = 35.0
_BOOT_NS, _UTC_NS = 1_000_000_000_000, 1_790_000_000_000_000_000


@dataclass(frozen=True)
class Draw:
    """The errors of a deployment: what is true less what it says. focal: share; principal_px: (2,);
    bend: k1, k2, p1, p2; late_s: of the stamps; mount_deg: roll, pitch, yaw of the camera on its
    gimbal; arm_m: (3,); shift_m: (3,) east, north, up that the map lies beside the ground.
    """

    focal: float
    principal_px: tuple[float, float]
    bend: tuple[float, float, float, float]
    late_s: float
    mount_deg: tuple[float, float, float]
    arm_m: tuple[float, float, float]
    shift_m: tuple[float, float, float]
    readout_ms: float


def drawn(seed: int) -> Draw:
    """Uniform over what the issue states: focal 3 %, boresight 3 deg, time 150 ms, map 3 m; the
    rest as the honest world has it (`sitl.demo.scenario.ErrorSpec`).
    """
    rng = np.random.default_rng([seed, 71])
    focal, late_s = rng.uniform(-0.03, 0.03), rng.uniform(-0.15, 0.15)
    mount, shift = rng.uniform(-3.0, 3.0, 3), rng.uniform(-3.0, 3.0, 3)
    shift[2] *= 0.3
    principal, arm = rng.normal(0.0, 0.7, 2), rng.normal(0.0, 0.05, 3)
    bend = rng.normal(0.0, 0.003, 4) * (1.0, 1.0, 0.1, 0.1)
    readout_ms = rng.normal(0.0, 1.0)
    return Draw(
        float(focal), tuple(principal.tolist()), tuple(bend.tolist()), float(late_s),
        tuple(mount.tolist()), tuple(arm.tolist()), tuple(shift.tolist()), float(readout_ms),
    )  # fmt: skip


def true_camera(spec: CameraSpec, draw: Draw) -> Camera:
    """The camera that takes the pictures; the deployment has the scenario's."""
    c = spec.camera()
    k = np.add(c.distortion, (*draw.bend, 0.0))
    return Camera(
        c.width, c.height, c.fx * (1 + draw.focal), c.fy * (1 + draw.focal),
        c.cx + draw.principal_px[0], c.cy + draw.principal_px[1],
        (float(k[0]), float(k[1]), float(k[2]), float(k[3]), float(k[4])),
        max(c.readout_ms + draw.readout_ms, 0.0),
    )  # fmt: skip


def true_mount(draw: Draw, gimbal: GimbalError) -> Array:
    """(3, 3): camera to gimbal as it is, with what the gimbal's own alignment adds to it."""
    roll, pitch, _ = np.radians(gimbal.alignment_deg)
    rotation: Array = matrix_from_euler(roll, pitch, 0.0) @ matrix_from_euler(
        *np.radians(draw.mount_deg)
    )
    return rotation


def corners(seed: int) -> tuple[Corner, ...]:
    """A way with turns, heights and gimbal angles, as the manual asks a calibration flight to be:
    at first a climb.
    """
    rng = np.random.default_rng([seed, 72])
    made = [Corner(0.0, 0.0, 60.0, -80.0)]
    bearing = rng.uniform(0, 2 * np.pi)
    at = np.zeros(2)
    pitches = (-90.0, -60.0, -75.0, -50.0, -85.0, -65.0, -90.0, -55.0, -70.0, -80.0, -60.0, -90.0)
    for k, pitch in enumerate(pitches * 2):
        if k % 3 == 2:
            bearing = np.arctan2(*(-at)[::-1]) + rng.uniform(-0.5, 0.5)  # back towards home
        else:
            bearing += rng.choice([-1, 1]) * rng.uniform(1.0, 2.4)
        at = at + rng.uniform(60.0, 110.0) * np.array([np.cos(bearing), np.sin(bearing)])
        made.append(Corner(float(at[0]), float(at[1]), float(rng.uniform(60, 125)), pitch))
    return tuple(made)


@dataclass(frozen=True)
class Sortie:
    """One flight on disk. deployment: what was told of the aircraft."""

    folder: Path
    deployment: CompanionConfig
    flown: DeskFlightRecord
    eye: Eye

    @property
    def clocks(self) -> tuple[int, int]:
        """Begin of the record, and UTC less the monotonic clock, ns."""
        return _BOOT_NS, _UTC_NS

    def pictures(self, seed: int) -> Iterator[Exposed]:
        """As the camera takes them."""
        return exposures(self.eye, self.flown, TileCache.open(self.deployment.map), seed)

    def localized(self, config: CompanionConfig, seed: int, keep: bool) -> list[EstimateWithTruth]:
        """The pictures localized under a deployment."""
        tlog = self.folder / "flight.tlog"
        return write_record(self.pictures(seed), config, tlog, self.clocks, keep)


def fly(
    assets: FlightAssets, draw: Draw, seed: int, folder: Path, *, gimbal: GimbalError,
    seconds: float = SECONDS,
) -> Sortie:  # fmt: skip
    """The flight of a seed with a drawn aircraft; the seed draws its way, wind and sensors."""
    folder.mkdir(parents=True, exist_ok=True)
    cache = TileCache.open(assets.map_cache)
    spec = CameraSpec()
    port = RecordedPort(folder / "flight.tlog", _BOOT_NS, _UTC_NS, seed)
    aircraft = DeskAircraft(
        Mount.from_degrees(*draw.mount_deg, lever_arm_m=draw.arm_m), gimbal, draw.shift_m
    )
    geoid_m = cache.manifest.geoid_separation_m
    try:
        flight = DeskFlight(home_of(assets), aircraft, port, cache.frame, geoid_m, seed)
        flown = flight.fly(corners(seed), _LOW_M, seconds)
    finally:
        port.close()
    look = sample_appearance(np.random.default_rng([seed, 11]), "day")
    movers = traffic(assets.world, cache.frame, cars=20, people=20, seed=seed)
    camera = true_camera(spec, draw)
    realism = CameraRealism(
        camera.readout_ms, spec.vibration_deg, spec.auto_exposure, spec.supersample,
        stamp_offset_ms=1e3 * draw.late_s, stamp_jitter_ms=2.0,
    )  # fmt: skip
    eye = Eye(assets.live_cache, camera, look, realism, movers, RATE_HZ)
    return Sortie(folder, deployment(folder, assets, spec), flown, eye)


def deployment(folder: Path, assets: FlightAssets, spec: CameraSpec) -> CompanionConfig:
    """What the operator wrote: the data sheet's camera, nothing corrected."""
    config: dict[str, Any] = {
        "map": str(assets.map_cache.resolve()),
        "camera": {"source": "udp://127.0.0.1:5600", "model": spec.camera().to_dict()},
        "bridge": {
            "connection": "udpin:127.0.0.1:14550", "mode": "shadow",
            "tlog": str((folder / "flight.tlog").resolve()),
        },
        "record": {"folder": str((folder / "record").resolve()), "snapshot_interval_s": 0.001},
    }  # fmt: skip
    path = folder / "deployment.yaml"
    path.write_text(yaml.safe_dump(config, sort_keys=False))
    return load_config(path)
