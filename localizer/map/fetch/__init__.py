"""A map of a place from the services that states offer: what to ask for, politely, and how it
becomes an orthophoto and a height model that `localizer.map.building` imports.
"""
