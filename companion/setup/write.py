"""Reads settings from vehicle and stream, writes a deployment file, and lists every setting."""

from __future__ import annotations

import json
import stat
import textwrap
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, get_args

import yaml
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from companion.config import CompanionConfig
from companion.errors import ConfigError, StreamError, StreamSizeError
from companion.settings_file import settable_fields
from companion.sources import SourceSettings, StreamState, open_source
from companion.sources.folder_source import list_images, read_image
from localizer.geometry.camera import Camera
from mavlink_bridge.atomic_file import replace_file

_FIRST_PICTURE_S = 10.0
_GUESS = Camera.from_fov(1280, 720, 65.0)  # any: a picture says its size, this only names one
_ANY_GREY = (0, 65535)  # of a size, levels do not matter


def read_stream_size(source: str) -> tuple[int, int]:
    """Width and height, pixels, of a stream's frames or of a folder's first image; `StreamError` if
    none in 10 s.
    """
    if "://" not in source and Path(source).is_dir():  # pictures are taken at their own size there
        height, width = read_image(list_images(Path(source))[0], _ANY_GREY).shape[:2]
        return width, height
    told: list[str] = []

    def on_state(state: StreamState, text: str) -> None:
        if state is StreamState.STALLED:
            told.append(text)

    feed = open_source(source, _GUESS, SourceSettings(grey_range=_ANY_GREY), on_state)
    timer = threading.Timer(_FIRST_PICTURE_S, feed.close)
    timer.start()
    try:
        for frame in feed.frames():
            height, width = frame.image.shape[:2]
            return width, height
    except StreamSizeError as error:  # of another shape than the guess, as most thermal ones are
        if error.size is None:
            raise
        return error.size
    finally:
        timer.cancel()
        feed.close()
    why = f": {told[-1]}" if told else ""
    raise StreamError(f"no frame in {_FIRST_PICTURE_S:.0f} s{why}")


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


# What must be given: no default can be right.
_EXAMPLES: dict[str, Any] = {
    "map": "maps/area",
    "source": "udp://192.168.144.20:5600",
    "width": 1280,
    "height": 720,
    "fx": 1005.0,
    "fy": 1005.0,
    "cx": 640.0,
    "cy": 360.0,
    "folder": "flights/flight",
    "latitude_deg": 47.4,
    "longitude_deg": 8.5,
    "altitude_amsl_m": 488.0,
    "key_file": "mavlink.key",
}
_OTHER = "..."  # of a part that is off: its own page says more
_WIDTH = 100
_REQUIRED = "required"


def reference() -> str:
    """The text of a deployment file that lists every setting."""
    head = (
        "# Every setting of a deployment with its default, from `companion init --reference`.\n"
        "# A deployment file needs only what differs. Values of required settings are examples.\n"
    )
    return head + "\n".join(_lines(CompanionConfig, None, 0)) + "\n"


def _lines(model: type[BaseModel], default: BaseModel | None, depth: int) -> Iterator[str]:
    """Lines of a model's settings. default: its value if it is left out, None: the model's own."""
    for name, field in settable_fields(model).items():
        indent = "  " * depth
        value = _default(field) if default is None else getattr(default, name)
        part = _part(field)
        yield from _words(field, value, indent)
        if part is None or (value is None and not field.is_required()):
            given = _EXAMPLES.get(name, _OTHER) if value is PydanticUndefined else value
            yield f"{indent}{name}: {_text(given)}"
            if part is not None:
                yield from (f"{indent}  # {line}" for line in _lines(part, None, 0))
            continue
        yield f"{indent}{name}:"
        inner = value if isinstance(value, BaseModel) else None
        yield from _lines(part, inner, depth + 1)


def _default(field: FieldInfo) -> Any:
    return (
        PydanticUndefined if field.is_required() else field.get_default(call_default_factory=True)
    )


def _part(field: FieldInfo) -> type[BaseModel] | None:
    """The model of which a setting consists; None for a plain one."""
    for annotation in (field.annotation, *get_args(field.annotation)):
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            return annotation
    return None


def _words(field: FieldInfo, value: Any, indent: str) -> Iterator[str]:
    """The setting's meaning and bounds as comments."""
    choices = [str(c) for c in get_args(field.annotation) if isinstance(c, str)]
    said = [p for p in (field.description, _bounds(field), ", ".join(choices)) if p]
    if value is PydanticUndefined and _part(field) is None:
        said.append(_REQUIRED)
    for line in textwrap.wrap("; ".join(said), _WIDTH - len(indent) - 2):
        yield f"{indent}# {line}"


def _bounds(field: FieldInfo) -> str:
    """Bounds as an interval: [0, 10], (0, 1] without 0, [1, inf); "" without."""
    found = {
        key: getattr(part, key)
        for part in field.metadata
        for key in ("ge", "gt", "le", "lt")
        if getattr(part, key, None) is not None
    }
    if not found:
        return ""
    low, high = found.get("ge", found.get("gt")), found.get("le", found.get("lt"))
    begin = "(-inf" if low is None else f"{'[' if 'ge' in found else '('}{low:g}"
    end = "inf)" if high is None else f"{high:g}{']' if 'le' in found else ')'}"
    return f"{begin}, {end}"


def _text(value: Any) -> str:
    """A value on one line of YAML."""
    if isinstance(value, tuple | list):
        return json.dumps([_number(v) for v in value])
    if isinstance(value, float):
        return _float(value)
    plain = value if isinstance(value, bool | int | str) or value is None else str(value)
    return yaml.safe_dump(plain, width=1000).removesuffix("\n...\n").strip()


def _number(value: Any) -> Any:
    return value if isinstance(value, bool | int | float | str) else str(value)


def _float(value: float) -> str:
    """A number as text, with the point that YAML needs before an exponent."""
    text = repr(value)
    return text if "e" not in text or "." in text else text.replace("e", ".0e")
