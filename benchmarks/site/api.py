"""The API page, made from the docstrings."""

from __future__ import annotations

import inspect
import textwrap
from collections.abc import Iterator
from enum import Enum
from typing import Any

from pydantic import BaseModel

import localizer

_HEAD = """# API of `localizer`

This page is for whoever uses the localizer as a Python library. Everything here is imported as
`from localizer import NAME` and is stable; other names may change. Terms, frames, heights and time:
[architecture](../explanation/architecture.md). Angles: [angles](angles.md). More examples:
[examples/](../../examples). One photo is localized like this
([localize_photo.py](../../examples/localize_photo.py); `read_rgb` is in `localizer.pictures`):

```python
camera = Camera.from_json("camera.json")
image = read_rgb(Path(photo))
with open_localizer(cache, camera) as localizer:
    about = PoseRow(photo, Geodetic(latitude, longitude, height), roll, pitch, yaw)
    localizer.set_prior(PosePrior.around(pose_of_row(about, localizer.frame)))
    found = localizer.track(Frame(image, 0, camera, 0), passes=3)
    print(localizer.frame.position(found.world_from_camera.translation))
    print("accepted" if found.accepted else f"not localized: {found.status.value}")
```

`accepted` tells whether a pose may be used. `status` tells why there is none.
"""


def api_page() -> str:
    """The whole page."""
    parts = [_HEAD, *(_section(name, getattr(localizer, name)) for name in _documented())]
    errors = (getattr(localizer, name) for name in localizer.__all__ if _is_error(name))
    rows = [f"| `{e.__name__}` | `{e.__base__.__name__}` | {_flat(e)} |" for e in errors]
    table = ["| error | is a | when |", "|---|---|---|", *rows]
    return "\n".join([*parts, "## Errors\n", *table]) + "\n"


def _is_error(name: str) -> bool:
    value = getattr(localizer, name)
    return isinstance(value, type) and issubclass(value, Exception)


def _documented() -> Iterator[str]:
    return (name for name in localizer.__all__ if not _is_error(name))


def _section(name: str, value: Any) -> str:
    lines = [f"## {name}\n", *_text(value)]
    if inspect.isfunction(value):
        lines.insert(1, _code(f"{name}{_signature(value)}"))
    elif issubclass(value, Enum):
        lines += [f"- `{member.name}`: {member.value}" for member in value]
    elif issubclass(value, BaseModel):
        lines += [
            "Every key with its default: [configs/deployment.yaml](../../configs/deployment.yaml)."
        ]
    else:
        lines.insert(1, _code(f"{name}{_signature(value.__init__)}"))
        lines += [*_properties(value), *_methods(value)]
    return "\n".join(lines) + "\n"


def _properties(kind: type) -> list[str]:
    """One line for each public property that the class itself defines."""
    found = {
        name: member
        for name, member in vars(kind).items()
        if not name.startswith("_") and (isinstance(member, property) or _is_cached(member))
    }
    rows = [
        textwrap.fill(f"- `{name}`: {_flat(member)}", 100, subsequent_indent="  ")
        for name, member in found.items()
    ]
    return ["Properties:\n", *rows, ""] if rows else []


def _is_cached(member: Any) -> bool:
    return hasattr(member, "attrname")


def _methods(kind: type) -> Iterator[str]:
    """Public methods that the class itself defines, in the order of its source."""
    for name, member in vars(kind).items():
        if name.startswith("_") or isinstance(member, property) or _is_cached(member):
            continue
        if callable(function := getattr(kind, name)) and inspect.isroutine(function):
            code = _code(f"{kind.__name__}.{name}{_signature(function)}")
            yield from [f"### {kind.__name__}.{name}\n", code, *_text(function)]


def _signature(function: Any) -> str:
    """Parameters and result as in the source, a default that is a function as ``...``."""
    shown, star = [], False
    signature = inspect.signature(function)
    for p in signature.parameters.values():
        if p.name in ("self", "cls"):
            continue
        if p.kind is p.KEYWORD_ONLY and not star:
            shown.append("*")
            star = True
        text = p.name if p.annotation is p.empty else f"{p.name}: {_annotation(p.annotation)}"
        if p.default is not p.empty:
            known = "..." if callable(p.default) else repr(p.default)
            text += f" = {known}"
        shown.append(text)
    result = _annotation(signature.return_annotation)
    inside = ", ".join(shown)
    if len(inside) > 60:
        inside = "".join(f"\n    {parameter}," for parameter in shown) + "\n"
    return f"({inside})" + (f" -> {result}" if result not in ("None", "") else "")


def _annotation(annotation: Any) -> str:
    if annotation is inspect.Signature.empty or annotation is None:
        return ""
    return annotation if isinstance(annotation, str) else getattr(annotation, "__name__", "")


def _code(text: str) -> str:
    return f"```python\n{text}\n```\n"


def _text(value: Any) -> list[str]:
    """The docstring without what is meant for those who change the class."""
    parts = (inspect.getdoc(value) or "").split("\n\n")
    return ["\n\n".join(p for p in parts if not p.startswith("Above 200 lines")) + "\n"]


def _flat(value: Any) -> str:
    return " ".join((inspect.getdoc(value) or "").split())
