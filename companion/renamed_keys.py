"""Reads settings of earlier versions that were renamed or removed, with a warning.

The only place with old names, for deployment files, records and scenario files. A field with
`exclude=True` is a constant of the program: code may change it, a file may not.
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel

from companion.settings_file import nested_models

_log = logging.getLogger(__name__)

RENAMED = {
    "guardian": "integrity_monitor",
    "camera.settings.stamps_late_ms": "camera.settings.time_offset_ms",
    "localizer.odometry.terrain": "localizer.terrain",
}
"""Old path: new path."""

_CONSTANTS = (
    "bridge.injection.covariance", "bridge.injection.yaw_guard", "integrity_monitor.calibration",
    "integrity_monitor.gnss_accuracy_cap_m", "integrity_monitor.gnss_repeat_s",
    "integrity_monitor.height_m", "integrity_monitor.jump_hold_s", "integrity_monitor.jump_m",
    "integrity_monitor.motion", "integrity_monitor.picture", "integrity_monitor.tilt_deg",
    "integrity_monitor.unreported_jump_m", "integrity_monitor.untold_jump_m", "prior",
)  # fmt: skip
REMOVED = {
    "bridge.state_file": "state_dir is the folder of all that a restart reads",
    "bridge.signing.state_file": "state_dir is the folder of all that a restart reads",
    "bridge.ground_signing.state_file": "state_dir is the folder of all that a restart reads",
    "prior.state_file": "state_dir is the folder of all that a restart reads",
    "bridge.switch.good_after_s": "a returning receiver is checked against vision",
    "bridge.camera.width_px": "it is camera.model.width",
    "bridge.camera.height_px": "it is camera.model.height",
    "bridge.camera.horizontal_fov_deg": "it follows from camera.model",
    "bridge.camera.zoom_rate_hz": "it follows from camera.zoom",
    "bridge.targets.rate_hz": "it is targets.rate_hz",
    "record.mcap": "`companion export RECORD --mcap` writes it after the flight",
    "localizer.feature_threads": "it follows from localizer.threads",
    **dict.fromkeys(_CONSTANTS, "it is a constant of the program"),
}
"""Path: why it has no effect any more. Constants that are fields (see above) need no entry."""


def with_current_keys(model: type[BaseModel], data: dict[str, Any], where: str) -> dict[str, Any]:
    """A copy of `model`'s settings with today's names, without removed keys and constants; `where`
    names the file in the warning for each.

    If a key is given under its old and its new name, both are kept, and the model refuses the old
    one.
    """
    data = copy.deepcopy(data)
    for old, new in RENAMED.items():
        if _holds(data, old) and not _holds(data, new):
            _log.warning("%s: %s is called %s since 0.2: rename it", where, old, new)
            _put(data, new, _taken(data, old))
    reasons = {key: why for key, why in REMOVED.items() if _holds(data, key)}
    for key in [*reasons, *_constants(model, data, "")]:
        if _holds(data, key):
            why = reasons.get(key, "it is a constant of the program")
            _log.warning("%s: %s has no effect since 0.2 (%s): remove it", where, key, why)
            _taken(data, key)
    return data


def _constants(model: type[BaseModel], data: dict[str, Any], at: str) -> Iterator[str]:
    """Paths of the given keys that no deployment can set."""
    for name, value in data.items():
        field = model.model_fields.get(str(name))
        if field is None:
            continue
        if field.exclude:
            yield f"{at}{name}"
        elif isinstance(value, dict):
            for inner in nested_models(field.annotation):
                yield from _constants(inner, value, f"{at}{name}.")


def _section(data: dict[str, Any], path: str) -> tuple[dict[str, Any] | None, str]:
    """The mapping that holds a path's last key, None without one, and that key."""
    *names, key = path.split(".")
    section: Any = data
    for name in names:
        section = section.get(name) if isinstance(section, dict) else None
    return section if isinstance(section, dict) else None, key


def _holds(data: dict[str, Any], path: str) -> bool:
    section, key = _section(data, path)
    return section is not None and key in section


def _taken(data: dict[str, Any], path: str) -> Any:
    section, key = _section(data, path)
    return None if section is None else section.pop(key)


def _put(data: dict[str, Any], path: str, value: Any) -> None:
    section, key = _section(data, path)
    if section is not None:
        section[key] = value
