"""A map of an area from public services: downloads an orthophoto and a height model that
`localizer.map.building` imports.
"""
