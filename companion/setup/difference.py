"""Selects the settings of a configuration that differ from the defaults."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel

from companion.settings_file import settings

Settings = dict[str, Any]


def differing(model: BaseModel) -> Settings:
    """The settings of a model that are required or differ from their defaults, as plain data."""
    found: Settings = {}
    for name, field in settings(type(model)).items():
        value = getattr(model, name)
        if field.is_required():
            found[name] = _plain(value)
            continue
        default = field.get_default(call_default_factory=True)
        if value == default:
            continue
        if isinstance(value, BaseModel) and isinstance(default, type(value)):
            found[name] = _changed(value, default)
        else:
            found[name] = _plain(value)
    return found


def _changed(value: BaseModel, default: BaseModel) -> Settings:
    """The settings in which a part of a configuration differs from what it is by default."""
    found: Settings = {}
    for name in settings(type(value)):
        now, then = getattr(value, name), getattr(default, name)
        if now == then:
            continue
        both = isinstance(now, BaseModel) and isinstance(then, type(now))
        found[name] = _changed(now, then) if both else _plain(now)
    return found


def _plain(value: Any) -> Any:
    """As YAML holds it."""
    if isinstance(value, BaseModel):
        return differing(value)
    if isinstance(value, tuple | list):
        return [_plain(v) for v in value]
    return value if isinstance(value, bool | int | float | str) or value is None else str(value)
