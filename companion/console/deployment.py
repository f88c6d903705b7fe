"""The deployment file in the console: shows it with help, checks a new text, keeps the old file."""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from companion.config import CompanionConfig, load_config
from companion.errors import ConfigError
from companion.redaction import redacted
from companion.settings_file import nested_models, settable_fields
from localizer.plain_files import plain_text

_MOST_BYTES = 64 << 10


def read_for_page(path: Path, editable: bool) -> dict[str, Any]:
    """The file's text and the help for its keys. editable: whether the reader may change the file;
    otherwise credentials are hidden. `ConfigError` if the file cannot be read.
    """
    try:
        text = plain_text(path)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    return {
        "path": str(path),
        "text": text if editable else redacted(text),
        "editable": editable,
        "help": [{"key": k, "default": d, "text": t} for k, d, t in help_lines(CompanionConfig)],
    }


def check(path: Path, text: str) -> CompanionConfig:
    """Check a text as the deployment file at `path`, and return its configuration; `ConfigError`
    names what is wrong.

    The text is read from a temporary file beside the real one, because relative paths begin there.
    """
    if len(text.encode()) > _MOST_BYTES:
        raise ConfigError(f"over {_MOST_BYTES >> 10} KiB; that is no deployment")
    with _temporary_file(path, text) as trial:
        try:
            return load_config(trial)
        except ConfigError as error:
            raise ConfigError(str(error).replace(str(trial), path.name)) from error


def replace(path: Path, text: str) -> Path:
    """Write a valid text into the existing deployment file; returns the path of the copy of the old
    one, NAME.TIME.old. `ConfigError` if the text is not valid or cannot be written.
    """
    check(path, text)
    stamp = time.strftime("%Y%m%dT%H%M%S", time.gmtime())
    kept = path.with_name(f"{path.name}.{stamp}.old")
    number = 2
    while kept.exists():
        kept = path.with_name(f"{path.name}.{stamp}-{number}.old")
        number += 1
    try:
        mode = path.stat().st_mode & 0o777
        kept.write_bytes(path.read_bytes())
        kept.chmod(mode)
        with _temporary_file(path, text) as fresh:
            fresh.chmod(mode)
            os.replace(fresh, path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error}") from error
    return kept


def help_lines(model: type[BaseModel], where: str = "") -> list[tuple[str, str, str]]:
    """(key, default, description) of every setting of the model; keys begin with `where`."""
    lines = []
    for name, field in settable_fields(model).items():
        nested = nested_models(field.annotation)
        key = f"{where}{name}"
        if nested:
            lines += [line for m in nested for line in help_lines(m, f"{key}.")]
            continue
        default = "needed" if field.is_required() else str(field.default)
        lines.append((key, default, field.description or ""))
    return lines


@contextlib.contextmanager
def _temporary_file(path: Path, text: str) -> Iterator[Path]:
    """A temporary file with that text in the same folder."""
    try:
        number, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".yaml", dir=path.parent)
    except OSError as error:
        raise ConfigError(f"{path.parent}: cannot be written: {error}") from error
    try:
        with os.fdopen(number, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        yield Path(name)
    finally:
        Path(name).unlink(missing_ok=True)
