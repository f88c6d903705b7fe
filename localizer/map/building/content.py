"""Plausibility of imported content: whether its ground faces up and is where the source states, and
its vertical datum and geoid separation: stated, given or computed.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from localizer.errors import GeoreferenceError, MapSourceError
from localizer.geometry.geo import LocalFrame, geodetic_from_ecef
from localizer.geometry.geoid import geoid_separation
from localizer.geometry.pose import Array
from localizer.map.building.staging import StoredTile
from localizer.map.cache.cache import HIGHEST_GEOID_M, LOWEST_GEOID_M
from localizer.map.cache.tile import orientation_fault
from localizer.map.importers.rules import HIGHEST_M, LOWEST_M, ImportRules
from localizer.map.source import SourceTree, VerticalDatum

# EGM96, EGM2008 and national geoids differ by less almost everywhere; a typing error by more.
GEOID_TOLERANCE_M = 2.0
_GEOID_SLOPE_M = 0.5  # from one end of a map to the other


def heights_of(
    tree: SourceTree,
    separation_m: float | None,
    datum: VerticalDatum | None,
    source: str,
    rules: ImportRules,
) -> tuple[float, VerticalDatum, list[str]]:
    """Geoid separation, vertical datum, and warnings.

    separation_m, datum: given by the user. The source's own statement, the given number and EGM96
    must agree. A separation that is neither given nor stated is computed; an unknown datum is an
    error. `GeoreferenceError` if the datum is unknown or its separation cannot be found.
    """
    if datum not in (None, "ellipsoidal", "amsl"):
        raise GeoreferenceError(f"vertical datum {datum!r}: ellipsoidal and amsl are known")
    warnings: list[str] = []
    try:
        datum = _datum(tree, datum, source, rules, warnings)
        separation = _separation(tree, separation_m, source, rules, warnings)
    except MapSourceError as error:
        raise GeoreferenceError(str(error)) from error
    return separation, datum, warnings


def _datum(
    tree: SourceTree,
    given: VerticalDatum | None,
    source: str,
    rules: ImportRules,
    warnings: list[str],
) -> VerticalDatum:
    stated = tree.vertical_datum
    if given is None and stated is None:
        raise GeoreferenceError(
            f"{source} does not say what its heights are above: give the vertical datum "
            "(--vertical-datum), ellipsoidal (WGS84) or amsl (the geoid)"
        )
    if tree.vertical_crs and given is not None and given != stated:
        text = f"{source}: its heights are {stated} by its CRS ({tree.vertical_crs}), not {given}"
        warnings.append(rules.accept("datum", text))
    datum = given or stated
    assert datum is not None
    return datum


def _separation(
    tree: SourceTree,
    given_m: float | None,
    source: str,
    rules: ImportRules,
    warnings: list[str],
) -> float:
    lat, lon, _ = (float(x) for x in geodetic_from_ecef(tree.centre))
    computed = round(geoid_separation(lat, lon), 2)
    told, whose = (given_m, "given") if given_m is not None else (tree.geoid_separation_m, "stated")
    if told is None:
        return computed
    if not LOWEST_GEOID_M <= told <= HIGHEST_GEOID_M:
        raise GeoreferenceError(f"a geoid separation of {told} m does not occur on Earth")
    if not abs(told - computed) <= GEOID_TOLERANCE_M:
        warnings.append(
            rules.accept(
                "geoid",
                f"{source}: the {whose} geoid separation is {told:.2f} m, EGM96's at {lat:.4f}, "
                f"{lon:.4f} is {computed:.2f} m",
            )
        )
    return told


def extent_warnings(
    extent: Iterable[tuple[float, float]],
    height_range_m: tuple[float, float],
    separation_m: float,
    source: str,
    rules: ImportRules,
) -> list[str]:
    """Warnings about a map's extent, (latitude, longitude) in degrees, and its lowest and highest
    ellipsoidal height. separation_m: geoid above the ellipsoid at the map. source: begins the text.
    Impossible heights raise `MapSourceError` unless `rules` accept them.
    """
    warnings = []
    low, high = (height - separation_m for height in height_range_m)
    if low < LOWEST_M or high > HIGHEST_M:
        text = f"{source}: heights from {low:.0f} to {high:.0f} m AMSL occur nowhere on Earth"
        warnings.append(rules.accept("heights", text))
    geoid = [geoid_separation(lat, lon) for lat, lon in extent]
    if max(geoid) - min(geoid) > _GEOID_SLOPE_M:
        warnings.append(
            f"the geoid rises by {max(geoid) - min(geoid):.1f} m across the map: AMSL altitudes "
            "are off by up to that at its ends"
        )
    return warnings


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
