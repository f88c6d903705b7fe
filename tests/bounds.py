"""Which numbers of a configuration model may be as large or as small as somebody types them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel

_LOWEST = {"minimum", "exclusiveMinimum"}
_HIGHEST = {"maximum", "exclusiveMaximum"}


def unbounded(model: type[BaseModel]) -> set[str]:
    """Names, with dots, of the numbers that lack a lower or an upper bound."""
    schema = model.model_json_schema()
    return set(_unbounded(schema, schema.get("$defs", {}), ""))


def _unbounded(node: dict[str, Any], defs: dict[str, Any], where: str) -> Iterator[str]:
    if "$ref" in node:
        node = defs[node["$ref"].rsplit("/", 1)[1]]
    if node.get("type") in ("number", "integer") and not (_LOWEST & set(node) and
                                                          _HIGHEST & set(node)):  # fmt: skip
        yield where
    for name, inner in node.get("properties", {}).items():
        yield from _unbounded(inner, defs, f"{where}.{name}".lstrip("."))
    parts = [p for key in ("anyOf", "allOf", "oneOf", "prefixItems") for p in node.get(key, ())]
    if isinstance(node.get("items"), dict):
        parts.append(node["items"])
    for part in parts:
        yield from _unbounded(part, defs, where)
