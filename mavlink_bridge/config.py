"""The bridge's configuration, checked when it is read (pydantic, frozen, no unknown keys)."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from mavlink_bridge.errors import EndpointError
from mavlink_bridge.link.transport import Endpoint, parse_sender

InjectionMessage = Literal[
    "vision_position_estimate",
    "odometry",
    "gps_input",
    "global_position_sensor",
    "external_position_estimate",
]
WITHOUT_SOURCE_SET = ("external_position_estimate", "global_position_sensor")
Mode = Literal["off", "shadow", "inject", "rc"]


class StrictModel(BaseModel):
    """Settings that are read once: no unknown key, no infinity, no change."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class OriginConfig(StrictModel):
    """The EKF origin to set if the vehicle has none: WGS84 degrees and metres AMSL.

    ArduPilot ignores a second origin, so an existing origin is kept. Give the altitude of the
    take-off ground, where the barometer reads zero.
    """

    latitude_deg: float = Field(ge=-90.0, le=90.0)
    longitude_deg: float = Field(ge=-180.0, le=180.0)
    altitude_amsl_m: float = Field(ge=-500.0, le=9000.0)


class InjectionConfig(StrictModel):
    """What is sent to the flight controller, how often, and when output is held."""

    message: InjectionMessage = Field(
        default="vision_position_estimate", description="MAVLink message that holds a fix"
    )
    rate_hz: float = Field(default=20.0, ge=4.0, le=30.0, description="messages per second")
    delay_ms: float = Field(
        default=100.0,
        ge=0.0,
        le=250.0,
        description="age at which a fix is sent: VISO_DELAY_MS, or GPSn_DELAY_MS, n = gps_id + 1",
    )
    sigma_floor_m: float = Field(0.1, exclude=True)
    max_sigma_m: float = Field(10.0, exclude=True)  # largest sigma that is sent
    alert_limit_m: float = Field(
        default=10.0,
        gt=0.0,
        le=1000.0,
        description="largest protection level of an injected fix, m",
    )
    time_to_alert_s: float = Field(
        default=3.0,
        ge=0.2,
        le=60.0,
        description="output stops after so long above alert_limit_m, after 1 s at most",
    )
    max_extrapolation_s: float = Field(0.5, exclude=True)  # longest propagation over a gap
    # missing fix intervals after which nothing is sent
    overdue_intervals: float = Field(2.0, exclude=True)
    acceleration_sigma_mps2: float = Field(2.0, exclude=True)
    force: bool = Field(
        default=False,
        description="inject and switch without a passed shadow check, with a warning",
    )
    map_shift: Literal["tell", "apply"] = Field(
        default="tell",
        description="map offset against GNSS; apply: fixes are corrected by it",
    )
    send_attitude: bool = Field(
        default=True, description="false: NaN angles in VISION_POSITION_ESTIMATE"
    )
    gps_id: int = Field(default=0, ge=0, le=3, description="0-based GPS instance of GPS_INPUT")
    gps_velocity: bool = Field(default=True, description="GPS_INPUT holds a velocity")
    gps_yaw: bool = Field(default=False, description="GPS_INPUT holds a yaw")

    @model_validator(mode="after")
    def _rate_suits_message(self) -> InjectionConfig:
        if self.message == "gps_input" and self.rate_hz < 5.0:
            raise ValueError("gps_input needs rate_hz >= 5 (ArduPilot: GPS not healthy below)")
        return self


class SourceSwitchConfig(StrictModel):
    """Automatic change of the EKF source set when GNSS is bad (42007)."""

    enabled: bool = Field(
        default=False, description="select the vision set when GNSS is bad (ArduPilot)"
    )
    gnss_set: int = Field(default=1, ge=1, le=3, description="source set that uses GNSS")
    vision_set: int = Field(default=2, ge=1, le=3, description="source set that uses vision")
    bad_after_s: float = Field(1.5, exclude=True)
    return_to_gnss: bool = Field(
        default=False, description="select the GNSS set when GNSS agrees with vision for 5 s"
    )
    inconsistency_sigmas: float = Field(5.0, exclude=True)

    @model_validator(mode="after")
    def _sets_differ(self) -> SourceSwitchConfig:
        if self.gnss_set == self.vision_set:
            raise ValueError("gnss_set and vision_set must be two different source sets")
        return self


class InjectionEnableConfig(StrictModel):
    """In mode ``rc`` an RC channel's pulse width or a command selects shadow or inject."""

    channel: int = Field(
        default=9, ge=1, le=18, description="RC channel that enables injection in mode rc"
    )
    inject_above_us: int = Field(
        default=1700, ge=900, le=2100, description="its pulse width above which injection is on"
    )
    command: Literal["user_1", "user_2", "user_3", "user_4", "user_5"] | None = Field(
        default="user_1",
        description="MAV_CMD_USER_n to localizer_component: param1 1 enables injection, 0 disables",
    )


class CameraConfig(StrictModel):
    """Description of the camera for the ground station, and its mounting."""

    announce: bool = Field(default=True, description="announce a camera to ground stations")
    vendor: str = Field(default="PiLoT companion", max_length=31, description="its vendor name")
    model: str = Field(default="map camera", max_length=31, description="its model name")
    width_px: int = Field(1280, exclude=True)
    height_px: int = Field(720, exclude=True)
    horizontal_fov_deg: float = Field(60.0, exclude=True)
    stream_uri: str = Field(
        default="",
        max_length=159,
        description="video for ground stations: rtsp://..., tcp://..., or udp://...:PORT and "
        "PORT of MPEG-TS; empty: none",
    )
    mount: Literal["gimbal", "fixed"] = Field(
        default="gimbal", description="fixed: mounted on the airframe"
    )
    gimbal_component: int = Field(
        default=0, ge=0, le=255, description="component of the gimbal, if there are several; 0: any"
    )
    gimbal_device: int = Field(
        default=0, ge=0, le=255, description="its gimbal_device_id; 0: the first"
    )
    # rate at which CAMERA_SETTINGS is requested; 0: none
    zoom_rate_hz: float = Field(0.0, exclude=True)
    mount_roll_deg: float = Field(
        default=0.0,
        ge=-180.0,
        le=180.0,
        description="mounting of the camera on the gimbal or airframe",
    )
    mount_pitch_deg: float = Field(
        default=0.0, ge=-180.0, le=180.0, description="nose up; -90 looks down"
    )
    mount_yaw_deg: float = Field(default=0.0, ge=-180.0, le=180.0, description="to the right")

    @property
    def vertical_fov_deg(self) -> float:
        """Vertical field of view, degrees, from the horizontal one and the size; square pixels."""
        half = math.tan(math.radians(self.horizontal_fov_deg) / 2.0)
        return math.degrees(2.0 * math.atan(half * self.height_px / self.width_px))


class TargetsConfig(StrictModel):
    """How targets are reported."""

    rate_hz: float = Field(5.0, exclude=True)
    adsb: bool = Field(default=False, description="ADSB_VEHICLE, on the ground link only")
    captured: bool = Field(
        default=False,
        description="CAMERA_IMAGE_CAPTURED once for each confirmed target: a mark on QGC's map",
    )
    confirmed_sigma_m: float = Field(3.0, exclude=True)  # horizontal sigma of a confirmed target
    cot_endpoint: str = Field(default="", description="host:port of a Cursor-on-Target listener")
    cot_stale_s: float = Field(30.0, exclude=True)
    cot_aircraft: bool = Field(
        default=False,
        description="Cursor-on-Target of the aircraft too, with the camera's wedge and its video",
    )
    cot_callsign: str = Field(
        default="PiLoT",
        min_length=1,
        max_length=32,
        pattern=r"^[\w .-]+$",
        description="callsign, unique on the map",
    )

    @field_validator("cot_endpoint")
    @classmethod
    def _is_host_and_port(cls, value: str) -> str:
        if value:
            _check(Endpoint.parse, f"udpout:{value}", "write host:port")
        return value


class SigningConfig(StrictModel):
    """MAVLink 2 signing: a 32-byte key as 64 hexadecimal digits in a file of mode 0600."""

    key_file: Path = Field(description="file of `companion key`")
    link_id: int = Field(default=1, ge=0, le=255, description="id of this link in signatures")
    # file for the newest stamps; null: FILE.LINK.seen beside the key
    state_file: Path | None = Field(None, exclude=True)

    def state_path(self, link: str) -> Path:
        """File that keeps the newest signed timestamps of a link, "fc" or "ground"."""
        name = f"{self.key_file.name}.{link}.seen"
        return self.state_file or self.key_file.with_name(name)


SystemId = Annotated[int, Field(ge=1, le=255)]


class BridgeConfig(StrictModel):
    """All settings of the bridge.

    connection strings: ``udpin:HOST:PORT``, ``udpout:HOST:PORT``, ``tcp:HOST:PORT``,
    ``tcpin:HOST:PORT``, ``serial:DEVICE:BAUD``.
    """

    connection: str = Field(
        default="udpin:127.0.0.1:14551",
        description="link to the autopilot: udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, "
        "tcpin:HOST:PORT or serial:DEVICE:BAUD",
    )
    ground_connection: str | None = Field(
        default=None, description="link to a ground station; null: through the autopilot"
    )
    mode: Mode = Field(
        default="shadow", description="off: listen; shadow: compare; rc: pilot selects"
    )
    system_id: int | None = Field(
        default=None, ge=1, le=255, description="MAVLink system id; null: the vehicle's"
    )
    sender: str | None = Field(
        default=None,
        description="udpin: accepted sender, ADDRESS or ADDRESS:PORT; null: the first autopilot",
    )
    ground_systems: tuple[SystemId, ...] = Field(
        default=(255,),
        max_length=32,
        description="system ids that may enable injection and start tracking",
    )
    localizer_component: int = Field(
        default=197, ge=2, le=255, description="component id that sends positions"
    )
    companion_component: int = Field(
        default=191, ge=2, le=255, description="component id that sends commands and texts"
    )
    camera_component: int = Field(
        default=100, ge=2, le=255, description="component id of the announced camera"
    )
    look_at: bool = Field(
        default=False,
        description="a ground station may point the gimbal at a position or target",
    )
    named_values: bool = Field(
        default=False,
        description="send quality figures as NAMED_VALUE_FLOAT VPS_* at 1 Hz",
    )
    texts_as_autopilot: bool = Field(
        default=False,
        description="send warnings as the autopilot's component, for MAVProxy",
    )
    attitude_rate_hz: float = Field(50.0, exclude=True)
    injection: InjectionConfig = InjectionConfig()
    origin: OriginConfig | None = Field(
        default=None, description="EKF origin that is set if the vehicle has none; null: never set"
    )
    switch: SourceSwitchConfig = SourceSwitchConfig()
    rc: InjectionEnableConfig = InjectionEnableConfig()
    camera: CameraConfig = CameraConfig()
    targets: TargetsConfig = TargetsConfig()
    signing: SigningConfig | None = Field(
        default=None, description="MAVLink 2 signing of the autopilot's link; null: off"
    )
    ground_signing: SigningConfig | None = Field(
        default=None, description="the same of ground_connection"
    )
    tlog: Path | None = Field(default=None, description="file for all MAVLink frames; null: none")
    # file that keeps enabled injection and a failed shadow check over a restart
    state_file: Path | None = Field(None, exclude=True)
    link_timeout_s: float = Field(5.0, exclude=True)

    @field_validator("mode", mode="before")
    @classmethod
    def _off_is_false_in_yaml(cls, value: object) -> object:
        return "off" if value is False else value

    @field_validator("connection", "ground_connection")
    @classmethod
    def _connection_is_an_endpoint(cls, value: str | None) -> str | None:
        if value is not None:
            _check(Endpoint.parse, value)
        return value

    @field_validator("sender")
    @classmethod
    def _is_a_sender(cls, value: str | None) -> str | None:
        if value is not None:
            _check(parse_sender, value)
        return value

    @model_validator(mode="after")
    def _parts_fit(self) -> BridgeConfig:
        first, second = self.signing, self.ground_signing
        if first and second and first.state_path("fc") == second.state_path("ground"):
            raise ValueError("signing and ground_signing need a state_file each")
        message = self.injection.message
        if self.switch.enabled and message in WITHOUT_SOURCE_SET:
            raise ValueError(
                f"{message} is fused beside GNSS and has no source set: remove switch.enabled"
            )
        components = (self.localizer_component, self.companion_component, self.camera_component)
        if len(set(components)) < 3:
            raise ValueError("localizer, companion and camera need a component id each")
        if self.targets.cot_aircraft and not self.targets.cot_endpoint:
            raise ValueError("targets.cot_aircraft needs targets.cot_endpoint, host:port")
        return self

    @model_validator(mode="after")
    def _links_fit(self) -> BridgeConfig:
        if self.ground_connection == self.connection:
            raise ValueError("ground_connection is the flight controller's; leave it empty")
        if self.sender is not None and not self.connection.startswith("udpin:"):
            raise ValueError(
                f"sender chooses among the senders of a udpin connection; {self.connection} has "
                "one peer: remove it"
            )
        if self.ground_connection is not None:
            return self
        if self.texts_as_autopilot:
            raise ValueError(
                "texts_as_autopilot needs ground_connection: ArduPilot drops what comes back to it "
                "under its own ids"
            )
        if self.targets.adsb:
            raise ValueError(
                "targets.adsb needs ground_connection: ArduPilot ingests ADSB_VEHICLE as traffic"
            )
        return self


def _check(parse: Callable[[str], object], text: str, hint: str = "") -> None:
    try:
        parse(text)
    except EndpointError as error:
        raise ValueError(hint or str(error)) from error
