"""Buildings on a bare terrain: footprints with heights, from GeoJSON or CityGML, into a surface."""
