"""Convert a service's heights to metres, by the unit, scale and datum in its file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pyproj import CRS

from localizer.errors import GeoreferenceError, MapFetchError, MapSourceError
from localizer.map.fetch.catalogue import CatalogueSource
from localizer.map.importers.height_crs import stated_heights
from localizer.map.importers.raster_file import HeightBand, height_band
from localizer.map.importers.rules import DEFAULT_RULES

UNITS = ("m",)
"""Of what is written: a CRS in feet would else be asked for the heights' unit."""


def metres_of(source: CatalogueSource, name: str, data: Any, crs: CRS) -> HeightBand:
    """Conversion of a file's numbers to metres, by its unit, scale and offset. data: opened by
    rasterio; crs: used if the file has none. `MapFetchError` if the unit is unknown or the datum
    contradicts the source.
    """
    try:
        stated = stated_heights(crs if data.crs is None else CRS(data.crs), data.units[0], name)
        band, _ = height_band(Path(name), data, stated, None, None, DEFAULT_RULES)
    except (GeoreferenceError, MapSourceError) as error:
        raise MapFetchError(f"{source.name}: {error}") from error
    if stated.datum is not None and stated.datum != source.vertical_datum:
        raise MapFetchError(
            f"{source.name}: the heights of {name} are {stated.datum} by its CRS ({stated.crs}), "
            f"the source says {source.vertical_datum}; correct its vertical_datum"
        )
    return band
