"""Reads YAML settings files, with one clear line for each error."""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from localizer.plain_files import plain_text
from localizer.strict_yaml import load_yaml, misread_booleans

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
