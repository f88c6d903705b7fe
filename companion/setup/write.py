"""Writes a deployment file with only the settings that differ from the defaults."""

from __future__ import annotations

import stat
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel

from companion.config import CompanionConfig
from companion.errors import ConfigError
from companion.settings_file import settable_fields
from mavlink_bridge.atomic_file import replace_file


def deployment_text(
    config: CompanionConfig, notes: Sequence[str], by: str = "companion init"
) -> str:
    """The file's text. by: the command that writes it; notes: comments for the user at its head."""
    lines = [
        f"# Written by `{by}`: only what differs from the defaults. Every other setting:",
        "# `companion init --reference`. Check it with `companion doctor` before each flight.",
        *(f"# {note}" for note in notes),
    ]
    settings = differing_settings(config)
    body = yaml.safe_dump(settings, sort_keys=False, default_flow_style=None, width=100)
    return "\n".join(lines) + "\n\n" + body


def write_deployment(text: str, path: Path, overwrite: bool) -> None:
    """Write the file; `ConfigError` if that fails, or it exists and `overwrite` is False."""
    if path.exists() and not overwrite:
        raise ConfigError(f"{path}: is there already; --overwrite replaces it")
    try:
        replace_file(path, text, stat.S_IMODE(path.stat().st_mode) if path.exists() else 0o666)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error


def differing_settings(model: BaseModel, default: BaseModel | None = None) -> dict[str, Any]:
    """The settings of a model that differ from `default`, or else from the defaults of its class,
    as plain data. Settings without a default are all given.
    """
    found: dict[str, Any] = {}
    for name, field in settable_fields(type(model)).items():
        now = getattr(model, name)
        if default is None and field.is_required():
            found[name] = _plain(now)
            continue
        by_kind = default is None
        then = field.get_default(call_default_factory=True) if by_kind else getattr(default, name)
        if now != then:
            both = isinstance(now, BaseModel) and isinstance(then, type(now))
            found[name] = differing_settings(now, then) if both else _plain(now)
    return found


def _plain(value: Any) -> Any:
    """The value as YAML's types."""
    if isinstance(value, BaseModel):
        return differing_settings(value)
    if isinstance(value, tuple | list):
        return [_plain(v) for v in value]
    return value if isinstance(value, bool | int | float | str) or value is None else str(value)
