"""Reads JSON and YAML strictly: plain types, no repeated or merge keys, no `yes` for a number, and
no sexagesimal or octal numbers of YAML 1.1 (8:20 is 500).
"""

from __future__ import annotations

import json
import re
from collections.abc import Hashable, Iterator
from typing import Any

import yaml

_OCTAL = re.compile(r"[-+]?0[0-9_]+")


class _StrictLoader(yaml.SafeLoader):
    """A safe loader that refuses a repeated key and the merge key `<<`.

    Releases of PyYAML expand merges differently, and nested merges can grow ninefold with each
    line. No setting needs a merge.
    """

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        seen: set[Hashable] = set()
        for key_node, _ in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                raise yaml.constructor.ConstructorError(
                    None, None,
                    "the merge key << is not read: write out its keys (or quote it as text)",
                    key_node.start_mark,
                )  # fmt: skip
            if not isinstance(key_node, yaml.ScalarNode):
                continue
            key = self.construct_object(key_node)
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"{key!r} stands twice in one mapping", key_node.start_mark
                )
            seen.add(key)
        return node

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        """An integer, if its notation is decimal or explicit."""
        return int(_plain(node, super().construct_yaml_int(node)))

    def construct_yaml_float(self, node: yaml.ScalarNode) -> float:
        """A float, if its notation is decimal."""
        return float(_plain(node, super().construct_yaml_float(node)))


for _kind, _read in (
    ("int", _StrictLoader.construct_yaml_int), ("float", _StrictLoader.construct_yaml_float),
):  # fmt: skip
    _StrictLoader.add_constructor(f"tag:yaml.org,2002:{_kind}", _read)


def _plain(node: yaml.ScalarNode, number: float) -> float:
    """The number of a scalar; an error if YAML 1.1 reads it to base 60 or 8."""
    text = str(node.value)
    if ":" in text or _OCTAL.fullmatch(text):
        base = "60" if ":" in text else "8"
        raise yaml.constructor.ConstructorError(
            None, None,
            f"{text!r} is read to base {base}, as {number:g}: write decimal digits with a point, "
            "or in quotes where it is text", node.start_mark,
        )  # fmt: skip
    return number


def load_yaml(text: str) -> Any:
    """Parse a YAML document. yaml.YAMLError, with line and column, also for a repeated key, a merge
    key and a number to base 60 or 8.

    ValueError for an impossible date, or a tag that its value does not fit; RecursionError for
    endless nesting.
    """
    try:
        return yaml.load(text, Loader=_StrictLoader)
    except (AttributeError, LookupError) as error:  # PyYAML, of `!!bool x`, `!!timestamp x`
        raise ValueError(f"a tag does not fit its value ({error})") from error


def load_json(text: str) -> Any:
    """Parse a JSON document. ValueError, also for a repeated key: the last would win silently."""
    return json.loads(text, object_pairs_hook=_told_once)


def _told_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key stands twice")
    return found


def misread_booleans(
    given: Any, taken: Any, where: tuple[str | int, ...] = ()
) -> Iterator[tuple[tuple[str | int, ...], bool]]:
    """Yield (key path, value) of booleans that became numbers, as pydantic converts yes, on and
    true. given: the parsed YAML; taken: the pydantic model that was made of it; where: the key path
    of both.
    """
    if isinstance(given, bool):
        if isinstance(taken, int | float) and not isinstance(taken, bool):
            yield where, given
    elif isinstance(given, dict):
        for name, value in given.items():
            inner = taken.get(name) if isinstance(taken, dict) else getattr(taken, name, value)
            yield from misread_booleans(value, inner, (*where, name))
    elif isinstance(given, list) and isinstance(taken, list | tuple):
        for i, (value, inner) in enumerate(zip(given, taken, strict=False)):
            yield from misread_booleans(value, inner, (*where, i))
