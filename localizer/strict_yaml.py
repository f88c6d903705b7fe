"""YAML as settings need it: plain types, no key twice, no `yes` where a number belongs, and no
number that says another one than is read: YAML 1.1 takes 8:20 for 500 and 0100 for 64.
"""

from __future__ import annotations

import re
from collections.abc import Hashable, Iterator
from typing import Any

import yaml

_MOST_KEYS = 10_000
_OCTAL = re.compile(r"[-+]?0[0-9_]+")


class _StrictLoader(yaml.SafeLoader):
    """A safe loader that refuses a repeated key. A key merged with `<<` may be overridden."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        # Here, because the constructor sees mappings whose merged keys are already among their own.
        node = super().compose_mapping_node(anchor)
        seen: set[Hashable] = set()
        for key_node, _ in node.value:
            if not isinstance(key_node, yaml.ScalarNode) or key_node.tag.endswith(":merge"):
                continue
            key = self.construct_object(key_node)
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"{key!r} stands twice in one mapping", key_node.start_mark
                )
            seen.add(key)
        return node

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        """Of a number that says itself."""
        return int(_plain(node, super().construct_yaml_int(node)))

    def construct_yaml_float(self, node: yaml.ScalarNode) -> float:
        """Likewise."""
        return float(_plain(node, super().construct_yaml_float(node)))

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Take in what `<<` merges: mappings that merge each other grow ninefold with each line."""
        super().flatten_mapping(node)
        if len(node.value) > _MOST_KEYS:
            raise yaml.constructor.ConstructorError(
                None, None, f"over {_MOST_KEYS} keys are merged into one mapping", node.start_mark
            )


for _kind, _read in (
    ("int", _StrictLoader.construct_yaml_int), ("float", _StrictLoader.construct_yaml_float),
):  # fmt: skip
    _StrictLoader.add_constructor(f"tag:yaml.org,2002:{_kind}", _read)


def _plain(node: yaml.ScalarNode, number: float) -> float:
    """The number of a scalar, unless YAML 1.1 reads it to base 60 or 8."""
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
    """The document in `text`; yaml.YAMLError, with line and column, also for a repeated key and
    for a number to base 60 or 8.

    As with `yaml.safe_load`, ValueError for an impossible date, RecursionError for endless nesting.
    """
    return yaml.load(text, Loader=_StrictLoader)


def misread_booleans(
    given: Any, taken: Any, where: tuple[str | int, ...] = ()
) -> Iterator[tuple[tuple[str | int, ...], bool]]:
    """(where, value) of the booleans in the data `given` that its model `taken` took for numbers:
    pydantic makes YAML's yes, on and true the number 1.
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
