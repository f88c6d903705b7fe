"""YAML as settings need it: safe types, and no key twice in one mapping."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import yaml


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


def load_yaml(text: str) -> Any:
    """The document in `text`; yaml.YAMLError also for a repeated key, with its line and column.

    As with `yaml.safe_load`, ValueError for an impossible date, RecursionError for endless nesting.
    """
    return yaml.load(text, Loader=_StrictLoader)
