"""A deployment file with the camera, mounting and map of a trial."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from companion.config import of_stream_size, parse_config
from companion.errors import ReportError
from companion.preflight.map_pin import map_hash
from companion.setup.write import deployment_text, write_deployment
from companion.trial.result import Trial
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, euler_from_matrix, matrix_from_euler, so3_exp

_SEAL = "# `companion try` replaces this file only if this is the SHA-256 of the rest: "
_SOURCE, _CONNECTION = "udp://0.0.0.0:5600", "serial:/dev/ttyTHS1:921600"


def write_trial_deployment(path: Path, trial: Trial, map_cache: Path) -> Path:
    """Write the deployment file of camera and map; returns `path`. Comments mark what to check. An
    earlier one is replaced; `ReportError` if it was changed by hand (`refuse_edited`).
    """
    settings = _settings(trial, map_cache)
    config = parse_config(settings, str(path))
    text = deployment_text(config, _notes(trial), "companion try")
    refuse_edited(path)
    write_deployment(f"{_SEAL}{_digest(text)}\n{text}", path, overwrite=True)
    return path


def refuse_edited(path: Path) -> None:
    """`ReportError` if the file at `path` was changed by hand since `companion try` wrote it."""
    if not path.exists():
        return
    first, _, rest = path.read_text(encoding="utf-8", errors="replace").partition("\n")
    if first != _SEAL + _digest(rest):
        raise ReportError(f"{path}: was changed by hand; give another folder as --report")


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _settings(trial: Trial, map_cache: Path) -> dict[str, Any]:
    found = trial.estimated
    camera = found.camera if found is not None else trial.flight.camera.camera
    fixed = _fixed_pitch_deg(trial) is not None
    settings = footage_settings(map_cache, camera, _mount_deg(trial), fixed=fixed)
    return settings | {"record": {"folder": str(Path("flights/flight").resolve())}}


def footage_settings(
    map_cache: Path, camera: Camera, mount_deg: Array, *, fixed: bool
) -> dict[str, Any]:
    """Settings of a deployment with this map and camera; video source and connection are examples.
    mount_deg: (3,) roll, pitch, yaw of the camera, degrees; on the airframe if `fixed`, otherwise
    on a gimbal.
    """
    names = ("mount_roll_deg", "mount_pitch_deg", "mount_yaw_deg")
    angles = {name: round(float(a), 2) for name, a in zip(names, mount_deg, strict=True)}
    return {
        "map": str(map_cache.resolve()),
        "map_sha256": map_hash(map_cache),
        "camera": {"source": _SOURCE, "model": _model(camera)},
        "bridge": {
            "connection": _CONNECTION,
            "camera": {"mount": "fixed" if fixed else "gimbal"} | angles,
        },
    }


def _model(camera: Camera) -> dict[str, Any]:
    """Camera model for the file, rounded to what footage can show."""
    model = of_stream_size(camera).to_dict()
    rounded = {name: round(model[name], 2) for name in ("fx", "fy", "cx", "cy")}
    return model | rounded | {"distortion": [round(k, 5) for k in model["distortion"]]}


def _fixed_pitch_deg(trial: Trial) -> float | None:
    """Pitch of a camera fixed to the airframe, -90 (down) if unknown; None for a gimbal."""
    if trial.flight.log is not None:
        return trial.flight.log.fixed_pitch_deg
    is_measured = sum(p.measured for p in trial.priors) > len(trial.priors) / 2
    return None if is_measured else -90.0


def _mount_deg(trial: Trial) -> Array:
    """Roll, pitch, yaw of the mounting, degrees: gimbal bias, or a fixed camera's direction."""
    turn = np.zeros(3) if trial.estimated is None else np.radians(trial.estimated.mount_deg)
    pitch = np.radians(_fixed_pitch_deg(trial) or 0.0)
    return np.degrees(euler_from_matrix(matrix_from_euler(0.0, pitch, 0.0) @ so3_exp(turn)))


def _notes(trial: Trial) -> list[str]:
    notes = [
        f"Camera and mounting are those of the footage {trial.flight.name}.",
        "CHECK camera.source and bridge.connection: the footage does not state them.",
        f"Focal length: {trial.flight.camera.source}.",
    ]
    if _fixed_pitch_deg(trial) is not None:
        notes.append(
            "The footage has no gimbal angles: the camera is written as fixed to the airframe. "
            "With a gimbal set bridge.camera.mount: gimbal and its three angles to 0."
        )
    if trial.estimated is not None and trial.estimated.has_shift:
        east, north = trial.estimated.shift_m[:2]
        notes.append(
            f"The map lies {east:+.1f} m east, {north:+.1f} m north of GNSS; positions will be "
            "the map's."
        )
    return notes
