"""All MAVLink code. It uses no images."""

from mavlink_bridge.bridge import Bridge
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.errors import BridgeError
from mavlink_bridge.messages import (
    Attitude,
    CameraView,
    GimbalAttitude,
    HealthLevel,
    Origin,
    TargetReport,
    TrackRequest,
    VehicleState,
    VisionFix,
)

__all__ = [
    "Attitude",
    "Bridge",
    "BridgeConfig",
    "BridgeError",
    "CameraView",
    "GimbalAttitude",
    "HealthLevel",
    "Origin",
    "TargetReport",
    "TrackRequest",
    "VehicleState",
    "VisionFix",
]
