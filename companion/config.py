"""The deployment's configuration: one YAML file, checked as a whole before anything starts."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, field_validator

from companion.detections import parse_host_port
from companion.errors import ConfigError
from companion.settings_file import SettingsError, read_settings, validated
from companion.sources.base import SourceSettings
from localizer.camera import Camera
from localizer.config import LocalizerConfig
from localizer.errors import CameraError
from mavlink_bridge.config import BridgeConfig


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class CameraModel(_Model):
    """Intrinsics in pixels of the stream as it arrives (pixel centres at + 0.5)."""

    width: int = Field(ge=8, le=8192)
    height: int = Field(ge=8, le=8192)
    fx: float = Field(gt=0)
    fy: float = Field(gt=0)
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = Field(
        (0.0, 0.0, 0.0, 0.0, 0.0), description="Brown: k1 k2 p1 p2 k3"
    )

    def camera(self) -> Camera:
        """As the geometry type."""
        return Camera(self.width, self.height, self.fx, self.fy, self.cx, self.cy, self.distortion)


Arm = Annotated[float, Field(ge=-20.0, le=20.0)]  # metres; larger ones were given in cm or mm


class FeedConfig(_Model):
    """Where the video comes from. How the camera is mounted stands under ``bridge.camera``."""

    source: str = Field(description="udp://, rtsp://, /dev/videoN, a video file or a folder")
    model: CameraModel
    lever_arm_m: tuple[Arm, Arm, Arm] = Field(
        (0.0, 0.0, 0.0), description="camera from the autopilot, body axes: forward right down"
    )
    settings: SourceSettings = SourceSettings()


class TargetConfig(_Model):
    """Target geo-localization."""

    detections: str | None = Field(None, description="host:port where pixel detections arrive")
    rate_hz: float = Field(5.0, gt=0, le=30, description="reports per second and target")
    pixel_sigma: float = Field(1.5, gt=0, description="error of a detection, pixels")
    map_sigma_m: float = Field(0.3, gt=0, description="error of the map's surface, metres")

    @field_validator("detections")
    @classmethod
    def _is_an_address(cls, value: str | None) -> str | None:
        if value is not None:
            try:
                parse_host_port(value)
            except ConfigError as error:
                raise ValueError(str(error)) from error
        return value


class PriorConfig(_Model):
    """How well the autopilot's own position is believed when tracking (re)starts from it."""

    position_sigma_m: float = Field(5.0, gt=0)
    rotation_sigma_deg: float = Field(4.0, gt=0)


class RecordConfig(_Model):
    """What is kept of a flight."""

    folder: Path = Field(description="estimates, targets, events, health and snapshots")
    snapshot_interval_s: float | None = Field(
        10.0, gt=0, description="a video frame is kept this often; none: never"
    )


class CompanionConfig(_Model):
    """One deployment."""

    map: Path = Field(description="tile cache made by `companion map build`")
    camera: FeedConfig
    localizer: LocalizerConfig = LocalizerConfig()
    bridge: BridgeConfig = BridgeConfig()
    targets: TargetConfig = TargetConfig()
    prior: PriorConfig = PriorConfig()
    record: RecordConfig | None = None


def load_config(path: Path) -> CompanionConfig:
    """Read and check a configuration file; relative paths are relative to that file."""
    config = parse_config(read_settings(path, ConfigError), str(path))
    return _resolve(config, path.parent)


def parse_config(data: dict[str, Any], where: str) -> CompanionConfig:
    """Check a configuration given as plain data; `where` names it in errors."""
    try:
        config = validated(CompanionConfig, data)
        config.camera.model.camera()
    except SettingsError as error:
        count = len(str(error).splitlines())
        raise ConfigError(f"{where}: {count} problem(s)\n{error}") from error
    except CameraError as error:
        raise ConfigError(f"{where}: camera.model: {error}") from error
    return config


def _resolve(config: CompanionConfig, folder: Path) -> CompanionConfig:
    localizer = config.localizer
    if localizer.model is not None:
        localizer = localizer.model_copy(update={"model": folder / localizer.model})
    record = config.record
    if record is not None:
        record = record.model_copy(update={"folder": folder / record.folder})
    camera = config.camera
    if "://" not in camera.source:  # a device, a file or a folder
        camera = camera.model_copy(update={"source": str(folder / camera.source)})
    update = {
        "map": folder / config.map,
        "camera": camera,
        "localizer": localizer,
        "bridge": _resolve_bridge(config.bridge, folder),
        "record": record,
    }
    return config.model_copy(update=update)


def _resolve_bridge(bridge: BridgeConfig, folder: Path) -> BridgeConfig:
    update: dict[str, Any] = {}
    if bridge.tlog is not None:
        update["tlog"] = folder / bridge.tlog
    for name in ("signing", "ground_signing"):
        signing = getattr(bridge, name)
        if signing is not None:
            key_file = folder / signing.key_file
            update[name] = signing.model_copy(update={"key_file": key_file})
    return bridge.model_copy(update=update)
