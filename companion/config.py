"""The deployment's configuration: one YAML file, checked completely before anything starts."""

from __future__ import annotations

import math
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, Field, field_validator, model_validator

from companion.errors import ConfigError
from companion.integrity_monitor.config import IntegrityMonitorConfig
from companion.live.config import ConsoleConfig
from companion.settings_file import SettingsError, read_settings, validated, with_current_keys
from companion.sources.base import SourceSettings
from companion.sources.zoom import ZoomTable
from companion.targets.detections import CLICKED, parse_host_port
from localizer.config import LocalizerConfig
from localizer.errors import CameraError
from localizer.geometry.camera import MAX_READOUT_MS, Camera, lens_fault
from localizer.geometry.lens import LensModel, whole_coefficients
from localizer.map.kind import MapKind
from localizer.sensors.error_model import SENSORS
from mavlink_bridge.config import BridgeConfig, StrictModel

_ModelT = TypeVar("_ModelT", bound=BaseModel)
_FIELDS_OF_VIEW_DEG = (1.0, 170.0)
_MOST_PX = 8192  # of a side of a stream's picture
_CENTRAL = (0.1, 0.9)  # share of the picture in which the principal point must lie
_SQUAREST = 1.5  # between fx and fy: pixels of 4:3 and 16:11 are the oddest in use


class CameraModel(StrictModel):
    """Intrinsics in pixels of the stream as it arrives (pixel centres at + 0.5)."""

    width: int = Field(ge=8, le=_MOST_PX, description="of the stream, pixels")
    height: int = Field(ge=8, le=_MOST_PX, description="likewise")
    fx: float = Field(gt=0, description="focal length, pixels")
    fy: float = Field(gt=0, description="likewise")
    cx: float = Field(description="principal point, pixels; centre of the first pixel: 0.5")
    cy: float = Field(description="likewise")
    distortion: tuple[float, ...] = Field(
        (0.0, 0.0, 0.0, 0.0, 0.0),
        description="opencv: k1 k2 p1 p2 k3, or 8, 12, 14 of OpenCV's; fisheye: k1 k2 k3 k4",
    )
    distortion_model: LensModel = Field("opencv", description="fisheye: Kannala-Brandt")
    readout_ms: float = Field(
        0.0, ge=0, le=MAX_READOUT_MS, description="rolling shutter: first row to last; 0: global"
    )

    @model_validator(mode="after")
    def _is_a_lens(self) -> CameraModel:
        """Refuse intrinsics in millimetres, in shares of the width, or with a typing error."""
        low, high = _FIELDS_OF_VIEW_DEG
        for name, side, f in (("fx", self.width, self.fx), ("fy", self.height, self.fy)):
            fov_deg = math.degrees(2.0 * math.atan(0.5 * side / f))
            if not low <= fov_deg <= high:
                raise ValueError(
                    f"{name} {f:g} on {side} pixels is a field of view of {fov_deg:.3g} degrees; "
                    "give the focal length in pixels"
                )
        if not 1.0 / _SQUAREST <= self.fx / self.fy <= _SQUAREST:
            raise ValueError(
                f"fx {self.fx:g} and fy {self.fy:g} are of pixels that no camera has; of one lens "
                "they are nearly the same"
            )
        for name, side, c in (("cx", self.width, self.cx), ("cy", self.height, self.cy)):
            if not _CENTRAL[0] * side <= c <= _CENTRAL[1] * side:
                raise ValueError(
                    f"{name} {c:g} is far from the middle of {side} pixels; give the principal "
                    "point in pixels"
                )
        try:
            fault = lens_fault(self.camera())
        except CameraError as error:
            raise ValueError(str(error)) from error
        if fault:
            raise ValueError(fault)
        return self

    def camera(self) -> Camera:
        """The camera model as the geometry's type."""
        return Camera(
            self.width, self.height, self.fx, self.fy, self.cx, self.cy,
            whole_coefficients(self.distortion_model, self.distortion), self.readout_ms,
            self.distortion_model,
        )  # fmt: skip


def of_stream_size(camera: Camera) -> Camera:
    """A photo's camera, resampled to at most 8192 px a side, the limit of a `CameraModel`."""
    share = _MOST_PX / max(camera.width, camera.height)
    if share >= 1.0:
        return camera
    return camera.resized(round(share * camera.width), round(share * camera.height))


OLD_CALIBRATION_DAYS = 90
Arm = Annotated[float, Field(ge=-20.0, le=20.0)]  # metres; larger ones were given in cm or mm


class FeedConfig(StrictModel):
    """Source of the video. The camera's mounting is in ``bridge.camera``."""

    source: str = Field(
        description="udp:// (MPEG-TS, RTP, H.264), .sdp file, rtsp://, /dev/videoN, video or folder"
    )
    model: CameraModel
    calibrated: date | None = Field(
        None, description="date of the last calibration of model or mounting; null: never"
    )
    lever_arm_m: tuple[Arm, Arm, Arm] = Field(
        (0.0, 0.0, 0.0), description="camera from the autopilot, body axes forward, right, down"
    )
    zoom: ZoomTable | None = Field(
        None, description="focal length by reported zoom; null: always that of `model`"
    )
    settings: SourceSettings = SourceSettings()

    def is_calibrated(self, today: date) -> bool:
        """Whether the last calibration is at most 90 days old: focus, temperature and shocks change
        a camera. False if it was never calibrated, or if `today` (the computer's clock) is before.
        """
        if self.calibrated is None:
            return False
        return 0 <= (today - self.calibrated).days <= OLD_CALIBRATION_DAYS

    @property
    def is_video(self) -> bool:
        """Whether the frames come in packets: False only if `source` is now an existing folder."""
        return "://" in self.source or not Path(self.source).is_dir()

    @model_validator(mode="after")
    def _sender_is_of_udp(self) -> FeedConfig:
        udp = self.source.startswith(("udp://", "rtp://")) or self.source.endswith(".sdp")
        if self.settings.sender is not None and not udp:
            raise ValueError(
                "settings.sender chooses among the senders of a udp:// feed; this source has none: "
                "remove it"
            )
        return self


class DetectorConfig(StrictModel):
    """An object detector in the companion's own process."""

    model: Path = Field(description="ONNX file of a YOLO network")
    labels: tuple[str, ...] = Field((), description="class names; default: those in the file")
    classes: tuple[str, ...] = Field((), description="reported classes; default: all")
    threshold: float = Field(0.4, gt=0, lt=1, description="smallest reported score")
    layout: Literal["v5", "v8", "end2end"] | None = Field(
        None, description="output layout; null: by its shape"
    )
    rate_hz: float = Field(2.0, ge=0.05, le=30, description="largest frame rate")
    duty: float = Field(0.3, gt=0, le=1, description="largest share of one core")

    @field_validator("labels")
    @classmethod
    def _are_names(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for label in value:
            is_name = 0 < len(label) <= 48 and label.isprintable()
            if not is_name or f"{label} ".startswith(CLICKED):  # a number may follow
                raise ValueError(
                    f"{label!r}: a name has 1 to 48 printable characters, and those that begin "
                    f"with {' or '.join(map(repr, CLICKED))} are the operator's clicks"
                )
        return value


class TargetConfig(StrictModel):
    """Target geo-localization."""

    detections: str | None = Field(None, description="host:port for pixel detections")
    detector: DetectorConfig | None = Field(None, description="detection network; null: none")
    rate_hz: float = Field(5.0, ge=0.01, le=30, description="reports per second and target")
    pixel_sigma: float = Field(1.5, exclude=True)  # error of a detection, pixels
    map_sigma_m: float = Field(SENSORS.map_m, exclude=True)  # error of the map's surface, metres
    outline_sigma_m: float = Field(0.5, exclude=True)  # error of roof and crown outlines, m
    bias_sigma_m: float = Field(0.2, exclude=True)  # common error of all targets of a flight, m
    max_sigma_m: float = Field(50.0, exclude=True)  # largest reported sigma, m
    # time that detections must agree before the first report
    confirm_s: float = Field(0.5, exclude=True)
    operator_delay_ms: float = Field(
        250.0,
        ge=0,
        le=5000,
        description="exposure to the operator's click, with the video link",
    )
    operator_delay_sigma_ms: float = Field(100.0, exclude=True)  # its error, 1 sigma
    # time outside the image after which a clicked target ends
    timeout_s: float = Field(300.0, exclude=True)

    def for_map(self, kind: MapKind) -> TargetConfig:
        """A copy whose `map_sigma_m` allows for the roofs and crowns that such a map lacks."""
        sigma_m = max(self.map_sigma_m, kind.unknown_height_sigma_m)
        return self.model_copy(update={"map_sigma_m": sigma_m})

    @field_validator("detections")
    @classmethod
    def _is_an_address(cls, value: str | None) -> str | None:
        if value is not None:
            try:
                parse_host_port(value)
            except ConfigError as error:
                raise ValueError(str(error)) from error
        return value


class RecordConfig(StrictModel):
    """What is recorded of a flight."""

    folder: Path = Field(description="folder of the record")
    snapshot_interval_s: float | None = Field(
        10.0, ge=0.001, le=86400, description="interval of kept frames; null: none"
    )


class KlvConfig(StrictModel):
    """The forwarded video with the pose of each frame (MISB ST 0601)."""

    output: str = Field(
        pattern=r"^udp://[^\s/@?]+:[0-9]{1,5}(\?.*)?$", description="udp://HOST:PORT, MPEG-TS"
    )
    mission: str = Field("", max_length=127, description="mission name in each packet")
    hold_ms: float = Field(200.0, exclude=True)  # longest time that a frame waits for its pose


class CompanionConfig(StrictModel):
    """All settings of one deployment."""

    map: Path = Field(description="tile cache made by `companion map build`")
    map_sha256: str | None = Field(
        None,
        pattern=r"^[0-9a-fA-F]{64}$",
        description="hash of the map's manifest (`companion map verify`); null: any map",
    )
    map_max_age_days: int = Field(
        730, ge=1, le=36500, description="age of the imagery beyond which preflight checks warn"
    )
    camera: FeedConfig
    localizer: LocalizerConfig = LocalizerConfig()
    bridge: BridgeConfig = BridgeConfig()
    targets: TargetConfig = TargetConfig()
    integrity_monitor: IntegrityMonitorConfig = IntegrityMonitorConfig()
    record: RecordConfig | None = None
    state_dir: Path | None = Field(
        None,
        description="folder of what a restart reads: enabled injection, last position, MAVLink "
        "time stamps; null: beside the record's folder, and beside the keys",
    )
    klv: KlvConfig | None = Field(
        None, description="forward the video with KLV metadata; null: off"
    )
    console: ConsoleConfig | None = Field(
        None, description="operator's page (extra `console`); null: none"
    )

    @property
    def state_folder(self) -> Path | None:
        """Folder of what a restart reads (injection, last position): `state_dir`, or that in which
        the record's folder lies. None if both are null: nothing is stored.
        """
        if self.state_dir is not None or self.record is None:
            return self.state_dir
        return self.record.folder.parent


def load_config(path: Path) -> CompanionConfig:
    """Read and check a configuration file; relative paths are relative to that file. `ConfigError`
    if the file cannot be read or is not valid.
    """
    config = parse_config(read_settings(path, ConfigError), str(path))
    try:
        return resolved(config, path.parent)
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from error


def parse_config(data: dict[str, Any], where: str) -> CompanionConfig:
    """Check a configuration given as plain data; `where` names it in errors and in the warnings
    about old keys. Paths stay as given (`resolved`). `ConfigError` lists all problems.
    """
    try:
        return validated(CompanionConfig, with_current_keys(CompanionConfig, data, where))
    except SettingsError as error:
        count = len(str(error).splitlines())
        raise ConfigError(f"{where}: {count} problem(s)\n{error}") from error


def resolved(config: CompanionConfig, folder: Path) -> CompanionConfig:
    """A copy whose relative paths start at `folder`. Sets also where signed links store their time
    stamps (in `state_dir`). ValueError for an empty path; whether a file exists is not checked.
    """
    camera = config.camera
    if "://" not in camera.source:  # a device, a file or a folder
        source = _path(folder, Path(camera.source), "camera.source")
        camera = camera.model_copy(update={"source": str(source)})
    found = _with_paths(config, folder, "")
    bridge = _with_state_files(found.bridge, found.state_dir)
    return found.model_copy(update={"camera": camera, "bridge": bridge})


def _with_paths(model: _ModelT, folder: Path, section: str) -> _ModelT:
    """A copy whose paths start at `folder`, those of nested models included. section: for errors,
    with a dot at its end; "" for the whole deployment.
    """
    update: dict[str, Any] = {}
    for name, value in model:
        if isinstance(value, BaseModel):
            update[name] = _with_paths(value, folder, f"{section}{name}.")
        elif isinstance(value, Path):
            update[name] = _path(folder, value, f"{section}{name}")
    return model.model_copy(update=update)


def _with_state_files(bridge: BridgeConfig, state_dir: Path | None) -> BridgeConfig:
    update: dict[str, Any] = {}
    for name, link in (("signing", "fc"), ("ground_signing", "ground")):
        signing = getattr(bridge, name)
        if signing is not None:
            seen = state_dir and state_dir / f"{signing.key_file.name}.{link}.seen"
            update[name] = signing.model_copy(update={"state_file": seen})
    return bridge.model_copy(update=update)


def _path(folder: Path, given: Path, key: str) -> Path:
    """A path below `folder`; ValueError for an empty one, which would be the folder itself."""
    if given == Path() or "\0" in str(given):
        raise ValueError(f"{key}: {str(given)!r} names no file and no folder")
    return folder / given
