"""The PiLoT algorithm as a library: no MAVLink, no video transport, no application.

It estimates a camera's pose from its image and a geo-referenced 3D map: `open_localizer` opens a
map that `build_cache` made, `Localizer.set_prior` sets an approximate pose, `Localizer.track`
localizes one frame after the other. examples/ has programs; `__all__` has every public name.
"""

import os

# onnxruntime from 1.31 on reports its use and a device id to its maker, from its import on; only
# this variable, set before that, stops it. An aircraft's computer talks to nobody unasked.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
# OpenBLAS reads this when NumPy is imported. Its worker threads wait in a busy loop: where another
# thread has their core, an eigenvalue problem of 100 rows took 34 ms instead of 1.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from localizer.config import LocalizerConfig
    from localizer.errors import (
        CameraError,
        GeoreferenceError,
        LocalizerError,
        MapCacheError,
        MapError,
        MapSourceError,
        ModelError,
        OutsideMapError,
        PoseFileError,
        RenderError,
    )
    from localizer.geometry.camera import Camera
    from localizer.geometry.geo import Geodetic, LocalFrame
    from localizer.geometry.pose import Pose
    from localizer.geometry.trajectory import (
        PoseRow,
        StampedPose,
        pose_row,
        read_poses,
        read_tum,
        write_poses,
        write_tum,
    )
    from localizer.geometry.trajectory import world_from_camera as pose_of_row
    from localizer.map.building.build import build_cache
    from localizer.map.building.options import BuildOptions
    from localizer.map.inspection.kind import map_kind
    from localizer.map.kind import MapKind
    from localizer.tracking.engine import DualThreadEngine
    from localizer.tracking.opening import open_localizer
    from localizer.tracking.pipeline import Localizer
    from localizer.types import Frame, PoseEstimate, PosePrior, RegistrationStatus, TrackingState

# Imported when they are first used: `import localizer` costs nothing, and who needs geometry alone
# does not load the network's and the kernels' packages.
_HOMES = {
    "Localizer": "localizer.tracking.pipeline",
    "open_localizer": "localizer.tracking.opening",
    "LocalizerConfig": "localizer.config",
    "DualThreadEngine": "localizer.tracking.engine",
    "build_cache": "localizer.map.building.build",
    "BuildOptions": "localizer.map.building.options",
    "MapKind": "localizer.map.kind",
    "map_kind": "localizer.map.inspection.kind",
    "Camera": "localizer.geometry.camera",
    "Pose": "localizer.geometry.pose",
    "Geodetic": "localizer.geometry.geo",
    "LocalFrame": "localizer.geometry.geo",
    "Frame": "localizer.types",
    "PosePrior": "localizer.types",
    "PoseEstimate": "localizer.types",
    "RegistrationStatus": "localizer.types",
    "TrackingState": "localizer.types",
    "PoseRow": "localizer.geometry.trajectory",
    "pose_of_row": "localizer.geometry.trajectory:world_from_camera",
    "pose_row": "localizer.geometry.trajectory",
    "read_poses": "localizer.geometry.trajectory",
    "write_poses": "localizer.geometry.trajectory",
    "StampedPose": "localizer.geometry.trajectory",
    "read_tum": "localizer.geometry.trajectory",
    "write_tum": "localizer.geometry.trajectory",
    "LocalizerError": "localizer.errors",
    "CameraError": "localizer.errors",
    "GeoreferenceError": "localizer.errors",
    "MapCacheError": "localizer.errors",
    "MapError": "localizer.errors",
    "MapSourceError": "localizer.errors",
    "ModelError": "localizer.errors",
    "OutsideMapError": "localizer.errors",
    "PoseFileError": "localizer.errors",
    "RenderError": "localizer.errors",
}

# In the order of the API page.
__all__ = [  # noqa: RUF022
    "Localizer",
    "open_localizer",
    "LocalizerConfig",
    "DualThreadEngine",
    "build_cache",
    "BuildOptions",
    "MapKind",
    "map_kind",
    "Camera",
    "Pose",
    "Geodetic",
    "LocalFrame",
    "Frame",
    "PosePrior",
    "PoseEstimate",
    "RegistrationStatus",
    "TrackingState",
    "PoseRow",
    "pose_of_row",
    "pose_row",
    "read_poses",
    "write_poses",
    "StampedPose",
    "read_tum",
    "write_tum",
    "LocalizerError",
    "CameraError",
    "GeoreferenceError",
    "MapCacheError",
    "MapError",
    "MapSourceError",
    "ModelError",
    "OutsideMapError",
    "PoseFileError",
    "RenderError",
]


def __getattr__(name: str) -> Any:
    home, _, own = _HOMES.get(name, "").partition(":")
    if not home:
        raise AttributeError(f"module 'localizer' has no attribute {name!r}")
    value = getattr(import_module(home), own or name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
