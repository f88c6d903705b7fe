"""Raises buildings on bare terrain from footprints with heights (GeoJSON or CityGML)."""
