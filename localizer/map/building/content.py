"""Plausibility of imported content: whether its ground faces up and is where the source states."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from localizer.geometry.geo import LocalFrame
from localizer.geometry.pose import Array
from localizer.map.building.staging import StoredTile
from localizer.map.cache.tile import orientation_fault
from localizer.map.importers.rules import ImportRules

_SLACK_M, _SLACK_SHARE = 1.0, 0.1  # beyond a volume: of its size
_MOST_OUTSIDE = 0.5  # of the content's extent on the ground


def require_upright(
    leaves: Iterable[StoredTile], up_axis: str | None, source: str, rules: ImportRules
) -> list[str]:
    """Warnings if most of the finest tiles' surface does not face up; `MapSourceError` unless the
    user accepts this. up_axis: the axis that was used, None if the source has none.
    """
    if up_axis is None:  # heights, which can only face up
        return []
    fault = orientation_fault(np.sum([tile.area for tile in leaves], axis=0))
    if fault is None:
        return []
    other = "z" if up_axis == "y" else "y"
    text = (
        f"{source}: its ground {fault}: its meshes were read with {up_axis} up; try --up-axis "
        f"{other}"
    )
    return [rules.accept("upright", text)]


def require_in_volumes(
    nodes: Iterable[tuple[Array, list[StoredTile]]],
    frame: LocalFrame,
    lift_m: float,
    source: str,
    rules: ImportRules,
) -> list[str]:
    """Warnings if content is outside the bounding volumes of its tileset; `MapSourceError` if most
    of it is, unless the user accepts this. nodes: ECEF corners (8, 3) of each volume, and its
    tiles. lift_m: what was added to the heights.
    """
    area = inside = worst = 0.0
    count = beyond = 0
    for corners, tiles in nodes:
        volume = frame.ecef_from_enu.inverse.apply(corners) + np.array([0.0, 0.0, lift_m])
        low, high = volume.min(axis=0), volume.max(axis=0)
        slack = _SLACK_M + _SLACK_SHARE * float(np.linalg.norm(high - low))
        for tile in tiles:
            least, most = np.array(tile.box_min), np.array(tile.box_max)
            size = np.maximum(most - least, 1e-3)[:2]
            shared = np.clip(np.minimum(most, high) - np.maximum(least, low), 0.0, None)[:2]
            area, inside = (
                area + float(size.prod()),
                inside + float(np.minimum(shared, size).prod()),
            )
            out = float(np.maximum(low - least, most - high).max())
            count, beyond, worst = count + 1, beyond + (out > slack), max(worst, out)
    if not beyond:
        return []
    text = (
        f"{source}: {beyond} of {count} tiles reach up to {worst:.0f} m out of the bounding "
        "volumes that the tileset states: a transform, a centre, the up axis or the volumes are "
        "wrong"
    )
    if inside < (1.0 - _MOST_OUTSIDE) * area:
        return [rules.accept("volume", text)]
    return [text]
