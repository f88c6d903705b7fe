"""Converts the result of a calibration to changes of the deployment file."""

from __future__ import annotations

import stat
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from companion.calibrate import unknowns as u
from companion.calibrate.board import LensEstimate
from companion.calibrate.evidence import changed_camera
from companion.calibrate.flight import CalibrationResult
from companion.config import CompanionConfig, load_config, parse_config
from companion.errors import ConfigError
from companion.settings_file import read_settings, validated, with_current_keys
from localizer.geometry.pose import Array, euler_from_matrix, so3_exp
from localizer.plain_files import plain_text
from mavlink_bridge.atomic_file import replace_file

_LEAST = {"focal_percent": 0.05, "principal_percent": 0.05, "distortion": 0.001, "stamp_ms": 2.0}
_JITTER_MS = 2.0  # of stamps, from picture to picture, which the mean does not show
_BLIND = 1.0  # information of a combination, in useful sigmas, below which it is not told
_SHARE = 0.25  # of a combination's longest part: smaller ones are not named


@dataclass(frozen=True)
class SettingChange:
    """One setting: its key in the file, and its values."""

    key: tuple[str, ...]
    before: Any
    after: Any


def setting_changes(config: CompanionConfig, found: CalibrationResult) -> tuple[SettingChange, ...]:
    """All settings of the flown deployment `config` whose value the flight's estimate changes. They
    were estimated together and must be replaced together.
    """
    s, sigma, told = found.shared, found.sigmas, config.camera.model
    camera = changed_camera(found.camera, s)
    size = told.camera().resized(found.camera.width, found.camera.height)
    camera = camera if size == told.camera() else camera.resized(told.width, told.height)
    late_ms = config.camera.settings.time_offset_ms + 1e3 * float(s[u.LATE])
    angles = np.degrees(euler_from_matrix(found.mount @ so3_exp(s[u.MOUNT])))
    names = ("mount_roll_deg", "mount_pitch_deg", "mount_yaw_deg")
    made = _changes(config, {
        **{("camera", "model", n): round(getattr(camera, n), 3) for n in ("fx", "fy", "cx", "cy")},
        ("camera", "model", "distortion"): [round(k, 5) for k in camera.distortion],
        ("camera", "settings", "time_offset_ms"): round(late_ms, 1),
        **{("bridge", "camera", n): round(float(a), 3) for n, a in zip(names, angles, strict=True)},
        ("camera", "lever_arm_m"): [round(float(x), 3) for x in found.arm_m + s[u.ARM]],
        **_sigmas(
            focal_percent=100.0 * sigma[u.FOCAL],
            principal_percent=100.0 * sigma[u.CENTRE].max() / found.camera.width,
            distortion=sigma[u.BEND][0],
            stamp_ms=np.hypot(1e3 * sigma[u.LATE], _JITTER_MS),
        ),
    })  # fmt: skip
    return tuple(c for c in made if c.before != c.after)


def lens_changes(config: CompanionConfig | None, lens: LensEstimate) -> tuple[SettingChange, ...]:
    """All settings that a board calibration gives, changed or not. config: None if there is no
    deployment yet; `before` is then None.
    """
    c = lens.camera
    values: dict[str, Any] = {
        "width": c.width, "height": c.height,
        **{name: round(getattr(c, name), 2) for name in ("fx", "fy", "cx", "cy")},
        "distortion": [round(k, 5) for k in c.distortion],
    }  # fmt: skip
    if config is not None and config.camera.model.distortion_model != c.distortion_model:
        values["distortion_model"] = c.distortion_model
    sigmas = _sigmas(
        focal_percent=100.0 * lens.sigmas[0] / c.fx,
        principal_percent=100.0 * lens.sigmas[2:4].max() / c.width,
        distortion=lens.sigmas[4],
    )
    return _changes(config, {("camera", "model", k): v for k, v in values.items()} | sigmas)


def _sigmas(**values: float) -> dict[tuple[str, ...], float]:
    """Sigmas of the camera model by key, none below what the deployment allows."""
    return {
        ("localizer", "calibration", name): round(max(float(value), _LEAST[name]), 4)
        for name, value in values.items()
    }


def _changes(
    config: CompanionConfig | None, after: dict[tuple[str, ...], Any]
) -> tuple[SettingChange, ...]:
    document = None if config is None else config.model_dump()
    return tuple(SettingChange(key, _value(document, key), value) for key, value in after.items())


def _value(document: Any, key: tuple[str, ...]) -> Any:
    """The setting of a deployment, a tuple as a list; None without a deployment."""
    for name in key if document is not None else ():
        document = document[name]
    return list(document) if isinstance(document, tuple) else document


def apply_changes(config: CompanionConfig, wanted: tuple[SettingChange, ...]) -> CompanionConfig:
    """A copy of the deployment with the changes. Raises `SettingsError` if it is invalid."""
    document = config.model_dump()
    _apply(document, wanted)
    return validated(CompanionConfig, document)


def _apply(document: dict[str, Any], wanted: tuple[SettingChange, ...]) -> None:
    for change in wanted:
        at = document
        for name in change.key[:-1]:
            if not isinstance(at.get(name), dict):
                at[name] = {}
            at = at[name]
        at[change.key[-1]] = change.after


def require_flown_with(path: Path, wanted: tuple[SettingChange, ...]) -> None:
    """Raise `ConfigError` if the deployment file differs from the flight's. The estimate is a
    difference from the flown mounting and is wrong for another one. Values that were already
    written may differ.
    """
    document = load_config(path).model_dump()
    for change in wanted:
        now = _value(document, change.key)
        if now not in (change.before, change.after):
            raise ConfigError(
                f"{path}: {'.'.join(change.key)} is {now}, the record was flown with "
                f"{change.before}: give the file that it was flown with"
            )


def write_changed(path: Path, wanted: tuple[SettingChange, ...], heading: str) -> Path:
    """Write the changes into the deployment file, with `camera.calibrated` of today; its comments
    are lost. Returns the path of the old file, kept beside it. Access rights stay the same.
    heading: comment for the first line. `ConfigError` if the result is not valid or cannot be
    written.
    """
    document = with_current_keys(CompanionConfig, read_settings(path, ConfigError), str(path))
    _apply(document, wanted)
    today = datetime.now(timezone.utc).date().isoformat()
    _apply(document, (SettingChange(("camera", "calibrated"), None, today),))
    parse_config(document, f"{path}, as it would be written (nothing was changed)")
    number, kept = 1, path.with_name(f"{path.name}.before-calibration")
    while kept.exists():
        number += 1
        kept = path.with_name(f"{path.name}.before-calibration-{number}")
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=100)
    try:
        mode = stat.S_IMODE(path.stat().st_mode)
        replace_file(kept, plain_text(path), mode)
        replace_file(path, f"# {heading}\n# Before it: {kept.name}\n\n{text}", mode)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error
    return kept


def blind_spots(found: CalibrationResult) -> tuple[str, ...]:
    """Combinations of values that this flight cannot separate, in words, worst first: weak
    eigenvectors of its information. () if it separates all.
    """
    D = np.diag(u.USEFUL)
    information = D @ found.solution.information @ D
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    lines = []
    for value, vector in zip(values, vectors.T, strict=True):
        if value >= _BLIND:
            break
        lines.append(_combination(vector, float(value)))
    return tuple(lines)


def _combination(vector: Array, value: float) -> str:
    longest = float(np.abs(vector).max())
    named = [k for k in np.argsort(-np.abs(vector)) if abs(vector[k]) > _SHARE * longest]
    sign = np.sign(vector[named[0]])
    parts = []
    for k in named:
        unknown = u.UNKNOWNS[k]
        amount = sign * vector[k] / longest * u.USEFUL[k] * unknown.scale
        unit = f" {unknown.unit}" if unknown.unit else ""
        parts.append(f"{unknown.name} {amount:+.3g}{unit}")
    size = 1.0 / np.sqrt(max(value, 1e-6))
    if len(parts) == 1:
        only = u.UNKNOWNS[named[0]]
        sigma = size * longest * only.useful * only.scale
        return f"{only.name}: no better than {sigma:.3g} {only.unit}".rstrip()
    return f"{', '.join(parts)} cannot be separated, up to {size * longest:.2g} times as much"
