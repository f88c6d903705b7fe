"""Determines unit and vertical datum of heights from a CRS and a raster's tags."""

from __future__ import annotations

import struct
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from pyproj import CRS
from pyproj.aoi import AreaOfInterest
from pyproj.transformer import TransformerGroup

from localizer.errors import GeoreferenceError
from localizer.geometry.pose import Array
from localizer.map.importers.rules import ImportRules
from localizer.map.source import VerticalDatum

_FOOT, _US_FOOT = 0.3048, 1200 / 3937
# As GDAL, GeoTIFF writers and the command line spell them.
UNITS = {
    "m": 1.0, "metre": 1.0, "meter": 1.0, "metres": 1.0, "meters": 1.0,
    "ft": _FOOT, "foot": _FOOT, "feet": _FOOT, "international foot": _FOOT,
    "us-ft": _US_FOOT, "ftus": _US_FOOT, "us survey foot": _US_FOOT, "us survey feet": _US_FOOT,
    "foot_us": _US_FOOT, "survey foot": _US_FOOT, "cm": 0.01, "centimetre": 0.01,
    "mm": 0.001, "millimetre": 0.001,
}  # fmt: skip
_EGM96 = "EGM96"
_BIG_TIFF, _KEY_DIRECTORY, _MOST_ENTRIES = 43, 34735, 4096
_VERTICAL_TYPE_KEY, _VERTICAL_DATUM_KEY, _VERTICAL_UNIT_KEY = 4096, 4098, 4099
_KEYED_UNITS = {9001: 1.0, 9002: _FOOT, 9003: _US_FOOT}
# GeoTIFF 1.0, 6.3.4.1: heights above an ellipsoid, and above a national sea level.
_KEYED_ELLIPSOIDS = frozenset((*range(5001, 5034), 4979))
_KEYED_GEOIDS = {
    5101: "Newlyn", 5102: "NGVD29", 5103: "NAVD88", 5104: "Yellow Sea 1956",
    5105: "Baltic Sea", 5106: "Caspian Sea",
}  # fmt: skip
_DATUM_M = 1.5  # ETRS89, GDA2020 and the like are taken for WGS84 to within a metre
_FAR_DEG = 10.0  # beyond the neighbouring zones that projects on a border are drawn in


@dataclass(frozen=True)
class StatedHeights:
    """Heights as the source states them. unit_m: metres per unit, None if unknown; datum: None if
    unknown; crs: name of the vertical CRS, empty without one.
    """

    unit_m: float | None
    datum: VerticalDatum | None
    crs: str

    @property
    def other_geoid(self) -> bool:
        """Whether heights are above another geoid than EGM96, which the conversion uses."""
        return self.datum == "amsl" and _EGM96 not in self.crs.upper()


def stated_heights(crs: CRS, band_unit: str | None, where: object) -> StatedHeights:
    """Unit and datum by a source's CRS and its band's unit tag (None: no tag); `GeoreferenceError`
    if they contradict. where: the source; if it is the path of a GeoTIFF, its own vertical keys
    precede the CRS.
    """
    keys = geo_keys(where) if isinstance(where, Path) else {}
    unit, datum, name = _keyed_heights(keys, where)
    keyed = unit
    vertical = next((c for c in crs.sub_crs_list if c.is_vertical), None)
    if datum is not None and unit is not None:
        # GDAL leaves GeoTIFF 1.0's own numbers out, or makes other units of them.
        return StatedHeights(unit, datum, name)
    if datum is None and vertical is not None:
        axis, name = vertical.axis_info[0], vertical.name
        if axis.direction != "up":
            raise GeoreferenceError(f"{where}: {name} counts depths, not heights; convert it")
        unit, datum = float(axis.unit_conversion_factor), "amsl"
        if "ellips" in name.lower():
            datum = "ellipsoidal"
    elif datum is None and len(crs.axis_info) == 3:
        axis, name = crs.axis_info[2], crs.name
        unit, datum = float(axis.unit_conversion_factor), "ellipsoidal"
    if keyed is not None and unit is not None and abs(keyed / unit - 1) > 1e-4:
        raise GeoreferenceError(
            f"{where}: {name} has units of {unit:g} m, its VerticalUnitsGeoKey says {keyed:g} m; "
            "correct one of them (gdal_edit -a_srs)"
        )
    tagged = _unit(band_unit)
    if tagged is None and (band_unit or "").strip():
        raise GeoreferenceError(
            f"{where}: the band's unit is {band_unit!r}, which is none of heights that is known; "
            "correct it (gdal_edit -units), or convert the heights to metres"
        )
    if tagged is not None and unit is not None and abs(tagged / unit - 1) > 1e-4:
        raise GeoreferenceError(
            f"{where}: the band's unit is {band_unit!r}, {name} has units of {unit:g} m; correct "
            "one of them"
        )
    return StatedHeights(tagged if unit is None else unit, datum, name)


def _keyed_heights(
    keys: Mapping[int, int], where: object
) -> tuple[float | None, VerticalDatum | None, str]:
    """Unit, datum and name from a GeoTIFF's vertical keys. PROJ does not know GeoTIFF 1.0's own
    numbers, so GDAL omits them.
    """
    kind = keys.get(_VERTICAL_TYPE_KEY, keys.get(_VERTICAL_DATUM_KEY, 0))
    unit_key = keys.get(_VERTICAL_UNIT_KEY)
    unit = None if unit_key is None else _KEYED_UNITS.get(unit_key)
    if unit_key is not None and unit is None:
        raise GeoreferenceError(
            f"{where}: its heights are in the unit {unit_key} (GeoTIFF's VerticalUnitsGeoKey), "
            "which is none that is known; convert them to metres"
        )
    if kind in _KEYED_ELLIPSOIDS:
        return unit, "ellipsoidal", f"GeoTIFF vertical key {kind}"
    if kind in _KEYED_GEOIDS:
        return unit, "amsl", _KEYED_GEOIDS[kind]
    return unit, None, ""


def geo_keys(path: Path) -> dict[int, int]:
    """Numbers of a GeoTIFF's key directory (tag 34735, OGC 19-008r4); empty without one, and for a
    file that cannot be read.
    """
    try:
        with path.open("rb") as file:
            return _geo_keys(file)
    except (OSError, struct.error, ValueError):
        return {}


def _geo_keys(file: BinaryIO) -> dict[int, int]:
    start = file.read(16)
    order = "<" if start[:2] == b"II" else ">"
    large = struct.unpack_from(order + "H", start, 2)[0] == _BIG_TIFF
    (at,) = struct.unpack_from(order + ("Q" if large else "I"), start, 8 if large else 4)
    count_form, entry_form = ("Q", "HHQQ") if large else ("H", "HHII")
    file.seek(at)
    (count,) = struct.unpack(order + count_form, file.read(struct.calcsize(order + count_form)))
    size = struct.calcsize(order + entry_form)
    for _ in range(min(count, _MOST_ENTRIES)):
        tag, _, length, offset = struct.unpack(order + entry_form, file.read(size))
        if tag == _KEY_DIRECTORY and length <= _MOST_ENTRIES:
            file.seek(offset)
            numbers = struct.unpack(f"{order}{length}H", file.read(2 * length))
            rows = zip(*(numbers[4 + k :: 4] for k in range(4)), strict=False)
            return {key: value for key, location, _, value in rows if location == 0}
    return {}


def flat_crs(crs: CRS) -> CRS:
    """A CRS's horizontal part. The importer converts heights itself, so GDAL must not."""
    flat = crs.sub_crs_list[0] if crs.is_compound else crs
    return flat.to_2d() if len(flat.axis_info) == 3 else flat


def utm_zone(latitude_deg: float, longitude_deg: float) -> CRS:
    """The UTM zone of a position."""
    base = 32600 if latitude_deg >= 0 else 32700
    return CRS.from_epsg(base + int((longitude_deg + 180) // 6) % 60 + 1)


def horizontal_unit_m(crs: CRS) -> float:
    """Metres per unit of a projected CRS; 1 for degrees."""
    flat = flat_crs(crs)
    return float(flat.axis_info[0].unit_conversion_factor) if flat.is_projected else 1.0


def place_doubts(crs: CRS, lon: Array, lat: Array, source: object, rules: ImportRules) -> list[str]:
    """Warnings about the position of a source with this CRS, by positions (N,) of it, degrees.
    `MapSourceError` if it is far outside the CRS's area and the user does not accept this.
    """
    text = far_outside(crs, lon, lat)
    if text is not None:
        return [rules.accept("area", f"{source}: {text}")]
    unsure = datum_doubt(crs, float(np.mean(lon)), float(np.mean(lat)))
    return [] if unsure is None else [f"{Path(str(source)).name}: {unsure}"]


def far_outside(crs: CRS, lon: Array, lat: Array) -> str | None:
    """Warning if positions (N,), degrees, are far outside a CRS's area of use, for example because
    easting and northing are swapped; None otherwise.
    """
    flat = flat_crs(crs)
    area = flat.area_of_use
    if area is None and (epsg := flat.to_epsg()) is not None:
        area = CRS.from_epsg(epsg).area_of_use
    if area is None:
        return None
    width = (area.east - area.west) % 360.0 or 360.0
    past = (lon - area.west) % 360.0
    aside = np.where(past <= width, 0.0, np.minimum(past - width, 360.0 - past))
    beyond = np.maximum(np.maximum(area.south - lat, lat - area.north), aside)
    worst = int(np.argmax(beyond))
    if beyond[worst] <= _FAR_DEG:
        return None
    return (
        f"lies at {lat[worst]:.4f}, {lon[worst]:.4f}, {beyond[worst]:.0f} degrees outside the area "
        f"of its CRS, {flat.name}; are easting and northing swapped?"
    )


def datum_doubt(crs: CRS, lon: float, lat: float) -> str | None:
    """Warning if the transformation from a CRS to WGS84 at a position (degrees) is uncertain by 1.5
    m or more; None otherwise.

    An older national datum needs a grid that may not be installed; without it a map is silently
    metres off (EPSG:27700: 2 to 21 m, NAD27: 8 to 20 m).
    """
    flat = flat_crs(crs)
    area = AreaOfInterest(lon - 0.01, lat - 0.01, lon + 0.01, lat + 0.01)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that a grid is missing is said here
        ways = TransformerGroup(flat, CRS.from_epsg(4326), always_xy=True, area_of_interest=area)
    if not ways.transformers:
        return f"{flat.name}: no way to WGS84 is known"
    accuracy = ways.transformers[0].accuracy
    if ways.best_available and 0.0 <= accuracy <= _DATUM_M:
        return None
    known = f"to {accuracy:g} m only" if accuracy >= 0.0 else "to nobody knows what"
    missing = "" if ways.best_available else "; the better way needs a grid that is not installed"
    return (
        f"{flat.name} is known against WGS84 {known}{missing}: warp the source with its national "
        "grid (gdalwarp -t_srs), or the map may lie so far off"
    )


def unit_of(name: str) -> float:
    """Metres per unit by its name; `GeoreferenceError` for an unknown one."""
    found = _unit(name)
    if found is None:
        raise GeoreferenceError(f"height unit {name!r}: m, ft, us-ft, cm and mm are known")
    return found


def _unit(name: str | None) -> float | None:
    return UNITS.get((name or "").strip().lower())
