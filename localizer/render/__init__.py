"""Renderers: RGB and metric depth of the map from a pose."""
