"""Reads YAML settings files, with one clear line for each error, and keys of earlier versions.

Renamed keys: the only place with old names, for deployment files, records and scenario files. A
field with `exclude=True` is a constant of the program: code may change it, a file may not.
"""

from __future__ import annotations

import copy
import difflib
import logging
import reprlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from localizer.plain_files import load_yaml, misread_booleans, plain_text

_ModelT = TypeVar("_ModelT", bound=BaseModel)
_MAX_BYTES = 1 << 20  # settings are a few kilobytes; a log or a device given by mistake has no end
_SHORT = 60


class SettingsError(ValueError):
    """Invalid settings; its text has a line for each error."""


def read_settings(path: Path, error_type: type[Exception]) -> dict[str, Any]:
    """The mapping in a YAML file, {} for an empty file; `error_type`, with the file's name, if it
    cannot be read, is over 1 MiB, or holds something else.
    """
    try:
        data = load_yaml(plain_text(path, _MAX_BYTES))
    except OSError as error:
        raise error_type(f"{path}: cannot be read: {error.strerror}") from error
    # ValueError: no UTF-8, or a date that does not exist; RecursionError: endless nesting.
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise error_type(f"{path}: not valid YAML: {error}") from error
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise error_type(f"{path}: expected a mapping of settings at the top")
    return data


def validated(model: type[_ModelT], data: dict[str, Any]) -> _ModelT:
    """The settings as a model instance; SettingsError lists location, error and given value."""
    try:
        read = model.model_validate(data)
    except ValidationError as error:
        lines = [_line(e["loc"], _reason(model, dict(e)), e["input"]) for e in error.errors()]
        raise SettingsError("\n".join(lines)) from error
    if lines := [_line(where, "must not be a boolean", value)
                 for where, value in misread_booleans(data, read)]:  # fmt: skip
        raise SettingsError("\n".join(lines))
    return read


def settable_fields(model: type[BaseModel]) -> dict[str, FieldInfo]:
    """The fields of a model that a file can set (all without `exclude`), by name."""
    return {name: field for name, field in model.model_fields.items() if not field.exclude}


def nested_models(annotation: object) -> list[type[BaseModel]]:
    """The models in a field's annotation, such as that of an optional section; [] without."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in nested_models(part)]


def _line(where: Iterable[str | int], what: str, given: object) -> str:
    return f"  {'.'.join(str(p) for p in where)}: {what} (got {_short(given)})"


def _reason(model: type[BaseModel], error: dict[str, Any]) -> str:
    if error["type"] == "extra_forbidden":
        return f"no such setting{_meant(model, error['loc'])}"
    if error["type"] == "missing":
        return "is missing and has no default"
    if error["type"] == "model_type":
        return "must be a section of settings; null where one can be left out"
    # Pydantic's "Input should be a valid integer, unable to parse string as an integer".
    text = str(error["msg"]).removeprefix("Value error, ").split(", unable to parse", 1)[0]
    text = text.replace("Input should", "must").replace("a valid ", "a ")
    return text.replace("a integer", "an integer")


def _meant(model: type[BaseModel], where: Sequence[str | int]) -> str:
    """Name of a similar setting in the same place, for the error; "" without."""
    for part in where[:-1]:
        field = model.model_fields.get(str(part))
        kind = field.annotation if field is not None else None
        if not (isinstance(kind, type) and issubclass(kind, BaseModel)):
            return ""
        model = kind
    close = difflib.get_close_matches(str(where[-1]), settable_fields(model), n=1)
    return f", did you mean {close[0]}?" if close else ""


def _short(value: object) -> str:
    # reprlib: aliases (*name) can make a mapping of a few lines endless.
    text = _REPR.repr(value)
    return text if len(text) <= _SHORT else text[: _SHORT - 3] + "..."


_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = _REPR.maxlong = _SHORT


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
