"""Settings files: YAML with a mapping at the top, and what is wrong with one in clear lines."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError


def read_settings(path: Path, error_type: type[Exception]) -> dict[str, Any]:
    """The mapping in a YAML file, empty for an empty file; `error_type` names file and fault."""
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
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


def problems(error: ValidationError) -> list[str]:
    """One line for each setting that is wrong: where, what, and what was given."""
    return [
        f"  {'.'.join(str(p) for p in e['loc'])}: {e['msg']} (got {_short(e['input'])})"
        for e in error.errors()
    ]


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
