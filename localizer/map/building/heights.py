"""Vertical datum of a source and geoid separation: stated, given or computed."""

from __future__ import annotations

from collections.abc import Iterable

from localizer.errors import GeoreferenceError, MapSourceError
from localizer.geometry.geo import geodetic_from_ecef
from localizer.geometry.geoid import geoid_separation
from localizer.map.cache.cache import HIGHEST_GEOID_M, LOWEST_GEOID_M
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
