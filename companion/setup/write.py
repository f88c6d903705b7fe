"""Writes a deployment file with only the settings that differ from the defaults."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import yaml

from companion.config import CompanionConfig
from companion.errors import ConfigError
from companion.setup.difference import differing


def deployment_text(
    config: CompanionConfig, notes: Sequence[str], by: str = "companion init"
) -> str:
    """The file's text. by: the command that writes it; notes: comments for the user at its head."""
    lines = [
        f"# Written by `{by}`: only what differs from the defaults. Every other setting:",
        "# `companion init --reference`. Check it with `companion doctor` before each flight.",
        *(f"# {note}" for note in notes),
    ]
    body = yaml.safe_dump(differing(config), sort_keys=False, default_flow_style=None, width=100)
    return "\n".join(lines) + "\n\n" + body


def write_deployment(text: str, path: Path, overwrite: bool) -> None:
    """Write the file; `ConfigError` if it exists already or cannot be written."""
    try:
        with path.open("w" if overwrite else "x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError as error:
        raise ConfigError(f"{path}: is there already; --overwrite replaces it") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error
