"""A map that covers only the inner part of a generated world."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from localizer.map.building.build import build_cache

_BEYOND_M = 50.0  # what may stick out of a tile's square (a tree that sticks out)


def inner_map(whole: Path, reach_m: float) -> Path:
    """Write a cache of the tiles within reach_m of the world's centre; returns its path.

    whole: the cache of all tiles, beside the folder `survey` of their tileset; the smaller one is
    made once, beside it. Coarse tiles that reach further are left out, so nothing is shown beyond
    reach_m.
    """
    survey, cache = whole.parent / "survey", whole.with_name(f"{whole.name}-{reach_m:.0f}")
    if not (cache / "manifest.json").exists():
        tileset = json.loads((survey / "tileset.json").read_text(encoding="utf-8"))
        root = tileset["root"]
        kept = _within(root["children"], [0.0, 0.0, 0.0], reach_m)
        tileset["root"] = {k: v for k, v in root.items() if k != "content"} | {"children": kept}
        source = survey / f"tileset-{reach_m:.0f}.json"
        source.write_text(json.dumps(tileset), encoding="utf-8")
        build_cache(source, cache)
    return cache


def _within(nodes: list[dict[str, Any]], parent: list[float], reach_m: float) -> list[Any]:
    """Those subtrees, each with its place in the root's frame, that lie within the reach."""
    kept: list[Any] = []
    for node in nodes:
        # Column-major (4, 4); the generator's tiles are shifted and not turned.
        transform = list(node["transform"])
        for axis in range(3):
            transform[12 + axis] += parent[axis]
        box = node["boundingVolume"]["box"]
        reached = max(abs(transform[12]), abs(transform[13])) + max(box[3], box[7])
        if reached <= reach_m + _BEYOND_M:
            kept.append(node | {"transform": transform})
        else:
            kept += _within(node.get("children", []), transform[12:15], reach_m)
    return kept
